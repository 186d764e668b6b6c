// As much of rclcpp and ros2_control as an exported controller calls, without a graph: messages go
// to whoever asks here, time passes when a test says so.
#ifndef STAND_INS_HPP_
#define STAND_INS_HPP_

#include <atomic>
#include <chrono>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <variant>
#include <vector>

namespace builtin_interfaces::msg
{
struct Time
{
  std::int32_t sec = 0;
  std::uint32_t nanosec = 0;
};
using Duration = Time;
}  // namespace builtin_interfaces::msg

namespace std_msgs::msg
{
struct Header
{
  builtin_interfaces::msg::Time stamp;
  std::string frame_id;
};
struct Float64
{
  double data = 0.0;
};
}  // namespace std_msgs::msg

namespace sensor_msgs::msg
{
struct JointState
{
  std_msgs::msg::Header header;
  std::vector<std::string> name;
  std::vector<double> position, velocity, effort;
};
}  // namespace sensor_msgs::msg

namespace trajectory_msgs::msg
{
struct JointTrajectoryPoint
{
  std::vector<double> positions, velocities, accelerations, effort;
  builtin_interfaces::msg::Duration time_from_start;
};
struct JointTrajectory
{
  std_msgs::msg::Header header;
  std::vector<std::string> joint_names;
  std::vector<JointTrajectoryPoint> points;
};
}  // namespace trajectory_msgs::msg

namespace diagnostic_msgs::msg
{
struct KeyValue
{
  std::string key, value;
};
struct DiagnosticStatus
{
  static constexpr std::uint8_t OK = 0, WARN = 1, ERROR = 2;
  std::uint8_t level = OK;
  std::string name, message, hardware_id;
  std::vector<KeyValue> values;
};
struct DiagnosticArray
{
  std_msgs::msg::Header header;
  std::vector<DiagnosticStatus> status;
};
}  // namespace diagnostic_msgs::msg

namespace rcl_interfaces::msg
{
struct SetParametersResult
{
  bool successful = false;
  std::string reason;
};
}  // namespace rcl_interfaces::msg

namespace lifecycle_msgs::msg
{
struct State
{
  static constexpr std::uint8_t PRIMARY_STATE_INACTIVE = 2, PRIMARY_STATE_ACTIVE = 3;
};
struct Transition
{
};
}  // namespace lifecycle_msgs::msg

enum rcl_clock_type_t { RCL_STEADY_TIME };

