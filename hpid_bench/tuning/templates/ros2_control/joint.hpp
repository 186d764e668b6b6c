// One joint's loop, from the state of a cycle to the effort that answers it. No ROS.
#ifndef JOINT_HPP_
#define JOINT_HPP_

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "handover.hpp"
#include "{{ c }}.h"
#include "reference.hpp"

namespace {{ package }}
{

using Settings = {{ c }}_settings_type;

/// What became of a joint in one cycle.
struct Record
{
  enum class Kind
  {
    kNothing,   // it is not controlled, or there is no new state: the effort stays
    kAnswer,    // the loop answered a new state
    kFallback,  // the first cycle after the states have ended
    kLeft       // the first cycle in which it is not controlled any more
  };

  Kind kind = Kind::kNothing;
  std::int64_t stamp_ns = 0;  // of the state that was answered last
  double position = 0.0;      // [rad] measured
  double velocity = 0.0;      // [rad/s] measured
  double before = 0.0;        // [N m] the effort when the state was read
  Reference asked;            // for
  Reference reference;        // the loop's own: gliding, within the stops
  double terms[3] = {};       // p, i, d [N m]
  double effort = 0.0;        // [N m]
};

class Joint
{
public:
  /// Settings must be those that Joint::accepts.
  explicit Joint(const Settings & settings);

  static bool accepts(const Settings & settings);

  // Called by the thread of the control loop: no locks, no memory, no exceptions.

  /// Answers a state. Velocity is nullptr where none is measured; chained is what a preceding
  /// controller asks for, nullptr for the joint's own motions, whose clock is ahead of the stamps.
  /// The first state after leave() has the joint held where it is.
  Record step(
    std::int64_t stamp_ns, double position, const double * velocity, const Reference * chained,
    std::int64_t ahead_ns = 0);

  /// Ends its control, and what was asked for.
  Record leave();

  /// Goes on at once after leave(), at the reference that there was; returns the effort [N m].
  double resume();

  /// Holds the reference that there is; what was asked for before is over.
  void drop_motion();

  // Called by one other thread.

  Queue<Settings, 64> retunings;  // to be applied, each accepted
  Queue<Motion, Follower::kMost> motions;  // in the order in which they came
  std::atomic<bool> is_enabled = true;  // whether it is controlled while the controller is active

  // Counted for whoever asks.

  std::atomic<std::uint64_t> samples = 0;
  std::atomic<std::uint64_t> faults = 0;    // states that could not be used
  std::atomic<std::uint64_t> silences = 0;  // times without a new state
  std::atomic<std::uint64_t> missed = 0;    // states there must have been, by control_period
  std::atomic<bool> is_silent = false;      // the states have ended
  std::atomic<std::uint64_t> conflicts = 0;  // times in which they came from two sources
  std::atomic<bool> is_conflicting = false;  // they do now

  // By the clock of trajectories; 0 while it is not controlled.

  std::atomic<std::int64_t> begun_ns = 0;  // its first cycle
  std::atomic<std::int64_t> clock_ns = 0;  // its last cycle

private:
  enum class Age { kNew, kOld, kEnded };

  void begin();
  void note_conflict();
  Age age(std::int64_t stamp_ns, double position, const double * velocity);
  Reference asked_for(
    std::int64_t stamp_ns, double position, const Reference * chained, std::int64_t ahead_ns);

  {{ c }}_state loop_;
  Follower follower_;
  bool is_controlled_ = false;
  bool was_controlled_ = false;  // when it was left
  bool is_standing_ = false;     // the follower has a place
  std::int64_t stamp_ns_ = 0;    // of the last state that was answered
  std::int64_t seen_ns_ = 0;     // of the last cycle
  std::int64_t changed_ns_ = 0;  // of the last state that differed from the one before
  bool is_woken_ = false;        // nobody called for a while, and no other state has come
  std::int64_t woken_ns_ = 0;    // of the first cycle then
  double position_ = 0.0;
  double velocity_ = 0.0;
  Reference asked_;
  std::size_t received_ = 0;  // motions that the follower has got, the first ones of their queue
};

}  // namespace {{ package }}

#endif  // JOINT_HPP_
