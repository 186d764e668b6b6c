#include "reference.hpp"

#include <algorithm>
#include <cmath>

namespace {{ package }}
{

namespace
{

constexpr std::int64_t kForever = std::numeric_limits<std::int64_t>::max();
constexpr std::int64_t kStream = 1000000000;  // [ns] a message so long after an end is of its stream
constexpr double kPeak = 1.875;     // largest rate of a smooth step
constexpr double kGentle = 0.2;     // of the motion's own speed
constexpr double kSlow = 0.25;       // of a motion's largest velocity: it has hardly begun
constexpr double kSwing = 0.1755;   // largest way of an offset that begins with a velocity
constexpr double kLongest = 3600.0;  // [s] of a glide
constexpr double kBeyondByVelocity = 0.18, kBeyondByAcceleration = 0.02;
// Python's powers are not products to the last bit, and a compiler that knows the exponent makes
// them that.
const volatile double kTwo = 2.0, kThree = 3.0, kFour = 4.0, kFive = 5.0;
constexpr double kSteepestCubic = 3.0, kSteepestQuintic = 2.5;

double seconds(std::int64_t nanoseconds) { return static_cast<double>(nanoseconds) * 1e-9; }

std::int64_t nanoseconds(double duration)
{
  return static_cast<std::int64_t>(std::nearbyint(duration / 1e-9));
}

double glide_time(double distance, double duration, double fastest)
{
  if (duration == 0.0) {
    return 0.0;
  }
  return std::min(std::max(duration, kPeak * std::abs(distance) / fastest), kLongest);
}

double own_speed(const Pace & pace, double away)
{
  if (pace.fastest != 0.0) {
    return pace.fastest;
  }
  return pace.lead != 0.0 ? std::abs(away) / pace.lead : 0.0;
}

/// Returns where the way to a first point begins: as it stands, but no faster than fits.
Knot approach_from(const Knot & start, const Knot & first)
{
  const bool is_quintic = !std::isnan(first.acceleration);
  const double slope = (first.position - start.position) / seconds(first.time_ns - start.time_ns);
  const double steepest = (is_quintic ? kSteepestQuintic : kSteepestCubic) * slope;
  Knot found = start;
  found.velocity =
    std::min(std::max(start.velocity, std::min(steepest, 0.0)), std::max(steepest, 0.0));
  found.acceleration = is_quintic ? 0.0 : kNaN;
  return found;
}

double or_nothing(double value) { return std::isnan(value) ? 0.0 : std::abs(value); }

}  // namespace

Pace pace_of(const std::vector<Knot> & knots)
{
  Pace pace;
  pace.lowest = pace.highest = knots.front().position;
  for (const Knot & knot : knots) {
    pace.given = std::max(pace.given, or_nothing(knot.velocity));
  }
  pace.fastest = pace.given;
  if (knots.size() == 1) {
    pace.lead = std::max(seconds(knots.front().time_ns), 0.0);
    return pace;
  }
  pace.lowest = kInfinite;
  pace.highest = -kInfinite;
  for (std::size_t k = 0; k + 1 < knots.size(); ++k) {
    const Knot & left = knots[k];
    const Knot & right = knots[k + 1];
    const double span = seconds(right.time_ns - left.time_ns);
    pace.fastest = std::max(pace.fastest, std::abs((right.position - left.position) / span));
    double beyond =
      kBeyondByVelocity * (or_nothing(left.velocity) + or_nothing(right.velocity)) * span;
    beyond = beyond +
      kBeyondByAcceleration * (or_nothing(left.acceleration) + or_nothing(right.acceleration)) *
        span * span;
    pace.lowest = std::min(pace.lowest, std::min(left.position, right.position) - beyond);
    pace.highest = std::max(pace.highest, std::max(left.position, right.position) + beyond);
  }
  return pace;
}

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
  turns_ = position;
}

void Follower::hold(double position)
{
  const bool is_first = is_first_;
  stand(position);
  is_first_ = is_first;
}

void Follower::rest(double position)
{
  motion_ = nullptr;
  turns_ = position;
  glide_.is_there = false;
  fading_ = 0;
}

