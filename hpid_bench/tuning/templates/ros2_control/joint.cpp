#include "joint.hpp"

#include <algorithm>
#include <cmath>

namespace {{ package }}
{

namespace
{

constexpr double kLate = 1.5;  // periods

}  // namespace

bool Joint::accepts(const Settings & settings)
{
  {{ c }}_state trial;
  return {{ c }}_init(&trial, &settings);
}

Joint::Joint(const Settings & settings) { {{ c }}_init(&loop_, &settings); }

void Joint::begin()
{
  {{ c }}_reset(&loop_);
  is_controlled_ = true;
  is_standing_ = false;
  is_silent = false;
  is_conflicting = false;
}

void Joint::drop_motion()
{
  follower_.hold(asked_.position);
  while (motions.front() != nullptr) {
    motions.pop();
  }
  received_ = 0;
}

double Joint::resume()
{
  is_controlled_ = was_controlled_;
  return is_controlled_ && is_enabled ? loop_.effort : 0.0;
}

Record Joint::step(
  std::int64_t stamp_ns, double position, const double * velocity, const Reference * chained,
  std::int64_t ahead_ns)
{
  while (const Settings * next = retunings.front()) {
    {{ c }}_retune(&loop_, next);
    retunings.pop();
  }
  if (!is_enabled.load(std::memory_order_acquire)) {
    return leave();
  }
  if (!is_controlled_) {
    begin();
    begun_ns.store(stamp_ns + ahead_ns, std::memory_order_relaxed);
  }
  clock_ns.store(stamp_ns + ahead_ns, std::memory_order_relaxed);
  Record record;
  if (is_standing_ && stamp_ns == stamp_ns_) {  // no time has passed: a repeat, or another source's
    record.stamp_ns = stamp_ns_;
    record.effort = {{ c }}_step(
      &loop_, stamp_ns, asked_.position, asked_.velocity, position, velocity);
    note_conflict();
    return record;
  }
  const Age state = age(stamp_ns, position, velocity);
  if (state != Age::kNew) {
    const double fallback = loop_.own.coefficients.fallback;
    const bool was_silent = is_silent;
    is_silent = was_silent || state == Age::kEnded;
    if (is_silent && !(was_silent && loop_.effort == fallback)) {  // also where a set changed it
      record.kind = Record::Kind::kFallback;
      silences.fetch_add(was_silent ? 0 : 1, std::memory_order_relaxed);
      {{ c }}_supersede(&loop_, fallback);
    }
    record.stamp_ns = stamp_ns_;
    record.effort = loop_.effort;
    return record;
  }
  is_silent = false;
  is_standing_ = is_standing_ && stamp_ns >= stamp_ns_;  // else the clock has gone back
  const auto periods = (stamp_ns - stamp_ns_) * 1e-9 / loop_.settings.control_period;
  if (is_standing_ && periods > kLate) {
    missed.fetch_add(static_cast<std::uint64_t>(periods + 0.5) - 1, std::memory_order_relaxed);
  }
  record.kind = Record::Kind::kAnswer;
  record.stamp_ns = stamp_ns_ = stamp_ns;
  record.position = position;
  record.velocity = velocity != nullptr ? *velocity : kNaN;
  record.before = loop_.effort;
  record.asked = asked_ = asked_for(stamp_ns, position, chained, ahead_ns);
  record.effort = {{ c }}_step(
    &loop_, stamp_ns, asked_.position, asked_.velocity, position, velocity);
  record.reference = {loop_.reference_position, loop_.reference_velocity};
  record.terms[0] = loop_.term_p;
  record.terms[1] = loop_.term_i;
  record.terms[2] = loop_.term_d;
  samples.fetch_add(1, std::memory_order_relaxed);
  note_conflict();
  if (loop_.condition == {{ C }}_FAULT) {
    faults.fetch_add(1, std::memory_order_relaxed);
  }
  return record;
}

void Joint::note_conflict()
{
  const bool is_conflict = loop_.condition == {{ C }}_CONFLICT;
  conflicts.fetch_add(is_conflict && !is_conflicting ? 1 : 0, std::memory_order_relaxed);
  is_conflicting = is_conflict;
}

Record Joint::leave()
{
  Record record;
  if (is_controlled_) {
    record.kind = Record::Kind::kLeft;
  }
  was_controlled_ = is_controlled_;
  is_controlled_ = false;
  clock_ns.store(0, std::memory_order_relaxed);
  drop_motion();
  record.stamp_ns = stamp_ns_;
  return record;
}

/// Hardware that hears no more repeats its last state. One in which the joint moves, and whose
/// numbers stay the same to the last bit for state_timeout, is such a one; of a joint at rest nobody
/// can tell. Where nobody called for so long, the same state is from before, for that time again.
Joint::Age Joint::age(std::int64_t stamp_ns, double position, const double * velocity)
{
  const double speed = velocity != nullptr ? *velocity : 0.0;
  const auto timeout_ns = static_cast<std::int64_t>(loop_.settings.state_timeout * 1e9);
  const bool is_same = is_standing_ && position == position_ && speed == velocity_;
  const std::int64_t since_ns = stamp_ns - seen_ns_;
  seen_ns_ = stamp_ns;
  if (!is_same || since_ns < 0) {
    changed_ns_ = stamp_ns;
    position_ = position;
    velocity_ = speed;
    is_woken_ = false;
    return Age::kNew;
  }
  if (since_ns > timeout_ns) {
    woken_ns_ = stamp_ns;
    is_woken_ = true;
  }
  if (is_woken_) {
    is_woken_ = stamp_ns - woken_ns_ <= timeout_ns;
    changed_ns_ = stamp_ns;
    return is_woken_ ? Age::kOld : Age::kNew;
  }
  return speed != 0.0 && stamp_ns - changed_ns_ > timeout_ns ? Age::kEnded : Age::kNew;
}

Reference Joint::asked_for(
  std::int64_t stamp_ns, double position, const Reference * chained, std::int64_t ahead_ns)
{
  const auto & its = loop_.own.coefficients;
  if (!is_standing_ && std::abs(position) <= kLargest) {
    is_standing_ = true;
    follower_.stand(position);
    asked_ = {position, 0.0};
  }
  if (chained != nullptr) {
    if (!(std::abs(chained->position) <= kLargest)) {  // nobody has asked for anything
      return {asked_.position, 0.0};
    }
    const double turns = whole_turns(asked_.position - chained->position, its.turn);
    return {
      chained->position + turns, std::isfinite(chained->velocity) ? chained->velocity : 0.0};
  }
  const auto & own = loop_.own;
  Terms terms;
  terms.now_ns = stamp_ns;
  terms.ahead_ns = ahead_ns;
  terms.turn = its.turn;
  terms.lost_turn = its.lost_turn;
  terms.takeover_time = loop_.settings.takeover_time;
  terms.fastest = its.velocity_limit;
  // At a stop the reference rests; before the loop's first sample there are none.
  if (its.has_limits && own.passage.has_reference) {
    terms.low = own.low;
    terms.high = own.high;
    terms.turns = own.passage.turns;
  }
  if (is_standing_) {
    while (const Motion * came = motions.at(received_)) {
      follower_.receive(*came, terms);
      ++received_;
    }
  }
  const Reference here = follower_.sample(terms);
  while (received_ > 0 && !follower_.uses(*motions.front())) {
    motions.pop();
    --received_;
  }
  return here;
}

}  // namespace {{ package }}
