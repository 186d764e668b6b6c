// What a test calls of an exported controller, by ctypes.
#include <sstream>
#include <string>

#include "controller.hpp"

using {{ package }}::HpidController;
using rclcpp_lifecycle::LifecycleNode;
using rclcpp_lifecycle::State;

namespace
{

const State kBefore(1, "unconfigured");

const char * kept(const std::string & text)
{
  static std::string last;
  last = text;
  return last.c_str();
}

template <typename Message>
void send(const char * topic, const Message & message)
{
  const auto [first, last] = rclcpp::graph().subscriptions.equal_range(topic);
  for (auto each = first; each != last; ++each) {
    each->second(&message);
  }
}

bool is_good(HpidController::CallbackReturn result)
{
  return result == HpidController::CallbackReturn::SUCCESS;
}

}  // namespace

extern "C" {

/// Returns a configured controller, nullptr if it refuses.
HpidController * make(bool is_chained, unsigned int update_rate = 0)
{
  rclcpp::graph().update_rate = update_rate;
  rclcpp::graph().subscriptions.clear();
  rclcpp::graph().timers.clear();
  rclcpp::graph().log.clear();
  rclcpp::graph().joint_states.clear();
  auto * controller = new HpidController;
  if (!is_good(controller->on_init()) || !is_good(controller->on_configure(kBefore))) {
    delete controller;
    return nullptr;
  }
  controller->prepare(is_chained);
  return controller;
}

void destroy(HpidController * controller) { delete controller; }

bool activate(HpidController * c) { return is_good(c->on_activate(kBefore)); }

bool deactivate(HpidController * c) { return is_good(c->on_deactivate(kBefore)); }

bool cleanup(HpidController * c) { return is_good(c->on_cleanup(kBefore)); }

/// One cycle. Numbers of the joints: position and velocity of each; what comes of it: the efforts.
void update(
  HpidController * c, std::int64_t stamp_ns, std::int64_t period_ns, const double * states,
  double * efforts)
{
  for (auto & each : c->state_interfaces_) {
    each.set_value(*states++);
  }
  const rclcpp::Time time(stamp_ns);
  const rclcpp::Duration period(period_ns);
  rclcpp::graph().steady_ns += period_ns;
  c->update_reference_from_subscribers(time, period);
  c->update_and_write_commands(time, period);
  for (const auto & each : c->command_interfaces_) {
    *efforts++ = *each.get_optional();
  }
}

void ask(HpidController * c, const double * references)
{
  for (const auto & each : c->ordered_exported_reference_interfaces_) {
    each->set_value(*references++);
  }
}

void set_chained(HpidController * c, bool is_chained) { c->prepare(is_chained); }

void set_busy(HpidController * c, bool is_busy) { c->state_interfaces_.front().is_busy = is_busy; }

void set_type(HpidController * c, bool is_double)
{
  c->state_interfaces_.front().is_of_another_type = !is_double;
}

/// Returns whether a cycle throws where a state is no double.
bool cannot_read(HpidController * c)
{
  const rclcpp::Time time(0);
  const rclcpp::Duration period(0);
  set_type(c, false);
  bool has_thrown = false;
  try {
    c->update_and_write_commands(time, period);
  } catch (const std::exception &) {
    has_thrown = true;
  }
  set_type(c, true);
  return has_thrown;
}

void keep_command(HpidController * c, int tries)
{
  c->command_interfaces_.front().busy_tries = tries;
}

void tick(int milliseconds)
{
  rclcpp::graph().steady_ns += 1000000 * milliseconds;
  for (const auto & each : rclcpp::graph().timers) {
    each();
  }
}

void override_number(const char * node, const char * name, double value)
{
  rclcpp::graph().overrides[node].insert_or_assign(name, value);
}

void override_text(const char * node, const char * name, const char * value)
{
  rclcpp::graph().overrides[node].insert_or_assign(name, std::string(value));
}

void override_flag(const char * node, const char * name, bool value)
{
  rclcpp::graph().overrides[node].insert_or_assign(name, value);
}

/// Returns why numbers are refused, empty if they are taken.
const char * set_numbers(
  const char * node, const char * const * names, const double * values, int count)
{
  LifecycleNode::Parameters changes;
  for (int k = 0; k < count; ++k) {
    changes.emplace_back(names[k], values[k]);
  }
  return kept(LifecycleNode::all().at(node)->set(changes));
}

const char * transition(const char * node, const char * which)
{
  auto * found = LifecycleNode::all().at(node);
  const std::string name = which;
  const auto & state = name == "activate" ? found->activate()
    : name == "deactivate"                ? found->deactivate()
    : name == "cleanup"                   ? found->cleanup()
                                          : found->shutdown();
  return kept(state.label());
}

const char * lifecycle(const char * node)
{
  return kept(LifecycleNode::all().at(node)->get_current_state().label());
}

void setpoint(const char * topic, double position)
{
  std_msgs::msg::Float64 message;
  message.data = position;
  send(topic, message);
}

/// Positions, velocities, accelerations and efforts of a joint: nullptr for none at all.
void trajectory(
  const char * topic, const char * joint, std::int64_t stamp_ns, int points,
  const std::int64_t * times_ns, const double * positions, const double * velocities,
  const double * accelerations, const double * efforts)
{
  trajectory_msgs::msg::JointTrajectory message;
  message.header.stamp = rclcpp::Duration(stamp_ns);
  std::istringstream names(joint);
  for (std::string name; names >> name;) {
    message.joint_names.push_back(name);
  }
  for (int k = 0; k < points; ++k) {
    trajectory_msgs::msg::JointTrajectoryPoint point;
    point.time_from_start = rclcpp::Duration(times_ns[k]);
    point.positions.assign(message.joint_names.size(), positions[k]);
    if (velocities != nullptr) {
      point.velocities = {velocities[k]};
    }
    if (accelerations != nullptr) {
      point.accelerations = {accelerations[k]};
    }
    if (efforts != nullptr) {
      point.effort = {efforts[k]};
    }
    message.points.push_back(point);
  }
  send(topic, message);
}

/// Takes the oldest message of a topic of joint states: its joints, nullptr if there is none; its
/// stamp, and three numbers of each joint, NaN for none.
const char * take(const char * topic, std::int64_t * stamp_ns, double * numbers)
{
  auto & waiting = rclcpp::graph().joint_states[topic];
  if (waiting.empty()) {
    return nullptr;
  }
  const auto message = waiting.front();
  waiting.erase(waiting.begin());
  *stamp_ns = rclcpp::Time(message.header.stamp).nanoseconds();
  std::string names;
  for (std::size_t k = 0; k < message.name.size(); ++k) {
    names += message.name[k] + " ";
    for (const auto * each : {&message.position, &message.velocity, &message.effort}) {
      *numbers++ = k < each->size() ? (*each)[k] : {{ package }}::kNaN;
    }
  }
  return kept(names);
}

/// Returns the level and the line of the newest health of a node.
const char * verdict(const char * node)
{
  for (const auto & status : rclcpp::graph().health.status) {
    if (status.name == node) {
      return kept(std::to_string(status.level) + " " + status.message);
    }
  }
  return "";
}

/// Returns what the newest health of a node says of a key.
const char * health(const char * node, const char * key)
{
  for (const auto & status : rclcpp::graph().health.status) {
    for (const auto & each : status.values) {
      if (status.name == node && each.key == key) {
        return kept(each.value);
      }
    }
  }
  return "";
}

const char * logged()
{
  std::string all;
  for (const auto & line : rclcpp::graph().log) {
    all += line + "\n";
  }
  rclcpp::graph().log.clear();
  return kept(all);
}

}  // extern "C"