std::int64_t Follower::begin_of(const Waiting & waiting, std::int64_t now_ns)
{
  return waiting.is_at_once ? now_ns : std::max(waiting.begin_ns, now_ns);
}

void Follower::receive(const Motion & motion, const Terms & terms)
{
  Waiting came;
  came.motion = &motion;
  came.begin_ns = motion.stamp_ns + std::min<std::int64_t>(motion.knots.front().time_ns, 0);
  came.is_at_once = motion.is_setpoint || motion.stamp_ns == 0 || came.begin_ns == 0;
  came.begin_ns -= terms.ahead_ns;
  const std::int64_t begin_ns = begin_of(came, terms.now_ns);
  std::size_t kept = 0;
  while (kept < count_ && begin_of(waiting_[kept], terms.now_ns) < begin_ns) {
    ++kept;  // they are in the order of their beginnings
  }
  waiting_[kept] = came;  // there is room: no more come than the queue holds
  count_ = kept + 1;
}

bool Follower::uses(const Motion & motion) const
{
  const auto end = waiting_.begin() + static_cast<std::ptrdiff_t>(count_);
  return motion_ == &motion || std::any_of(waiting_.begin(), end, [&motion](const Waiting & each) {
    return each.motion == &motion;
  });
}

Reference Follower::sample(const Terms & terms)
{
  const std::int64_t now_ns = terms.now_ns;
  glide_.is_there = glide_.is_there && now_ns < glide_.end_ns;
  const auto faded = std::remove_if(
    offsets_.begin(), offsets_.begin() + static_cast<std::ptrdiff_t>(fading_),
    [now_ns](const Offset & each) { return now_ns >= each.end_ns; });
  fading_ = static_cast<std::size_t>(faded - offsets_.begin());
  while (count_ > 0 && begin_of(waiting_[0], now_ns) == now_ns) {
    const Motion & motion = *waiting_[0].motion;
    const bool is_in_time = waiting_[0].was_in_time;
    Terms then = terms;  // what was there in time begins in time, whenever the states come
    then.now_ns = is_in_time ? waiting_[0].begin_ns : now_ns;
    std::move(
      waiting_.begin() + 1, waiting_.begin() + static_cast<std::ptrdiff_t>(count_),
      waiting_.begin());
    --count_;
    begin(motion, is_in_time, then);
  }
  for (std::size_t k = 0; k < count_; ++k) {
    waiting_[k].was_in_time = true;
  }
  return at(now_ns);
}

Follower::Here Follower::here(const Terms & terms)
{
  const std::int64_t now_ns = terms.now_ns;
  Here found;
  const Reference stands = at(now_ns);
  found.position = stands.position;
  found.velocity = stands.velocity;
  const bool is_timed = motion_ != nullptr && !motion_->is_setpoint;
  const bool is_of_stream = is_timed && now_ns - end_ns() <= kStream;
  found.pace = motion_ != nullptr ? motion_->pace : Pace();
  found.turns = motion_ != nullptr ? turns_ : 0.0;
  const double inside = std::clamp(stands.position + terms.turns, terms.low, terms.high);
  if (inside != stands.position + terms.turns) {  // at a stop the reference rests
    found.position = inside - terms.turns;
    found.velocity = 0.0;
    rest(found.position);
  }
  found.motion = on_motion(now_ns);
  found.joined = joined(now_ns, &found.is_held).position;
  found.offset_end_ns = now_ns;
  for (std::size_t k = 0; k < fading_; ++k) {
    found.offset_end_ns = std::max(found.offset_end_ns, offsets_[k].end_ns);
  }
  found.glide_end_ns = glide_.is_there ? glide_.end_ns : now_ns;
  const bool is_gliding = glide_.is_there && now_ns < glide_.end_ns;
  found.is_running = is_gliding || is_of_stream;
  found.has_ended = motion_ == nullptr || motion_->is_setpoint || now_ns >= end_ns();
  return found;
}