namespace rclcpp
{

class Time
{
public:
  explicit Time(std::int64_t nanoseconds) : nanoseconds_(nanoseconds)
  {
    if (nanoseconds < 0) {
      throw std::runtime_error("cannot store a negative time point in rclcpp::Time");
    }
  }
  Time(const builtin_interfaces::msg::Time & time)  // NOLINT
  : Time(time.sec * INT64_C(1000000000) + time.nanosec)
  {
  }
  std::int64_t nanoseconds() const { return nanoseconds_; }
  operator builtin_interfaces::msg::Time() const
  {
    builtin_interfaces::msg::Time found;
    found.sec = static_cast<std::int32_t>(nanoseconds_ / 1000000000);
    found.nanosec = static_cast<std::uint32_t>(nanoseconds_ % 1000000000);
    return found;
  }

private:
  std::int64_t nanoseconds_;
};

class Duration
{
public:
  explicit Duration(std::int64_t nanoseconds) : nanoseconds_(nanoseconds) {}
  Duration(const builtin_interfaces::msg::Duration & duration)  // NOLINT
  : nanoseconds_(duration.sec * INT64_C(1000000000) + duration.nanosec)
  {
  }
  std::int64_t nanoseconds() const { return nanoseconds_; }
  operator builtin_interfaces::msg::Duration() const
  {
    builtin_interfaces::msg::Duration found;
    found.sec = static_cast<std::int32_t>(nanoseconds_ / 1000000000);
    found.nanosec = static_cast<std::uint32_t>(nanoseconds_ % 1000000000);
    return found;
  }

private:
  std::int64_t nanoseconds_;
};

class Parameter
{
public:
  using Value = std::variant<double, bool, std::string, std::vector<std::string>>;
  Parameter(std::string name, Value value) : name_(std::move(name)), value_(std::move(value)) {}
  const std::string & get_name() const { return name_; }
  double as_double() const { return std::get<double>(value_); }
  bool as_bool() const { return std::get<bool>(value_); }
  const std::string & as_string() const { return std::get<std::string>(value_); }
  const std::vector<std::string> & as_string_array() const
  {
    return std::get<std::vector<std::string>>(value_);
  }

private:
  std::string name_;
  Value value_;
};

/// All that is published and subscribed to, by full names.
struct Graph
{
  std::map<std::string, std::function<void(const void *)>> publishers;
  std::multimap<std::string, std::function<void(const void *)>> subscriptions;
  std::map<std::string, std::vector<sensor_msgs::msg::JointState>> joint_states;
  std::vector<std::string> log;
  std::vector<std::function<void()>> timers;
  diagnostic_msgs::msg::DiagnosticArray health;  // the newest
  unsigned int update_rate = 0;                  // [Hz] of the controller_manager
  std::atomic<std::int64_t> steady_ns = 0;       // passes with updates and ticks
  std::map<std::string, std::map<std::string, Parameter::Value>> overrides;  // by node's name
};
inline Graph & graph()
{
  static Graph one;
  return one;
}

class Clock
{
public:
  explicit Clock(rcl_clock_type_t) {}
  Time now() const { return Time(graph().steady_ns); }
};

struct QoS
{
  QoS(std::size_t) {}  // NOLINT: as of rclcpp, implicit
  QoS & transient_local() { return *this; }
};

template <typename Message>
class Publisher
{
public:
  using SharedPtr = std::shared_ptr<Publisher>;
  explicit Publisher(std::string topic) : topic_(std::move(topic)) {}
  std::size_t get_subscription_count() const { return 1; }
  void publish(const Message & message)
  {
    if constexpr (std::is_same_v<Message, sensor_msgs::msg::JointState>) {
      graph().joint_states[topic_].push_back(message);
    } else if constexpr (std::is_same_v<Message, diagnostic_msgs::msg::DiagnosticArray>) {
      graph().health = message;
    }
  }

private:
  std::string topic_;
};

template <typename Message>
struct Subscription
{
  using SharedPtr = std::shared_ptr<Subscription>;
};
struct TimerBase
{
  using SharedPtr = std::shared_ptr<TimerBase>;
};

class NodeOptions
{
public:
  NodeOptions & arguments(std::vector<std::string>) { return *this; }
  NodeOptions & use_global_arguments(bool) { return *this; }
  std::vector<std::string> arguments() const { return {}; }
};

struct Logger
{
};

}  // namespace rclcpp

#define RCLCPP_WARN(logger, format, text) ((void)(logger), rclcpp::graph().log.push_back(text))
#define RCLCPP_INFO(logger, format, text) ((void)(logger), (void)(text))
#define RCLCPP_ERROR(logger, format, text) RCLCPP_WARN(logger, format, text)

namespace rclcpp_lifecycle
{

class State
{
public:
  State(std::uint8_t id, std::string label) : id_(id), label_(std::move(label)) {}
  std::uint8_t id() const { return id_; }
  const std::string & label() const { return label_; }

private:
  std::uint8_t id_;
  std::string label_;
};

namespace node_interfaces
{
struct LifecycleNodeInterface
{
  enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
};
}  // namespace node_interfaces

class LifecycleNode
{
public:
  using SharedPtr = std::shared_ptr<LifecycleNode>;
  using Result = node_interfaces::LifecycleNodeInterface::CallbackReturn;
  using Parameters = std::vector<rclcpp::Parameter>;
  template <typename Signature>
  struct Handle
  {
    using SharedPtr = std::shared_ptr<std::function<Signature>>;
  };
  using OnSetParametersCallbackHandle =
    Handle<rcl_interfaces::msg::SetParametersResult(const Parameters &)>;
  using PostSetParametersCallbackHandle = Handle<void(const Parameters &)>;

  LifecycleNode(std::string name, std::string space, const rclcpp::NodeOptions &)
  : name_(std::move(name)), space_(std::move(space))
  {
    all()[get_fully_qualified_name()] = this;
  }
  ~LifecycleNode() { all().erase(get_fully_qualified_name()); }

