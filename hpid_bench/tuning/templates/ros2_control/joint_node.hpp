// One joint on the graph: its parameters, references and health, as hpid_ros' joint_controller.
#ifndef JOINT_NODE_HPP_
#define JOINT_NODE_HPP_

#include <atomic>
#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "diagnostic_msgs/msg/diagnostic_status.hpp"
#include "joint.hpp"
#include "rclcpp_lifecycle/lifecycle_node.hpp"
#include "sensor_msgs/msg/joint_state.hpp"
#include "std_msgs/msg/float64.hpp"
#include "trajectory_msgs/msg/joint_trajectory.hpp"
#include "{{ package }}/{{ package }}_parameters.hpp"

namespace {{ package }}
{

/// All but joint() is of the thread that spins the node.
class JointNode
{
public:
  /// Throws std::invalid_argument for parameters that are no loop's, or not certified.
  JointNode(
    const std::string & joint, const std::string & space, const rclcpp::NodeOptions & options,
    unsigned int rate, const std::atomic<bool> & is_controller_active,
    const std::atomic<bool> & is_chained);

  Joint & joint() { return *joint_; }

  rclcpp_lifecycle::LifecycleNode::SharedPtr node() { return node_; }

  /// Brings the node's lifecycle in line with whether its joint is controlled.
  void follow_lifecycle();

  /// Publishes ~/reference and ~/terms of a sample, as often as introspection_rate asks for.
  void introspect(const Record & record);

  diagnostic_msgs::msg::DiagnosticStatus status() const;

private:
  using Parameters = std::vector<rclcpp::Parameter>;
  using Transition = rclcpp_lifecycle::node_interfaces::LifecycleNodeInterface::CallbackReturn;

  Settings with(const Parameters & changes) const;
  std::string why_not(const Settings & settings) const;
  std::string line() const;
  rcl_interfaces::msg::SetParametersResult allow(const Parameters & changes);
  void on_trajectory(const trajectory_msgs::msg::JointTrajectory & message);
  void on_setpoint(double position);
  bool is_controlled() const;
  bool may_move(const char * what);
  void refuse(const std::string & line);

  std::string name_;
  rclcpp_lifecycle::LifecycleNode::SharedPtr node_;
  std::unique_ptr<ParamListener> parameters_;
  std::unique_ptr<Joint> joint_;
  Settings settings_;  // set last
  const unsigned int rate_;  // [Hz] of the controller's updates; 0 where nobody knows
  const std::atomic<bool> & is_controller_active_;
  const std::atomic<bool> & is_chained_;
  bool is_following_ = false;  // its lifecycle, by itself
  bool has_moved_ = false;     // a reference has come since it was activated
  std::string last_fault_ = "none";
  std::uint64_t refused_ = 0;
  std::int64_t introspected_ns_ = 0;
  rclcpp::Publisher<sensor_msgs::msg::JointState>::SharedPtr reference_, terms_;
  rclcpp::Subscription<trajectory_msgs::msg::JointTrajectory>::SharedPtr trajectories_;
  rclcpp::Subscription<std_msgs::msg::Float64>::SharedPtr setpoints_;
  rclcpp_lifecycle::LifecycleNode::OnSetParametersCallbackHandle::SharedPtr on_set_;
  rclcpp_lifecycle::LifecycleNode::PostSetParametersCallbackHandle::SharedPtr on_changed_;
};

}  // namespace {{ package }}

#endif  // JOINT_NODE_HPP_