void Follower::begin(const Motion & motion, bool is_in_time, const Terms & terms)
{
  const std::int64_t now_ns = terms.now_ns;
  const Here stands = here(terms);
  const Knot & first = motion.knots.front();
  motion_ = &motion;
  start_ns_ =
    motion.stamp_ns != 0 && !motion.is_setpoint ? motion.stamp_ns - terms.ahead_ns : now_ns;
  turns_ = 0.0;
  from_ns_ = to_ns_ = 0;
  has_before_ = false;
  const std::int64_t since_ns = now_ns - start_ns_;
  const bool is_under_way = !motion.is_setpoint && since_ns > first.time_ns;
  const bool is_exact = !motion.is_setpoint && since_ns == first.time_ns;
  const bool has_begun = is_under_way || is_exact;
  const bool goes_on = (is_exact && is_in_time) || (has_begun && stands.is_running);
  const double target = is_under_way ? on_motion(now_ns).position : first.position;
  const double nearest = goes_on ? stands.joined : stands.position;
  const double turn =
    terms.turn == 0.0 && is_first_ && is_under_way ? terms.lost_turn : terms.turn;
  turns_ = whole_turns(nearest - target, turn);
  is_first_ = false;
  if (goes_on) {
    go_on(stands, terms);
  } else if (is_under_way) {
    glide_onto(stands, terms);
  } else {
    glide_.is_there = false;
    fading_ = 0;
    if (!motion.is_setpoint && !is_exact) {
      Knot start;
      start.time_ns = since_ns;
      start.position = stands.position - turns_;
      start.velocity = stands.velocity;
      before_ = approach_from(start, first);
      has_before_ = true;
      from_ns_ = to_ns_ = 0;
      if (terms.takeover_time > 0.0) {
        approach(stands, terms);
      }
    }
  }
}

void Follower::glide_onto(const Here & here, const Terms & terms)
{
  const Reference onto = on_motion(terms.now_ns);
  const double away = here.position - onto.position;
  const double own = own_speed(motion_->pace, away);
  const double speed = std::min(own != 0.0 ? own : kInfinite, terms.fastest);
  const double length = glide_time(away, terms.takeover_time, speed);
  fading_ = 0;
  if (own != 0.0 && length > 0.0 && std::abs(onto.velocity) <= kSlow * own) {
    lowest_ = std::min(motion_->pace.lowest + turns_, here.position);
    highest_ = std::max(motion_->pace.highest + turns_, here.position);
    fade({away, -onto.velocity, 0.0, terms.now_ns, terms.now_ns + nanoseconds(length)});
    return;
  }
  glide_.is_there =
    length > 0.0 && (onto.position != here.position || onto.velocity != 0.0);
  glide_.position = here.position;
  glide_.begin_ns = terms.now_ns;
  glide_.end_ns = terms.now_ns + nanoseconds(length);
  glide_.duration = length;
}

void Follower::go_on(const Here & here, const Terms & terms)
{
  const std::int64_t now_ns = terms.now_ns;
  const double duration = terms.takeover_time;
  const Pace & pace = motion_->pace;
  const Reference onto = on_motion(now_ns);
  const double jump = (here.is_held ? here.joined : here.motion.position) - onto.position;
  lowest_ = std::min(pace.lowest + turns_, here.joined);
  highest_ = std::max(pace.highest + turns_, here.joined);
  if (here.is_held || duration == 0.0) {
    fading_ = 0;
  }
  if (duration == 0.0) {
    return;
  }
  const double speed = std::min(std::max(pace.fastest, here.pace.fastest), terms.fastest);
  const double away = here.position - onto.position;
  const double own = own_speed(pace, away);
  const double slow =
    speed != 0.0 ? speed : std::min(own != 0.0 ? own : kInfinite, terms.fastest);
  // As the first message of a stream may be slow, so may a glide be that is under way.
  const double whole = glide_time(away, duration, slow);
  if (std::max(here.glide_end_ns, here.offset_end_ns) > now_ns + nanoseconds(whole)) {
    glide_as_it_moves(here, onto, whole, now_ns);
    return;
  }
  if (jump == 0.0) {
    return;
  }
  const double length = glide_time(jump, duration, slow);
  if (speed != 0.0) {
    const double least = std::abs(jump) / speed;
    const double remaining = std::max(seconds(end_ns() - now_ns), least);
    const double near = std::min(kPeak / kGentle * least, remaining);
    if (near <= length) {
      fade_jump(jump, 0.0, near, now_ns);
      return;
    }
  }
  if (here.has_ended && !glide_.is_there) {
    fade_jump(jump, 0.0, length, now_ns);
  } else if (here.is_held || glide_.is_there) {
    glide_as_it_moves(here, onto, whole, now_ns);
  } else {
    fade_jump(jump, here.motion.velocity - onto.velocity, length, now_ns);
  }
}