  /// The nodes that are there, by their full names.
  static std::map<std::string, LifecycleNode *> & all()
  {
    static std::map<std::string, LifecycleNode *> nodes;
    return nodes;
  }

  const char * get_name() const { return name_.c_str(); }
  std::string get_fully_qualified_name() const { return space_ + "/" + name_; }
  rclcpp::NodeOptions get_node_options() const { return {}; }
  rclcpp::Logger get_logger() const { return {}; }
  rclcpp::Time now() const { return rclcpp::Time(0); }
  SharedPtr get_node_base_interface() const { return nullptr; }

  void declare(const std::string & name, const rclcpp::Parameter::Value & fallback)
  {
    auto & own = rclcpp::graph().overrides[name_];
    values_.insert({name, own.count(name) ? own.at(name) : fallback});
  }
  rclcpp::Parameter get_parameter(const std::string & name) const
  {
    return {name, values_.at(name)};
  }
  auto add_on_set_parameters_callback(
    std::function<rcl_interfaces::msg::SetParametersResult(const Parameters &)> callback)
  {
    on_set_ = callback;
    return std::make_shared<decltype(callback)>(callback);
  }
  auto add_post_set_parameters_callback(std::function<void(const Parameters &)> callback)
  {
    on_changed_ = callback;
    return std::make_shared<decltype(callback)>(callback);
  }
  /// Returns why a set is refused; empty if it is taken.
  std::string set(const Parameters & changes)
  {
    const auto result = on_set_(changes);
    if (result.successful) {
      on_changed_(changes);
    }
    return result.reason;
  }

  template <typename Message>
  std::shared_ptr<rclcpp::Subscription<Message>> create_subscription(
    const std::string & topic, const rclcpp::QoS &, std::function<void(const Message &)> callback)
  {
    rclcpp::graph().subscriptions.emplace(resolved(topic), [callback](const void * message) {
      callback(*static_cast<const Message *>(message));
    });
    return std::make_shared<rclcpp::Subscription<Message>>();
  }
  rclcpp::TimerBase::SharedPtr create_wall_timer(
    std::chrono::milliseconds, std::function<void()> callback)
  {
    rclcpp::graph().timers.push_back(std::move(callback));
    return std::make_shared<rclcpp::TimerBase>();
  }
  std::string resolved(const std::string & topic) const
  {
    if (topic[0] == '~') {
      return get_fully_qualified_name() + topic.substr(1);
    }
    return topic[0] == '/' ? topic : space_ + "/" + topic;
  }

  using Callback = std::function<Result(const State &)>;
  void register_on_activate(Callback callback) { on_activate_ = std::move(callback); }
  void register_on_deactivate(Callback callback) { on_deactivate_ = std::move(callback); }
  void register_on_cleanup(Callback callback) { on_cleanup_ = std::move(callback); }
  void register_on_shutdown(Callback callback) { on_shutdown_ = std::move(callback); }
  const State & configure() { return state_ = {lifecycle_msgs::msg::State::PRIMARY_STATE_INACTIVE, "inactive"}; }
  const State & activate()
  {
    if (on_activate_(state_) == Result::SUCCESS) {
      state_ = {lifecycle_msgs::msg::State::PRIMARY_STATE_ACTIVE, "active"};
    }
    return state_;
  }
  const State & deactivate()
  {
    on_deactivate_(state_);
    return configure();
  }
  const State & cleanup()
  {
    on_cleanup_(state_);
    return state_ = {1, "unconfigured"};
  }
  const State & shutdown()
  {
    on_shutdown_(state_);
    return state_ = {4, "finalized"};
  }
  const State & get_current_state() const { return state_; }

private:
  std::string name_, space_;
  std::map<std::string, rclcpp::Parameter::Value> values_;
  std::function<rcl_interfaces::msg::SetParametersResult(const Parameters &)> on_set_;
  std::function<void(const Parameters &)> on_changed_;
  Callback on_activate_, on_deactivate_, on_cleanup_, on_shutdown_;
  State state_ = {1, "unconfigured"};
};

}  // namespace rclcpp_lifecycle

