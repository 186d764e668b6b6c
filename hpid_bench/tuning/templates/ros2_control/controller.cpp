#include "controller.hpp"

#include <chrono>
#include <exception>
#include <tuple>

#include "ament_index_cpp/get_package_share_directory.hpp"
#include "certificate.hpp"
#include "pluginlib/class_list_macros.hpp"

namespace {{ package }}
{

namespace
{

constexpr auto kPeriod = std::chrono::milliseconds(10);
constexpr int kReportsEvery = 100;  // periods
constexpr std::int64_t kRestart_ns = 20000000;  // chained mode begins or ends in less
constexpr auto kPause = std::chrono::microseconds(20);
constexpr unsigned int kTries = 10000;  // for a zero that must not be lost

}  // namespace

HpidController::~HpidController() { close(); }

controller_interface::CallbackReturn HpidController::on_init()
{
  try {
    names_ = auto_declare<std::vector<std::string>>("joints", { {%- for each in joints %}"{{ each }}"{{ ", " if not loop.last }}{% endfor -%} });
    has_velocities_ = auto_declare<bool>("velocity_interfaces", true);
  } catch (const std::exception & error) {
    RCLCPP_ERROR(get_node()->get_logger(), "%s", error.what());
    return CallbackReturn::ERROR;
  }
  return CallbackReturn::SUCCESS;
}

controller_interface::CallbackReturn HpidController::on_configure(const State &)
{
  try {
    open();
  } catch (const std::exception & error) {
    RCLCPP_ERROR(get_node()->get_logger(), "%s", error.what());
    close();
    return CallbackReturn::FAILURE;
  }
  return CallbackReturn::SUCCESS;
}

void HpidController::open()
{
  names_ = get_node()->get_parameter("joints").as_string_array();
  has_velocities_ = get_node()->get_parameter("velocity_interfaces").as_bool();
  const auto folder = ament_index_cpp::get_package_share_directory("{{ package }}") + "/config";
  const auto reason = file_refusal(folder + "/certificates.json");
  if (!reason.empty()) {
    throw std::runtime_error(reason);
  }
  auto arguments = get_node()->get_node_options().arguments();
  const std::vector<std::string> first = {
    "--ros-args", "--params-file", folder + "/joints.yaml", "--"};
  arguments.insert(arguments.begin(), first.begin(), first.end());
  const auto options = rclcpp::NodeOptions().arguments(arguments).use_global_arguments(false);
  const std::string space = get_node()->get_fully_qualified_name();
  for (const auto & name : names_) {
    joints_.push_back(std::make_unique<JointNode>(
      name, space, options, get_update_rate(), is_active_, is_chained_));
  }
  if (joints_.empty()) {
    throw std::invalid_argument("parameter joints must name at least one joint");
  }
  for (auto & cycle : cycles_.places()) {
    cycle.joints.resize(joints_.size());
  }
  const auto node = joints_.front()->node();
  const auto deep = rclcpp::QoS(4000);
  states_ = rclcpp::create_publisher<Message>(node, "joint_states", deep);
  commands_ = rclcpp::create_publisher<Message>(node, "joint_commands", deep);
  diagnostics_ = rclcpp::create_publisher<Diagnostics>(node, "/diagnostics", 10);
  timer_ = node->create_wall_timer(kPeriod, [this] { on_timer(); });
  executor_ = std::make_unique<rclcpp::executors::SingleThreadedExecutor>();
  for (const auto & joint : joints_) {
    executor_->add_node(joint->node()->get_node_base_interface());
  }
  closing_ = std::promise<void>();
  thread_ = std::thread([this, closed = closing_.get_future().share()] { spin(closed); });
}

/// What throws in a callback ends that callback, and not the manager's process.
void HpidController::spin(const std::shared_future<void> & closed)
{
  for (bool is_over = false; !is_over;) {
    try {
      executor_->spin_until_future_complete(closed);  // of spin() a cancel() before it is lost
      is_over = true;
    } catch (const std::exception & error) {
      RCLCPP_ERROR(get_node()->get_logger(), "%s", error.what());
    }
  }
}

void HpidController::close()
{
  is_active_ = false;
  if (thread_.joinable()) {
    closing_.set_value();
    executor_->cancel();
    thread_.join();
    publish_all(true);
  }
  timer_.reset();
  states_.reset();
  commands_.reset();
  diagnostics_.reset();
  executor_.reset();
  joints_.clear();
  has_left_ = false;
}

controller_interface::CallbackReturn HpidController::on_activate(const State &)
{
  try {
    for (const auto & each : state_interfaces_) {
      std::ignore = each.get_optional();  // throws where it is no number
    }
    for (const auto & each : command_interfaces_) {
      std::ignore = each.get_optional();
    }
  } catch (const std::exception & error) {
    RCLCPP_ERROR(get_node()->get_logger(), "%s", error.what());
    return CallbackReturn::FAILURE;
  }
  const bool is_restart = goes_on();
  stamps_ = is_restart && stamps_ != Stamps::kNone ? Stamps::kGoOn : Stamps::kNone;
  for (std::size_t i = 0; i < command_interfaces_.size(); ++i) {
    Joint & joint = joints_[i]->joint();
    joint.drop_motion();
    std::ignore = command_interfaces_[i].set_value(is_restart ? joint.resume() : 0.0);
  }
  if (is_restart && last_ != nullptr) {
    last_->is_void = true;
  }
  has_left_ = false;
  for (const auto & interface : ordered_exported_reference_interfaces_) {
    std::ignore = interface->set_value(kNaN);
  }
  is_active_ = true;
  return CallbackReturn::SUCCESS;
}

/// Where chained mode begins or ends, a manager deactivates and activates the controller at once, and
/// the loops go on: returns whether this is such an activation.
bool HpidController::goes_on() const
{
  return has_left_ && is_chained_ != was_chained_ &&
    clock_.now().nanoseconds() - left_ns_ < kRestart_ns;
}

controller_interface::CallbackReturn HpidController::on_deactivate(const State &)
{
  is_active_ = false;
  while (is_updating_) {  // a manager that is shut down deactivates beside its control loop
    std::this_thread::sleep_for(kPause);
  }
  if (joints_.empty()) {
    return CallbackReturn::SUCCESS;
  }
  has_left_ = true;
  was_chained_ = is_chained_;
  left_ns_ = clock_.now().nanoseconds();
  last_ = cycles_.back();
  for (std::size_t i = 0; i < joints_.size(); ++i) {
    const Record record = joints_[i]->joint().leave();
    if (last_ != nullptr) {
      last_->joints[i] = record;
    }
  }
  if (last_ != nullptr) {
    last_->is_last = true;
    last_->is_void = false;
    last_->left_ns = left_ns_;
    cycles_.push();
  } else {
    lost_.fetch_add(1, std::memory_order_relaxed);
  }
  for (std::size_t i = 0; i < command_interfaces_.size(); ++i) {
    if (!command_interfaces_[i].set_value(0.0, kTries)) {
      const auto line = names_[i] + " may keep its last effort: another thread has its command";
      RCLCPP_ERROR(get_node()->get_logger(), "%s", line.c_str());
    }
  }
  return CallbackReturn::SUCCESS;
}

controller_interface::CallbackReturn HpidController::on_cleanup(const State &)
{
  close();
  return CallbackReturn::SUCCESS;
}

controller_interface::CallbackReturn HpidController::on_shutdown(const State & before)
{
  on_deactivate(before);
  return on_cleanup(before);
}

controller_interface::CallbackReturn HpidController::on_error(const State & before)
{
  return on_shutdown(before);
}

controller_interface::InterfaceConfiguration HpidController::interfaces(
  const std::vector<std::string> & kinds) const
{
  controller_interface::InterfaceConfiguration found;
  found.type = controller_interface::interface_configuration_type::INDIVIDUAL;
  for (const auto & name : names_) {
    for (const auto & kind : kinds) {
      found.names.push_back(name + "/" + kind);
    }
  }
  return found;
}

controller_interface::InterfaceConfiguration
HpidController::command_interface_configuration() const
{
  return interfaces({"effort"});
}

controller_interface::InterfaceConfiguration HpidController::state_interface_configuration() const
{
  if (!has_velocities_) {
    return interfaces({"position"});
  }
  return interfaces({"position", "velocity"});
}

std::vector<hardware_interface::CommandInterface::SharedPtr>
HpidController::on_export_reference_interfaces_list()
{
  std::vector<hardware_interface::CommandInterface::SharedPtr> found;
  for (const auto & name : names_) {
    for (const auto * kind : {"position", "velocity"}) {
      const auto prefix = std::string(get_node()->get_name()) + "/" + name;
      found.push_back(std::make_shared<hardware_interface::CommandInterface>(prefix, kind));
    }
  }
  return found;
}

bool HpidController::on_set_chained_mode(bool is_chained)
{
  is_chained_ = is_chained;
  return true;
}

controller_interface::return_type HpidController::update_reference_from_subscribers(
  const rclcpp::Time &, const rclcpp::Duration &)
{
  return controller_interface::return_type::OK;  // each joint takes up its own motions
}

controller_interface::return_type HpidController::update_and_write_commands(
  const rclcpp::Time & time, const rclcpp::Duration & period)
{
  const Raised updating(is_updating_);
  if (is_active_) {
    advance(time.nanoseconds(), period.nanoseconds());
    cycle(stamp_ns_, time_ns_ - stamp_ns_);
  }
  return controller_interface::return_type::OK;
}

/// Time passes by periods, as a clock that is set would be a gap, or one that has gone back; of the
/// time in which chained mode began or ended no period tells.
void HpidController::advance(std::int64_t time_ns, std::int64_t period_ns)
{
  const std::int64_t since_ns = time_ns - time_ns_;
  const std::int64_t longest_ns = 2 * (kRestart_ns + period_ns_);
  const bool is_by_period = stamps_ != Stamps::kGoOn || since_ns < 0 || since_ns > longest_ns;
  stamp_ns_ += is_by_period ? period_ns : since_ns;
  if (stamps_ == Stamps::kFlow) {
    period_ns_ = period_ns;
  }
  if (stamps_ == Stamps::kNone || stamp_ns_ < 0) {
    stamp_ns_ = time_ns;
  }
  time_ns_ = time_ns;
  stamps_ = Stamps::kFlow;
}

void HpidController::cycle(std::int64_t stamp_ns, std::int64_t ahead_ns)
{
  const std::size_t kinds = has_velocities_ ? 2 : 1;
  const bool is_chained = is_in_chained_mode();
  Cycle * cycle = cycles_.back();
  for (std::size_t i = 0; i < joints_.size(); ++i) {
    const auto position = state_interfaces_[kinds * i].get_optional();
    const auto velocity = state_interfaces_[kinds * i + kinds - 1].get_optional();
    Reference reference;
    if (is_chained) {
      const auto & given = ordered_exported_reference_interfaces_;
      reference.position = given[2 * i]->get_optional().value_or(kNaN);
      reference.velocity = given[2 * i + 1]->get_optional().value_or(kNaN);
    }
    Record record;
    if (position && velocity) {
      record = joints_[i]->joint().step(
        stamp_ns, *position, has_velocities_ ? &*velocity : nullptr,
        is_chained ? &reference : nullptr, ahead_ns);
      std::ignore = command_interfaces_[i].set_value(record.effort);
    } else if (!joints_[i]->joint().is_enabled) {
      record = joints_[i]->joint().leave();
      std::ignore = command_interfaces_[i].set_value(0.0);
    } else {  // the handle is another thread's for this instant: the effort stays
      unreadable_.fetch_add(1, std::memory_order_relaxed);
    }
    if (cycle != nullptr) {
      cycle->joints[i] = record;
    }
  }
  if (cycle != nullptr) {
    cycle->is_last = cycle->is_void = false;
    cycles_.push();
  } else {
    lost_.fetch_add(1, std::memory_order_relaxed);
  }
}

void HpidController::on_timer()
{
  for (const auto & joint : joints_) {
    joint->follow_lifecycle();
  }
  publish_all(false);
  if (ticks_++ % kReportsEvery == 0) {
    report();
  }
}

/// Publishes what waits, but for the last cycle while the controller may yet go on.
void HpidController::publish_all(bool is_over)
{
  while (const Cycle * cycle = cycles_.front()) {
    const auto since_ns = clock_.now().nanoseconds() - cycle->left_ns;
    if (cycle->is_last && !is_over && since_ns < 2 * kRestart_ns) {
      break;
    }
    try {
      if (!cycle->is_void) {
        publish(*cycle);
      }
    } catch (const std::exception & error) {
      RCLCPP_ERROR(get_node()->get_logger(), "%s", error.what());
    }
    cycles_.pop();
  }
}

/// The messages are those of hpid_ros; an answer also has the reference that was asked for, from
/// which `hpid replay` computes it again.
void HpidController::publish(const Cycle & cycle)
{
  Message states, answers;
  answers.header.frame_id = get_node()->get_fully_qualified_name();
  for (std::size_t i = 0; i < cycle.joints.size(); ++i) {
    const Record & record = cycle.joints[i];
    if (record.kind == Record::Kind::kNothing) {
      continue;
    }
    if (record.kind != Record::Kind::kAnswer) {  // beside the state that was answered last
      Message alone;
      const bool is_left = record.kind == Record::Kind::kLeft;
      alone.header.frame_id = answers.header.frame_id;
      alone.header.stamp = rclcpp::Time(record.stamp_ns + (is_left ? 0 : 1));
      alone.name = {names_[i]};
      alone.effort = {record.effort};
      send(*commands_, alone);
      continue;
    }
    answers.header.stamp = rclcpp::Time(record.stamp_ns);
    answers.name.push_back(names_[i]);
    answers.position.push_back(record.asked.position);
    answers.velocity.push_back(record.asked.velocity);
    answers.effort.push_back(record.effort);
    states.name.push_back(names_[i]);
    states.position.push_back(record.position);
    states.effort.push_back(record.before);
    if (has_velocities_) {
      states.velocity.push_back(record.velocity);
    }
    joints_[i]->introspect(record);
  }
  states.header.stamp = answers.header.stamp;
  if (!states.name.empty()) {
    send(*states_, states);
    send(*commands_, answers);
  }
}

void HpidController::send(rclcpp::Publisher<Message> & publisher, const Message & message)
{
  if (publisher.get_subscription_count() > 0) {
    publisher.publish(message);
  }
}

void HpidController::report()
{
  Diagnostics message;
  message.header.stamp = get_node()->now();
  for (const auto & joint : joints_) {
    message.status.push_back(joint->status());
    for (const auto & [key, count] :
      {std::pair("cycles not published", lost_.load()),
       std::pair("states that could not be read", unreadable_.load())})
    {
      message.status.back().values.emplace_back();
      message.status.back().values.back().key = key;
      message.status.back().values.back().value = std::to_string(count);
    }
  }
  diagnostics_->publish(message);
}

}  // namespace {{ package }}

PLUGINLIB_EXPORT_CLASS(
  {{ package }}::HpidController, controller_interface::ChainableControllerInterface)