void Follower::glide_as_it_moves(
  const Here & here, const Reference & onto, double length, std::int64_t now_ns)
{
  glide_.is_there = false;
  lowest_ = std::min(lowest_, here.position);
  highest_ = std::max(highest_, here.position);
  fading_ = 0;
  fade(
    {here.position - onto.position, here.velocity - onto.velocity, 0.0, now_ns,
     now_ns + nanoseconds(length)});
}

void Follower::fade(const Offset & offset)
{
  offsets_[0] = offset;
  fading_ = 1;
}

void Follower::fade_jump(double jump, double rate, double length, std::int64_t now_ns)
{
  std::int64_t end_ns = now_ns + nanoseconds(length);
  std::array<double, 3> left{};
  if (fading_ > 0) {
    const std::int64_t least_ns = offsets_[0].end_ns;
    left = offsets_[0].sample(now_ns);
    end_ns = std::max(end_ns, least_ns);
    const bool is_longer = rate != 0.0 || 2 * (end_ns - now_ns) > 3 * (least_ns - now_ns);
    if (is_longer && fading_ < kMostFading) {
      // What is under way ends when it would have ended.
      const auto end = offsets_.begin() + static_cast<std::ptrdiff_t>(fading_);
      std::move_backward(offsets_.begin() + 1, end, end + 1);
      offsets_[1] = {0.0, left[1], left[2], now_ns, least_ns};
      ++fading_;
      left[1] = left[2] = 0.0;
    }
  }
  if (end_ns > now_ns) {
    offsets_[0] = {left[0] + jump, left[1] + rate, left[2], now_ns, end_ns};
    fading_ = std::max<std::size_t>(fading_, 1);
  }
}

void Follower::approach(const Here & here, const Terms & terms)
{
  const std::int64_t now_ns = terms.now_ns;
  const Pace & pace = motion_->pace;
  const double position = here.position;
  const std::int64_t first_ns = start_ns_ + motion_->knots.front().time_ns;
  double length = seconds(first_ns - now_ns);
  const double middle = on_motion((now_ns + first_ns) / 2).velocity;
  const bool is_bounded = here.pace.lowest > -kInfinite;
  const double least = std::min(
    {pace.lowest + turns_, position, is_bounded ? here.pace.lowest + here.turns : position});
  const double most = std::max(
    {pace.highest + turns_, position, is_bounded ? here.pace.highest + here.turns : position});
  lowest_ = least;
  highest_ = most;
  if (std::abs(middle) > terms.fastest) {  // it could not follow: there in its own time
    has_before_ = false;
    from_ns_ = to_ns_ = 0;
    const double away = position - on_motion(now_ns).position;
    const std::int64_t end_ns = now_ns + nanoseconds(glide_time(away, length, terms.fastest));
    fade({away, here.velocity, 0.0, now_ns, end_ns});
    return;
  }
  const double excess = here.velocity - on_motion(now_ns).velocity;
  if (excess == 0.0) {
    return;
  }
  length = std::min(length, terms.takeover_time);
  if (here.offset_end_ns > now_ns) {
    length = std::min(length, seconds(here.offset_end_ns - now_ns));
  }
  const double explained = kSwing * here.pace.given * length;
  const double room = (excess > 0.0 ? most - position : position - least) + explained;
  length = std::min(length, room / (kSwing * std::abs(excess)));
  lowest_ = least - explained;
  highest_ = most + explained;
  const std::int64_t end_ns = now_ns + nanoseconds(length);
  if (end_ns > now_ns) {
    fade({0.0, excess, 0.0, now_ns, end_ns});
  }
}