namespace rclcpp
{

template <typename Message>
typename Publisher<Message>::SharedPtr create_publisher(
  const rclcpp_lifecycle::LifecycleNode::SharedPtr & node, const std::string & topic, const QoS &)
{
  return std::make_shared<Publisher<Message>>(node->resolved(topic));
}

namespace executors
{
class SingleThreadedExecutor
{
public:
  void add_node(const rclcpp_lifecycle::LifecycleNode::SharedPtr &) {}
  template <typename Future>
  void spin_until_future_complete(const Future & future)
  {
    future.wait();
  }
  void cancel() {}
};
}  // namespace executors

}  // namespace rclcpp

namespace hardware_interface
{
class Interface
{
public:
  using SharedPtr = std::shared_ptr<Interface>;
  Interface() = default;
  Interface(const std::string &, const std::string &) {}
  std::optional<double> get_optional() const
  {
    if (is_of_another_type) {
      throw std::runtime_error("Data type is not double");
    }
    return is_busy ? std::nullopt : value_;
  }
  bool is_of_another_type = false;
  bool set_value(double value, unsigned int max_tries = 10)
  {
    for (; busy_tries > 0 && max_tries > 0; --max_tries) {
      --busy_tries;
    }
    if (max_tries > 0) {
      value_ = value;
    }
    return max_tries > 0;
  }
  bool is_busy = false;
  int busy_tries = 0;  // of setting

private:
  std::optional<double> value_ = std::numeric_limits<double>::quiet_NaN();
};
using CommandInterface = Interface;
using StateInterface = Interface;
}  // namespace hardware_interface

namespace controller_interface
{

using CallbackReturn = rclcpp_lifecycle::LifecycleNode::Result;
enum class return_type { OK, ERROR };
enum class interface_configuration_type { INDIVIDUAL };
struct InterfaceConfiguration
{
  interface_configuration_type type;
  std::vector<std::string> names;
};

class ChainableControllerInterface
{
public:
  virtual ~ChainableControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_cleanup(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_shutdown(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_error(const rclcpp_lifecycle::State &) = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual return_type update_reference_from_subscribers(
    const rclcpp::Time &, const rclcpp::Duration &) = 0;
  virtual return_type update_and_write_commands(
    const rclcpp::Time &, const rclcpp::Duration &) = 0;
  virtual std::vector<hardware_interface::CommandInterface::SharedPtr>
  on_export_reference_interfaces_list() = 0;
  virtual bool on_set_chained_mode(bool) = 0;

  rclcpp_lifecycle::LifecycleNode::SharedPtr get_node() const { return node_; }
  bool is_in_chained_mode() const { return is_chained_; }
  unsigned int get_update_rate() const { return rclcpp::graph().update_rate; }

  /// What a controller_manager does before it activates a controller.
  void prepare(bool is_chained)
  {
    command_interfaces_.resize(command_interface_configuration().names.size());
    state_interfaces_.resize(state_interface_configuration().names.size());
    ordered_exported_reference_interfaces_ = on_export_reference_interfaces_list();
    is_chained_ = is_chained;
    on_set_chained_mode(is_chained);
  }

  std::vector<hardware_interface::CommandInterface> command_interfaces_;
  std::vector<hardware_interface::StateInterface> state_interfaces_;
  std::vector<hardware_interface::CommandInterface::SharedPtr>
    ordered_exported_reference_interfaces_;

protected:
  template <typename Type>
  Type auto_declare(const std::string & name, const Type & fallback)
  {
    node_->declare(name, fallback);
    return fallback;
  }

private:
  bool is_chained_ = false;
  rclcpp_lifecycle::LifecycleNode::SharedPtr node_ =
    std::make_shared<rclcpp_lifecycle::LifecycleNode>("hpid_controller", "", rclcpp::NodeOptions());
};

}  // namespace controller_interface

#define PLUGINLIB_EXPORT_CLASS(type, base)

namespace ament_index_cpp
{
inline std::string get_package_share_directory(const std::string &) { return SHARE_FOLDER; }
}  // namespace ament_index_cpp

#endif  // STAND_INS_HPP_
