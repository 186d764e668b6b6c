#include "joint_node.hpp"

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <stdexcept>

#include "certificate.hpp"
#include "lifecycle_msgs/msg/state.hpp"
#include "lifecycle_msgs/msg/transition.hpp"
#include "parameters.hpp"

namespace {{ package }}
{

namespace
{

constexpr std::size_t kMostPoints = 50000;
const std::string kTooMany = "64 wait already for their beginning, or for the control loop";
constexpr std::int64_t kGrace_ns = {{ grace_ns }};  // a trajectory may have ended so long ago
constexpr std::int64_t kLongestWait_ns = {{ longest_wait_ns }};
constexpr std::int64_t kLatchedWithin_ns = {{ latched_within_ns }};  // of the first cycle
constexpr double kLeastRate = 0.95;  // of the controller's updates, of the one by control_period

/// Returns why a joint's column of a trajectory cannot be followed; empty, and the motion, if it can.
std::string column(
  const trajectory_msgs::msg::JointTrajectory & message, std::size_t at, Motion & motion)
{
  const std::size_t joints = message.joint_names.size();
  if (message.header.stamp.sec < 0) {
    return "its stamp is negative";
  }
  motion.is_setpoint = false;
  motion.stamp_ns = rclcpp::Time(message.header.stamp).nanoseconds();
  motion.knots.clear();
  if (message.points.empty() || message.points.size() > kMostPoints) {
    return "it has " + std::to_string(message.points.size()) + " points: 1 to " +
      std::to_string(kMostPoints) + " are allowed";
  }
  for (const auto & point : message.points) {
    const auto number = "point " + std::to_string(motion.knots.size());
    const auto is_or_none = [joints](const std::vector<double> & values) {
      return values.empty() || values.size() == joints;
    };
    if (
      point.positions.size() != joints || !is_or_none(point.velocities) ||
      !is_or_none(point.accelerations) || !is_or_none(point.effort)) {
      return number + " has other than one number for each joint";
    }
    Knot knot;
    knot.time_ns = rclcpp::Duration(point.time_from_start).nanoseconds();
    knot.position = point.positions[at];
    knot.velocity = point.velocities.empty() ? kNaN : point.velocities[at];
    knot.acceleration = point.accelerations.empty() ? kNaN : point.accelerations[at];
    const auto is_bad = [](const std::vector<double> & values) {
      return std::any_of(
        values.begin(), values.end(), [](double value) { return !(std::abs(value) <= kLargest); });
    };
    if (
      is_bad(point.positions) || is_bad(point.velocities) || is_bad(point.accelerations) ||
      is_bad(point.effort)) {
      return number + " has a number that is not finite, or beyond 1e9";
    }
    const bool is_first = motion.knots.empty();
    if (is_first ? knot.time_ns < -motion.stamp_ns : knot.time_ns <= motion.knots.back().time_ns) {
      return "times must increase; " + number + " has " + std::to_string(knot.time_ns) + " ns";
    }
    motion.knots.push_back(knot);
  }
  motion.pace = pace_of(motion.knots);
  return "";
}

/// Returns why a trajectory of another time is not followed, as hpid_ros has it; empty if it is.
/// now_ns is 0 before the first cycle. One that has ended may let a joint that begins carry on.
std::string untimely(const Motion & motion, std::int64_t now_ns, bool carries_on)
{
  if (motion.stamp_ns == 0 || now_ns == 0) {
    return "";
  }
  const std::int64_t end_ns = motion.stamp_ns + motion.knots.back().time_ns;
  char shown[192] = "";
  if (end_ns + kGrace_ns < now_ns && !carries_on) {
    std::snprintf(
      shown, sizeof shown, "the trajectory ended at %.3f s, in the past: it is %.3f s now",
      static_cast<double>(end_ns) * 1e-9, static_cast<double>(now_ns) * 1e-9);
  } else if (motion.stamp_ns > now_ns + kLongestWait_ns) {
    std::snprintf(
      shown, sizeof shown,
      "the trajectory must start within %lld s, not at %.3f s: it is %.3f s now",
      static_cast<long long>(kLongestWait_ns / 1000000000),
      static_cast<double>(motion.stamp_ns) * 1e-9, static_cast<double>(now_ns) * 1e-9);
  }
  return shown;
}

/// Returns which values exclude each other, of settings that the loop does not accept.
std::string conflict(const Settings & s)
{
  constexpr double kNone = {{ largest_motion|double }};  // a limit of motion that is none
  const bool has_stop = s.position_min > -kNone || s.position_max < kNone;
  const bool is_semi_implicit = s.discretization != {{ C }}_DISCRETIZATION_EXPLICIT;
  if (const auto name = not_a_number(s); !name.empty()) {
    return name + " is not a number";
  }
  if (s.u_clamp_min > s.u_clamp_max) {
    return "u_clamp_min must not exceed u_clamp_max";
  }
  if (s.i_clamp_min > s.i_clamp_max) {
    return "i_clamp_min must not exceed i_clamp_max";
  }
  if (s.position_min > s.position_max) {
    return "position_min must not exceed position_max";
  }
  if (s.angle_wraparound && (has_stop || s.multi_turn)) {
    return "angle_wraparound is not for joints with stops or multi_turn";
  }
  if (s.state_timeout < 1.5 * s.control_period) {
    return "state_timeout must be at least 1.5 times control_period";
  }
  if (!(std::abs(s.mu) < 0.5)) {
    return "mu must be strictly within (-0.5, 0.5)";
  }
  if (s.inertia > 0.0 && !(s.gains_p * s.gains_d > s.inertia * s.gains_i)) {
    return "unstable as a linear PID: p d must exceed i x inertia";
  }
  if (is_semi_implicit && !(s.inertia > 0.0)) {
    return "semi_implicit needs the inertia";
  }
  if (s.norm_effort_scale > 0.0 && !(s.gains_p > 0.0 && s.gains_d > 0.0)) {
    return "norm.effort_scale weighs by gains.p and gains.d: neither may be 0";
  }
  return "a value is out of its range, norm.effort_scale is given beside norm.error_scale or "
         "norm.rate_weight, or the norm has no room below norm.cap";
}

diagnostic_msgs::msg::KeyValue value(const std::string & key, const std::string & text)
{
  diagnostic_msgs::msg::KeyValue found;
  found.key = key;
  found.value = text;
  return found;
}

}  // namespace

JointNode::JointNode(
  const std::string & joint, const std::string & space, const rclcpp::NodeOptions & options,
  unsigned int rate, const std::atomic<bool> & is_controller_active,
  const std::atomic<bool> & is_chained)
: name_(joint),
  node_(std::make_shared<rclcpp_lifecycle::LifecycleNode>(joint + "_controller", space, options)),
  parameters_(std::make_unique<ParamListener>(node_)),
  rate_(rate),
  is_controller_active_(is_controller_active),
  is_chained_(is_chained)
{
  Parameters all;
  for (const auto & name : kSettings) {
    all.push_back(node_->get_parameter(name));
  }
  settings_ = with(all);
  const auto params = parameters_->get_params();
  const auto reason = params.joint == joint  ? why_not(settings_)
                      : params.joint.empty() ? "it is not a joint of this package"
                                             : "parameter joint must be it, not " + params.joint;
  if (!reason.empty()) {
    throw std::invalid_argument(joint + ": " + reason);
  }
  joint_ = std::make_unique<Joint>(settings_);
  RCLCPP_INFO(node_->get_logger(), "%s", line().c_str());

  on_set_ = node_->add_on_set_parameters_callback(
    [this](const Parameters & changes) { return allow(changes); });
  on_changed_ = node_->add_post_set_parameters_callback(
    [this](const Parameters & changes) {
      settings_ = with(changes);
      if (auto * place = joint_->retunings.back()) {
        *place = settings_;
        joint_->retunings.push();
      }
      RCLCPP_INFO(node_->get_logger(), "%s", line().c_str());
    });
  node_->register_on_activate([this](const rclcpp_lifecycle::State &) {
    if (!is_controller_active_) {
      refuse("cannot be activated: the controller of ros2_control is not active");
      return Transition::FAILURE;
    }
    joint_->is_enabled = true;
    return Transition::SUCCESS;
  });
  const auto leave = [this](const rclcpp_lifecycle::State &) {
    joint_->is_enabled = joint_->is_enabled && is_following_;
    return Transition::SUCCESS;
  };
  node_->register_on_deactivate(leave);
  node_->register_on_cleanup(leave);
  node_->register_on_shutdown(leave);
  node_->configure();

  const auto deep = rclcpp::QoS(params.introspection_rate < 0.0 ? 4000 : 10);
  using sensor_msgs::msg::JointState;
  reference_ = rclcpp::create_publisher<JointState>(node_, "~/reference", deep);
  terms_ = rclcpp::create_publisher<JointState>(node_, "~/terms", deep);
  trajectories_ = node_->create_subscription<trajectory_msgs::msg::JointTrajectory>(
    "joint_trajectory", rclcpp::QoS(1).transient_local(),
    [this](const trajectory_msgs::msg::JointTrajectory & message) { on_trajectory(message); });
  setpoints_ = node_->create_subscription<std_msgs::msg::Float64>(
    "~/setpoint", rclcpp::QoS(10),
    [this](const std_msgs::msg::Float64 & message) { on_setpoint(message.data); });
}

Settings JointNode::with(const Parameters & changes) const
{
  Settings settings = settings_;
  for (const auto & each : changes) {
    assign(settings, each);
  }
  return settings;
}

std::string JointNode::line() const
{
  const bool is_linear = settings_.law == {{ C }}_LAW_PID;
  char shown[192];
  std::snprintf(
    shown, sizeof shown, "%s, mu %g, gains %g, %g, %g, effort %g to %g, certified",
    is_linear ? "pid" : "hpid", settings_.mu, settings_.gains_p, settings_.gains_i,
    settings_.gains_d, settings_.u_clamp_min, settings_.u_clamp_max);
  return shown;
}

std::string JointNode::why_not(const Settings & settings) const
{
  if (!Joint::accepts(settings)) {
    return conflict(settings);
  }
  if (rate_ > 0 && rate_ * settings.control_period < kLeastRate) {
    char shown[128];
    std::snprintf(
      shown, sizeof shown, "control_period %g s is too short: the controller is updated at %u Hz",
      settings.control_period, rate_);
    return shown;
  }
  return refusal(name_, settings);
}

rcl_interfaces::msg::SetParametersResult JointNode::allow(const Parameters & changes)
{
  rcl_interfaces::msg::SetParametersResult result;
  result.reason = why_not(with(changes));
  if (result.reason.empty() && joint_->retunings.back() == nullptr) {
    result.reason = is_controller_active_
      ? "sets come faster than the control loop applies them"
      : "64 sets wait for the controller to be activated: no more are taken before";
  }
  result.successful = result.reason.empty();
  return result;
}

void JointNode::on_trajectory(const trajectory_msgs::msg::JointTrajectory & message)
{
  const auto & names = message.joint_names;
  const auto found = std::find(names.begin(), names.end(), name_);
  if (found == names.end() || !may_move("a trajectory")) {
    return;
  }
  const auto at = static_cast<std::size_t>(found - names.begin());
  Motion * const place = joint_->motions.back();
  auto reason = place != nullptr ? column(message, at, *place) : kTooMany;
  auto sorted = names;
  std::sort(sorted.begin(), sorted.end());
  if (std::adjacent_find(sorted.begin(), sorted.end()) != sorted.end()) {
    reason = "it names a joint twice";
  }
  const std::int64_t now_ns = joint_->clock_ns;
  const bool carries_on = !has_moved_ && now_ns - joint_->begun_ns < kLatchedWithin_ns;
  if (reason.empty()) {
    reason = untimely(*place, now_ns, carries_on);
  }
  if (!reason.empty()) {
    refuse("trajectory refused: " + reason);
    return;
  }
  has_moved_ = true;
  joint_->motions.push();
}

void JointNode::on_setpoint(double position)
{
  if (!may_move("a setpoint")) {
    return;
  }
  if (!(std::abs(position) <= kLargest)) {
    refuse("setpoint refused: it is not finite, or beyond 1e9");
    return;
  }
  Motion * const motion = joint_->motions.back();
  if (motion == nullptr) {
    refuse("setpoint refused: " + kTooMany);
    return;
  }
  motion->knots.assign(1, Knot());
  motion->knots.front().position = position;
  motion->stamp_ns = 0;
  motion->is_setpoint = true;
  motion->pace = pace_of(motion->knots);
  motion->pace.lead = 0.0;
  has_moved_ = true;
  joint_->motions.push();
}

bool JointNode::may_move(const char * what)
{
  if (is_chained_) {
    refuse(std::string(what) + " refused: another controller gives the references");
    return false;
  }
  if (!is_controlled()) {
    refuse(std::string(what) + " refused: the joint is not active");
    return false;
  }
  return true;
}

void JointNode::refuse(const std::string & line)
{
  last_fault_ = line;
  ++refused_;
  RCLCPP_WARN(node_->get_logger(), "%s", line.c_str());
}

void JointNode::follow_lifecycle()
{
  using lifecycle_msgs::msg::State;
  using lifecycle_msgs::msg::Transition;
  const auto state = node_->get_current_state().id();
  const Raised following(is_following_);
  if (is_controlled() && state == State::PRIMARY_STATE_INACTIVE) {
    node_->activate();
  } else if (!is_controlled() && state == State::PRIMARY_STATE_ACTIVE) {
    node_->deactivate();
    has_moved_ = false;
  }
}

bool JointNode::is_controlled() const { return joint_->is_enabled && is_controller_active_; }

void JointNode::introspect(const Record & record)
{
  const double rate = parameters_->get_params().introspection_rate;
  const auto period_ns = rate > 0.0 ? static_cast<std::int64_t>(1e9 / rate) : 0;
  const auto since_ns = record.stamp_ns - introspected_ns_;
  if (rate == 0.0 || (since_ns >= 0 && since_ns < period_ns)) {
    return;
  }
  introspected_ns_ = record.stamp_ns;
  sensor_msgs::msg::JointState message;
  message.header.stamp = rclcpp::Time(record.stamp_ns);
  message.name = {name_};
  message.position = {record.reference.position};
  message.velocity = {record.reference.velocity};
  reference_->publish(message);
  message.name = {"p", "i", "d", "feedforward"};
  message.position.clear();
  message.velocity.clear();
  message.effort = {record.terms[0], record.terms[1], record.terms[2], 0.0};
  terms_->publish(message);
}

diagnostic_msgs::msg::DiagnosticStatus JointNode::status() const
{
  using diagnostic_msgs::msg::DiagnosticStatus;
  DiagnosticStatus found;
  const auto state = node_->get_current_state();
  found.name = node_->get_fully_qualified_name();
  found.hardware_id = name_;
  found.level = refused_ > 0 || joint_->faults > 0 ? DiagnosticStatus::WARN : DiagnosticStatus::OK;
  found.message = state.label();
  if (is_controlled() && joint_->is_silent) {
    found.level = DiagnosticStatus::ERROR;
    found.message = "no new state: fallback_effort";
  } else if (is_controlled() && joint_->is_conflicting) {
    found.level = DiagnosticStatus::ERROR;
    found.message = "states of " + name_ + " come from two sources: fallback_effort";
  }
  found.values = {
    value("lifecycle", state.label()),
    value("law", settings_.law == {{ C }}_LAW_PID ? "pid" : "hpid"),
    value("degree mu", std::to_string(settings_.mu)),
    value("certified degrees", "by the certificate of {{ package }}"),
    value("samples", std::to_string(joint_->samples)),
    value("missed samples", std::to_string(joint_->missed)),
    value("silences", std::to_string(joint_->silences)),
    value("state conflicts", std::to_string(joint_->conflicts)),
    value("rejected samples", std::to_string(joint_->faults)),
    value("refused references", std::to_string(refused_)),
    value("last fault", last_fault_)};
  return found;
}

}  // namespace {{ package }}
