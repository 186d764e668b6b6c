#include "reference.hpp"

#include <algorithm>
#include <cmath>

namespace {{ package }}
{

namespace
{

constexpr std::int64_t kForever = std::numeric_limits<std::int64_t>::max();

double seconds(std::int64_t nanoseconds) { return static_cast<double>(nanoseconds) * 1e-9; }

}  // namespace

double whole_turns(double away, double turn)
{
  if (turn == 0.0) {
    return 0.0;
  }
  const double turns = std::ceil(std::abs(away / turn) - 0.5 - 1e-9);
  return std::copysign(turn * std::max(turns, 0.0), away);
}

void Follower::stand(double position)
{
  *this = Follower();
  offset_ = position;
}

void Follower::hold(double position)
{
  const bool is_first = is_first_;
  stand(position);
  is_first_ = is_first;
}

void Follower::follow(
  const Motion & motion, std::int64_t now_ns, std::int64_t ahead_ns, const Reference & here,
  double turn, double lost_turn, double takeover_time)
{
  const Knot & first = motion.knots.front();
  motion_ = &motion;
  start_ns_ = motion.stamp_ns != 0 ? motion.stamp_ns - ahead_ns : now_ns;
  offset_ = 0.0;
  from_ns_ = to_ns_ = 0;
  is_gliding_ = has_before_ = false;
  const std::int64_t since_ns = now_ns - start_ns_;
  const bool is_under_way =
    !motion.is_setpoint && motion.stamp_ns != 0 && since_ns > first.time_ns;
  const double target = is_under_way ? on_motion(now_ns).position : first.position;
  offset_ = whole_turns(
    here.position - target, turn == 0.0 && is_first_ && is_under_way ? lost_turn : turn);
  is_first_ = false;
  if (is_under_way) {
    const Reference onto = on_motion(now_ns);
    is_gliding_ = takeover_time > 0.0 &&
      (onto.position != here.position || onto.velocity != here.velocity);
    glide_ns_ = now_ns;
    glide_duration_ = takeover_time;
    away_ = here.position - onto.position;
    carried_ = (here.velocity - onto.velocity) * takeover_time;
  } else if (!motion.is_setpoint && since_ns < first.time_ns) {
    has_before_ = true;
    before_.time_ns = since_ns;
    before_.position = here.position - offset_;
    before_.velocity = here.velocity;
    before_.acceleration = std::isnan(first.acceleration) ? kNaN : 0.0;
  }
}

Reference Follower::sample(std::int64_t stamp_ns)
{
  if (motion_ == nullptr) {
    return {offset_, 0.0};
  }
  Reference found = on_motion(stamp_ns);
  if (is_gliding_) {
    const double T = glide_duration_;
    const double s = seconds(stamp_ns - glide_ns_) / T;
    is_gliding_ = s < 1.0;
    if (is_gliding_ && s >= 0.0) {
      const double squared = s * s;
      const double cubed = squared * s;
      found.position += away_ * (1.0 - cubed * (10.0 - 15.0 * s + 6.0 * squared)) +
        carried_ * (s - cubed * (6.0 - 8.0 * s + 3.0 * squared));
      found.velocity += away_ / T * (-30.0 * squared * (1.0 - 2.0 * s + squared)) +
        carried_ / T * (1.0 - squared * (18.0 - 32.0 * s + 15.0 * squared));
    }
  }
  return found;
}

Reference Follower::on_motion(std::int64_t stamp_ns)
{
  if (stamp_ns < from_ns_ || stamp_ns >= to_ns_) {
    enter(stamp_ns);
  }
  const double t = seconds(stamp_ns - from_ns_);
  return {
    c_[0] + t * (c_[1] + t * (c_[2] + t * (c_[3] + t * (c_[4] + t * c_[5])))) + offset_,
    c_[1] + t * (2.0 * c_[2] + t * (3.0 * c_[3] + t * (4.0 * c_[4] + t * 5.0 * c_[5])))};
}

void Follower::enter(std::int64_t stamp_ns)
{
  const auto & knots = motion_->knots;
  const std::int64_t since_ns = stamp_ns - start_ns_;
  const auto right = std::upper_bound(
    knots.begin(), knots.end(), since_ns,
    [](std::int64_t time_ns, const Knot & knot) { return time_ns < knot.time_ns; });
  std::fill(std::begin(c_), std::end(c_), 0.0);
  if (motion_->is_setpoint || right == knots.end()) {
    from_ns_ = motion_->is_setpoint ? stamp_ns : start_ns_ + knots.back().time_ns;
    to_ns_ = kForever;
    c_[0] = knots.back().position;
  } else if (right != knots.begin()) {
    set_segment(*(right - 1), *right);
  } else if (has_before_ && since_ns >= before_.time_ns) {
    set_segment(before_, *right);
  } else {  // before all of it
    from_ns_ = stamp_ns;
    to_ns_ = start_ns_ + (has_before_ ? before_ : *right).time_ns;
    c_[0] = (has_before_ ? before_ : *right).position;
  }
}

void Follower::set_segment(const Knot & left, const Knot & right)
{
  from_ns_ = start_ns_ + left.time_ns;
  to_ns_ = start_ns_ + right.time_ns;
  const double T = seconds(right.time_ns - left.time_ns);
  const double distance = right.position - left.position;
  const double v0 = left.velocity, v1 = right.velocity;
  const double a0 = left.acceleration, a1 = right.acceleration;
  c_[0] = left.position;
  if (std::isnan(v0) || std::isnan(v1)) {
    c_[1] = distance / T;
    return;
  }
  c_[1] = v0;
  if (std::isnan(a0) || std::isnan(a1)) {
    c_[2] = (3.0 * distance - (2.0 * v0 + v1) * T) / (T * T);
    c_[3] = (-2.0 * distance + (v0 + v1) * T) / (T * T * T);
    return;
  }
  c_[2] = 0.5 * a0;
  c_[3] = (20.0 * distance - (12.0 * v0 + 8.0 * v1) * T - (3.0 * a0 - a1) * T * T) /
    (2.0 * T * T * T);
  c_[4] = (-30.0 * distance + (16.0 * v0 + 14.0 * v1) * T + (3.0 * a0 - 2.0 * a1) * T * T) /
    (2.0 * T * T * T * T);
  c_[5] = (12.0 * distance - 6.0 * (v0 + v1) * T - (a0 - a1) * T * T) / (2.0 * T * T * T * T * T);
}

}  // namespace {{ package }}
