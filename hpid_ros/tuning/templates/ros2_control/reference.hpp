// Where a joint should be at each instant: a setpoint, or its column of a trajectory.
#ifndef REFERENCE_HPP_
#define REFERENCE_HPP_

#include <cstdint>
#include <limits>
#include <vector>

namespace {{ package }}
{

constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();
constexpr double kLargest = {{ largest_position|double }};  // of positions and their derivatives

struct Reference
{
  double position = 0.0;  // [rad]
  double velocity = 0.0;  // [rad/s]
};

/// One point of a joint's column; NaN where the trajectory has no such number.
struct Knot
{
  std::int64_t time_ns = 0;  // since the start
  double position = 0.0;     // [rad]
  double velocity = kNaN;    // [rad/s]
  double acceleration = kNaN;  // [rad/s^2]
};

struct Motion
{
  std::vector<Knot> knots;    // at least one, their times increase
  std::int64_t stamp_ns = 0;  // of the start; 0 is with the next state
  bool is_setpoint = false;   // a step to the one knot, whenever it comes
};

/// Returns the whole turns in a distance, so that half of one is left at most [rad]; 0 for no turn.
double whole_turns(double away, double turn);

/// Goes from motion to motion without a jump of the reference, but for a setpoint, which is a step.
/// The rules are those of joint_trajectory_controller and of hpid_ros: a segment is linear, cubic or
/// quintic by the derivatives that both ends have; before the first point the reference runs from
/// where it stands, after the last one it holds; onto a motion that is under way it glides.
class Follower
{
public:
  /// Begins anew, at a position.
  void stand(double position);

  /// Holds a position.
  void hold(double position);

  /// Follows a motion from this instant on. It is shifted by whole turns so that it begins nearest:
  /// of `turn` [rad], 0 for none; the first one that is under way of `lost_turn`, as the turns until
  /// now were not counted. `here` is the reference by sample(). Its stamp is of a clock that is
  /// ahead of now_ns. The motion must stay where it is.
  void follow(
    const Motion & motion, std::int64_t now_ns, std::int64_t ahead_ns, const Reference & here,
    double turn, double lost_turn, double takeover_time);

  Reference sample(std::int64_t stamp_ns);

private:
  Reference on_motion(std::int64_t stamp_ns);
  void enter(std::int64_t stamp_ns);
  void set_segment(const Knot & left, const Knot & right);

  const Motion * motion_ = nullptr;  // none: holds offset_
  std::int64_t start_ns_ = 0;
  Knot before_;  // where the reference stood when the motion was taken up
  bool has_before_ = false;
  bool is_first_ = true;
  double offset_ = 0.0;  // [rad] added to the motion

  std::int64_t from_ns_ = 0;  // the segment that the coefficients are of
  std::int64_t to_ns_ = 0;
  double c_[6] = {};

  bool is_gliding_ = false;
  std::int64_t glide_ns_ = 0;   // its beginning
  double glide_duration_ = 0.0;  // [s]
  double away_ = 0.0;            // [rad] at its beginning, from the motion
  double carried_ = 0.0;         // difference of velocities times duration [rad]
};

}  // namespace {{ package }}

#endif  // REFERENCE_HPP_
