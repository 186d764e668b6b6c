// A ros2_control controller for several joints, each of which has its own loop.
#ifndef CONTROLLER_HPP_
#define CONTROLLER_HPP_

#include <atomic>
#include <cstdint>
#include <future>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "controller_interface/chainable_controller_interface.hpp"
#include "diagnostic_msgs/msg/diagnostic_array.hpp"
#include "handover.hpp"
#include "joint_node.hpp"
#include "rclcpp/clock.hpp"
#include "rclcpp/executors/single_threaded_executor.hpp"
#include "sensor_msgs/msg/joint_state.hpp"

namespace {{ package }}
{

class HpidController : public controller_interface::ChainableControllerInterface
{
public:
  using CallbackReturn = controller_interface::CallbackReturn;
  using State = rclcpp_lifecycle::State;

  ~HpidController() override;

  CallbackReturn on_init() override;
  CallbackReturn on_configure(const State & before) override;
  CallbackReturn on_activate(const State & before) override;
  CallbackReturn on_deactivate(const State & before) override;
  CallbackReturn on_cleanup(const State & before) override;
  CallbackReturn on_shutdown(const State & before) override;
  CallbackReturn on_error(const State & before) override;

  controller_interface::InterfaceConfiguration command_interface_configuration() const override;
  controller_interface::InterfaceConfiguration state_interface_configuration() const override;

  controller_interface::return_type update_reference_from_subscribers(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;
  controller_interface::return_type update_and_write_commands(
    const rclcpp::Time & time, const rclcpp::Duration & period) override;

protected:
  std::vector<hardware_interface::CommandInterface::SharedPtr>
  on_export_reference_interfaces_list() override;
  bool on_set_chained_mode(bool is_chained) override;

private:
  using Message = sensor_msgs::msg::JointState;
  using Diagnostics = diagnostic_msgs::msg::DiagnosticArray;

  /// What became of all joints in a cycle, or when the controller was deactivated.
  struct Cycle
  {
    std::vector<Record> joints;
    bool is_last = false;               // before the controller was deactivated
    std::int64_t left_ns = 0;           // when that was [ns], by a steady clock
    std::atomic<bool> is_void = false;  // it was activated again at once
  };

  controller_interface::InterfaceConfiguration interfaces(
    const std::vector<std::string> & kinds) const;
  void open();
  void close();
  void advance(std::int64_t time_ns, std::int64_t period_ns);
  void cycle(std::int64_t stamp_ns, std::int64_t ahead_ns);
  bool goes_on() const;
  void publish_all(bool is_over);
  void spin(const std::shared_future<void> & closed);
  void on_timer();
  void publish(const Cycle & cycle);
  void send(rclcpp::Publisher<Message> & publisher, const Message & message);
  void report();

  std::vector<std::string> names_;  // of the joints
  bool has_velocities_ = true;
  std::vector<std::unique_ptr<JointNode>> joints_;
  std::atomic<bool> is_active_ = false;
  std::atomic<bool> is_updating_ = false;
  std::atomic<bool> is_chained_ = false;
  std::atomic<std::uint64_t> lost_ = 0;        // cycles that nobody could hear of
  std::atomic<std::uint64_t> unreadable_ = 0;  // joints whose handles another thread had
  rclcpp::Clock clock_{RCL_STEADY_TIME};
  std::int64_t stamp_ns_ = 0;  // of the loops
  std::int64_t time_ns_ = 0;   // the manager's, of the last cycle
  std::int64_t period_ns_ = 0;
  enum class Stamps { kNone, kGoOn, kFlow } stamps_ = Stamps::kNone;
  // Of the last deactivation:
  bool has_left_ = false;
  bool was_chained_ = false;
  std::int64_t left_ns_ = 0;  // [ns] by the steady clock
  Cycle * last_ = nullptr;    // nullptr if there was no room
  Queue<Cycle, 4096> cycles_;

  // What has time: a thread of its own.
  std::unique_ptr<rclcpp::executors::SingleThreadedExecutor> executor_;
  std::promise<void> closing_;
  std::thread thread_;
  rclcpp::TimerBase::SharedPtr timer_;
  rclcpp::Publisher<Message>::SharedPtr states_, commands_;
  rclcpp::Publisher<Diagnostics>::SharedPtr diagnostics_;
  int ticks_ = 0;
};

}  // namespace {{ package }}

#endif  // CONTROLLER_HPP_
