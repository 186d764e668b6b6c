#include "certificate.hpp"

#include <cstdio>
#include <fstream>
#include <iterator>
#include <vector>

#include "rcutils/sha256.h"

namespace {{ package }}
{

namespace
{

struct Range
{
  double least, most;
  bool holds(double number) const { return least <= number && number <= most; }
};

/// Gains and degrees for which one P is a certificate, whatever the inertia within its range.
struct Box
{
  Range degree;
  Range p, i, d;    // [N m/rad], [N m/(rad s)], [N m s/rad]
  Range rate_time;  // norm.rate_weight times norm.error_scale [s]
};

struct Certificate
{
  const char * joint;
  Range inertia;  // [kg m^2]
  {{ c }}_norm_type norm;
  std::vector<Box> boxes;
};

constexpr char kSha256[] = "{{ sha256 }}";

const std::vector<Certificate> & certificates()
{
  static const std::vector<Certificate> all = {
{% for each in certificates %}
    {"{{ each.joint }}", {{ each.inertia|pair }}, {{ C }}_NORM_TYPE_{{ each.norm|upper }},
      {
{% for box in each.boxes %}
        {{ "{" }}{{ box.degrees|pair }}, {{ box.p|pair }}, {{ box.i|pair }}, {{ box.d|pair }}, {{ box.rate_time|pair }}},
{% endfor %}
      }},
{% endfor %}
  };
  return all;
}

std::string text(double number)
{
  char shown[32];
  std::snprintf(shown, sizeof shown, "%.6g", number);
  return shown;
}

std::string outside(const char * name, double number, const Range & range)
{
  return "not certified: " + std::string(name) + " = " + text(number) + " is not within " +
    text(range.least) + " to " + text(range.most);
}

}  // namespace

std::string refusal(const std::string & joint, const {{ c }}_settings_type & s)
{
  const Certificate * found = nullptr;
  for (const auto & each : certificates()) {
    found = joint == each.joint ? &each : found;
  }
  if (found == nullptr) {
    return "there is no certificate of " + joint + " in this package";
  }
  if (s.inertia != 0.0 && !found->inertia.holds(s.inertia)) {
    return outside("inertia", s.inertia, found->inertia);
  }
  const bool is_linear = s.law == {{ C }}_LAW_PID || s.mu == 0.0;
  if (is_linear) {
    const double product = s.gains_p * s.gains_d, least = found->inertia.most * s.gains_i;
    const bool is_stable = s.gains_p > 0.0 && s.gains_d > 0.0 && product > least;
    return is_stable ? "" : "unstable as a linear PID: p d = " + text(product) +
      " must exceed i x inertia = " + text(least);
  }
  if (s.norm_type != found->norm) {
    return "not certified with this norm.type";
  }
  const double rate_time = s.norm_effort_scale > 0.0 ? s.gains_d / s.gains_p
                                                     : s.norm_rate_weight * s.norm_error_scale;
  std::string reason;
  for (const auto & box : found->boxes) {
    if (!box.degree.holds(s.mu)) {
      continue;
    }
    if (!box.p.holds(s.gains_p)) {
      reason = outside("gains.p", s.gains_p, box.p);
    } else if (!box.i.holds(s.gains_i)) {
      reason = outside("gains.i", s.gains_i, box.i);
    } else if (!box.d.holds(s.gains_d)) {
      reason = outside("gains.d", s.gains_d, box.d);
    } else if (!box.rate_time.holds(rate_time)) {
      reason = outside(
        s.norm_effort_scale > 0.0 ? "gains.d / gains.p" : "norm.rate_weight x norm.error_scale",
        rate_time, box.rate_time);
    } else {
      return "";
    }
    reason += " at mu = " + text(s.mu);
  }
  if (!reason.empty() || found->boxes.empty()) {
    return reason.empty() ? "not certified but with mu = 0" : reason;
  }
  return outside(
    "mu", s.mu, {found->boxes.front().degree.least, found->boxes.back().degree.most});
}

std::string file_refusal(const std::string & path)
{
  std::ifstream file(path, std::ios::binary);
  const std::string content{std::istreambuf_iterator<char>(file), {}};
  if (!file) {
    return path + " cannot be read";
  }
  rcutils_sha256_ctx_t context;
  rcutils_sha256_init(&context);
  rcutils_sha256_update(
    &context, reinterpret_cast<const std::uint8_t *>(content.data()), content.size());
  std::uint8_t digest[RCUTILS_SHA256_BLOCK_SIZE];
  rcutils_sha256_final(&context, digest);
  std::string found;
  for (const auto byte : digest) {
    char hex[3];
    std::snprintf(hex, sizeof hex, "%02x", byte);
    found += hex;
  }
  return found == kSha256 ? "" : path + " is not the one of the export: restore it, or export again";
}

}  // namespace {{ package }}