std::array<double, 3> Follower::Offset::sample(std::int64_t stamp_ns) const
{
  if (stamp_ns < begin_ns || stamp_ns >= end_ns) {
    return {};
  }
  const double T = seconds(end_ns - begin_ns);
  const double a = position, b = velocity * T, c = acceleration * T * T;
  const double s = seconds(stamp_ns - begin_ns) / T;
  const double squared = s * s;
  const double cubed = squared * s;
  return {
    a * (1.0 - cubed * (10.0 - 15.0 * s + 6.0 * squared)) +
      b * (s - cubed * (6.0 - 8.0 * s + 3.0 * squared)) +
      c * squared * (0.5 - 1.5 * s + 1.5 * squared - 0.5 * cubed),
    (-30.0 * a * squared * (1.0 - 2.0 * s + squared) +
     b * (1.0 - squared * (18.0 - 32.0 * s + 15.0 * squared)) +
     c * s * (1.0 - 4.5 * s + 6.0 * squared - 2.5 * cubed)) /
      T,
    (-60.0 * a * s * (1.0 - 3.0 * s + 2.0 * squared) -
     b * s * (36.0 - 96.0 * s + 60.0 * squared) +
     c * (1.0 - 9.0 * s + 18.0 * squared - 10.0 * cubed)) /
      (T * T)};
}

Reference Follower::joined(std::int64_t stamp_ns, bool * is_held)
{
  const Reference onto = on_motion(stamp_ns);
  Reference found = onto;
  for (std::size_t k = 0; k < fading_; ++k) {
    const auto offset = offsets_[k].sample(stamp_ns);
    found.position += offset[0];
    found.velocity += offset[1];
  }
  if (is_held != nullptr) {
    *is_held = false;
  }
  if (fading_ > 0) {  // the motion itself may lead beyond
    const double lowest = std::min(lowest_, onto.position);
    const double highest = std::max(highest_, onto.position);
    const double inside = std::min(std::max(found.position, lowest), highest);
    if (inside != found.position) {
      found = inside == onto.position ? onto : Reference{inside, 0.0};
      if (is_held != nullptr) {
        *is_held = true;
      }
    }
  }
  return found;
}

Reference Follower::at(std::int64_t stamp_ns)
{
  Reference found = joined(stamp_ns);
  if (glide_.is_there && stamp_ns >= glide_.begin_ns && stamp_ns < glide_.end_ns) {
    const double T = glide_.duration;
    const double s = seconds(stamp_ns - glide_.begin_ns) / T;
    const double squared = s * s;
    const double weight = 1.0 - squared * s * (10.0 - 15.0 * s + 6.0 * squared);
    const double rate = -30.0 * squared * (1.0 - 2.0 * s + squared) / T;
    const double away = glide_.position - found.position;
    found.position = found.position + weight * away;
    found.velocity = (1.0 - weight) * found.velocity + rate * away;
  }
  return found;
}

std::int64_t Follower::end_ns() const { return start_ns_ + motion_->knots.back().time_ns; }

Reference Follower::on_motion(std::int64_t stamp_ns)
{
  if (motion_ == nullptr) {
    return {turns_, 0.0};
  }
  if (stamp_ns < from_ns_ || stamp_ns >= to_ns_) {
    enter(stamp_ns);
  }
  const double t = seconds(stamp_ns - from_ns_);
  return {
    c_[0] + t * (c_[1] + t * (c_[2] + t * (c_[3] + t * (c_[4] + t * c_[5])))) + turns_,
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
    c_[2] = (3.0 * distance - (2.0 * v0 + v1) * T) / std::pow(T, kTwo);
    c_[3] = (-2.0 * distance + (v0 + v1) * T) / std::pow(T, kThree);
    return;
  }
  const double squared = std::pow(T, kTwo);
  c_[2] = 0.5 * a0;
  c_[3] = (20.0 * distance - (12.0 * v0 + 8.0 * v1) * T - (3.0 * a0 - a1) * squared) /
    (2.0 * std::pow(T, kThree));
  c_[4] = (-30.0 * distance + (16.0 * v0 + 14.0 * v1) * T + (3.0 * a0 - 2.0 * a1) * squared) /
    (2.0 * std::pow(T, kFour));
  c_[5] = (12.0 * distance - 6.0 * (v0 + v1) * T - (a0 - a1) * squared) /
    (2.0 * std::pow(T, kFive));
}

}  // namespace {{ package }}
