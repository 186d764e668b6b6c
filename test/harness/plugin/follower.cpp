// The plugin's Follower, called by a test: no ROS, no thread.
#include <deque>

#include "reference.hpp"

using namespace {{ package }};

namespace
{

struct Followed
{
  Follower follower;
  std::deque<Motion> motions;
  Terms terms;
};

}  // namespace

extern "C" {

Followed * begin(double position, double takeover_time, double fastest, double low, double high)
{
  auto * const found = new Followed;
  found->follower.stand(position);
  found->terms.takeover_time = takeover_time;
  found->terms.fastest = fastest;
  found->terms.low = low;
  found->terms.high = high;
  return found;
}

void receive(
  Followed * it, std::int64_t now_ns, std::int64_t stamp_ns, int count, const std::int64_t * times,
  const double * positions, const double * velocities, const double * accelerations)
{
  Motion & motion = it->motions.emplace_back();
  motion.stamp_ns = stamp_ns;
  for (int k = 0; k < count; ++k) {
    motion.knots.push_back({times[k], positions[k], velocities[k], accelerations[k]});
  }
  motion.pace = pace_of(motion.knots);
  it->terms.now_ns = now_ns;
  it->follower.receive(motion, it->terms);
}

void sample(Followed * it, std::int64_t now_ns, double * found)
{
  it->terms.now_ns = now_ns;
  const Reference reference = it->follower.sample(it->terms);
  found[0] = reference.position;
  found[1] = reference.velocity;
  while (!it->motions.empty() && !it->follower.uses(it->motions.front())) {
    it->motions.pop_front();
  }
}

void finish(Followed * it) { delete it; }
}
