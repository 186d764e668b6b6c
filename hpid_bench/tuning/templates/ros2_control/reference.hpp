// Where a joint should be at each instant: setpoints, or its columns of a sequence of trajectories.
#ifndef REFERENCE_HPP_
#define REFERENCE_HPP_

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

namespace {{ package }}
{

constexpr double kInfinite = std::numeric_limits<double>::infinity();
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

/// How fast a motion is, and where it leads; hpid_ros.control.reference.Pace.
struct Pace
{
  double fastest = 0.0;        // [rad/s] its largest velocity; 0 where it has none
  double given = 0.0;          // [rad/s] the largest velocity that its points were given
  double lowest = -kInfinite;  // [rad]
  double highest = kInfinite;  // [rad]
  double lead = 0.0;           // [s] planned for the way to a motion's only point
};

struct Motion
{
  std::vector<Knot> knots;    // at least one, their times increase
  std::int64_t stamp_ns = 0;  // of the start; 0 is with the next state
  bool is_setpoint = false;   // a step to the one knot, whenever it comes
  Pace pace;                  // of the knots, by pace_of()
};

/// Returns how fast knots are, and what bounds their spline.
Pace pace_of(const std::vector<Knot> & knots);

/// Returns the whole turns in a distance, so that half of one is left at most [rad]; 0 for no turn.
double whole_turns(double away, double turn);

/// What a joint's reference goes by in a cycle.
struct Terms
{
  std::int64_t now_ns = 0;
  std::int64_t ahead_ns = 0;    // by which the stamps of motions are ahead of now_ns
  double turn = 0.0;            // [rad] motions are taken whole turns away; 0 for none
  double lost_turn = 0.0;       // [rad] the first one that is under way, too
  double takeover_time = 0.0;   // [s]
  double fastest = kInfinite;   // [rad/s] the joint's velocity limit
  double low = -kInfinite;      // [rad] its stops, of turns more
  double high = kInfinite;
  double turns = 0.0;           // [rad] what the loop adds to the reference
};

/// Makes the reference of each cycle of a sequence of messages; its rules, sum by sum, are those of
/// hpid_ros.control.following.Following, where they are told.
class Follower
{
public:
  static constexpr std::size_t kMost = 64;  // motions that wait for their beginning
  static constexpr std::size_t kMostFading = 8;  // offsets: the newest, and rates of those before it

  /// Begins again, at a position.
  void stand(double position);

  /// Holds a position, and forgets what waits.
  void hold(double position);

  /// Takes a motion that came, to begin when its time has come. It must stay where it is for as
  /// long as uses() says so.
  void receive(const Motion & motion, const Terms & terms);

  /// Returns whether a motion is followed, or waits.
  bool uses(const Motion & motion) const;

  Reference sample(const Terms & terms);

private:
  struct Waiting
  {
    const Motion * motion = nullptr;
    std::int64_t begin_ns = 0;
    bool is_at_once = false;
    bool was_in_time = false;  // it came in an earlier cycle than it begins
  };

  struct Offset  // a difference of positions that fades by a quintic
  {
    double position = 0.0, velocity = 0.0, acceleration = 0.0;
    std::int64_t begin_ns = 0, end_ns = 0;

    std::array<double, 3> sample(std::int64_t stamp_ns) const;
  };

  struct Glide  // from rest at a position onto whatever the motion is
  {
    bool is_there = false;
    double position = 0.0;
    std::int64_t begin_ns = 0, end_ns = 0;
    double duration = 0.0;
  };

  struct Here  // where the reference stands when another motion begins
  {
    double position, velocity;
    Reference motion;
    double joined;  // [rad] the motion with its offsets
    bool is_held;   // whether those are held back
    std::int64_t offset_end_ns, glide_end_ns;
    bool is_running, has_ended;
    Pace pace;
    double turns;
  };

  void rest(double position);
  void begin(const Motion & motion, bool is_in_time, const Terms & terms);
  Here here(const Terms & terms);
  void glide_onto(const Here & here, const Terms & terms);
  void go_on(const Here & here, const Terms & terms);
  void glide_as_it_moves(const Here & here, const Reference & onto, double length, std::int64_t);
  void fade(const Offset & offset);  // it alone
  void fade_jump(double jump, double rate, double length, std::int64_t now_ns);
  void approach(const Here & here, const Terms & terms);

  Reference at(std::int64_t stamp_ns);
  Reference joined(std::int64_t stamp_ns, bool * is_held = nullptr);
  Reference on_motion(std::int64_t stamp_ns);
  std::int64_t end_ns() const;
  void enter(std::int64_t stamp_ns);
  void set_segment(const Knot & left, const Knot & right);
  static std::int64_t begin_of(const Waiting & waiting, std::int64_t now_ns);

  std::array<Waiting, kMost> waiting_;
  std::size_t count_ = 0;  // of those that wait

  const Motion * motion_ = nullptr;  // none: holds turns_
  std::int64_t start_ns_ = 0;
  Knot before_;  // where the way to the first point begins
  bool has_before_ = false;
  bool is_first_ = true;
  double turns_ = 0.0;  // [rad] added to the motion

  std::int64_t from_ns_ = 0;  // the segment that the coefficients are of
  std::int64_t to_ns_ = 0;
  double c_[6] = {};

  Glide glide_;
  std::array<Offset, kMostFading> offsets_;
  std::size_t fading_ = 0;  // of the offsets
  double lowest_ = -kInfinite;  // [rad] where motion and offsets may lead
  double highest_ = kInfinite;
};

}  // namespace {{ package }}

#endif  // REFERENCE_HPP_
