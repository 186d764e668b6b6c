// The exported loop answers what Python's answered, joint by joint; the states are in the headers.
#include <gmock/gmock.h>

#include <algorithm>
#include <cmath>
#include <cstddef>

#include "{{ c }}.h"
{% for each in loops %}
#include "{{ each.c }}_golden.h"
{% endfor %}

namespace
{

using Settings = {{ c }}_settings_type;

/// Returns the largest deviation of an effort [N m]; `retuned` holds from a row on, gains first.
template <typename Rows>
double largest_deviation(
  const Settings & settings, const Rows & rows, std::size_t retune_at, double p, double i, double d,
  double mu)
{
  {{ c }}_state loop;
  EXPECT_TRUE({{ c }}_init(&loop, &settings));
  double largest = 0.0;
  std::size_t row = 0;
  for (const auto & each : rows) {
    if (row++ == retune_at) {
      EXPECT_TRUE({{ c }}_set_gains(&loop, p, i, d));
      EXPECT_TRUE({{ c }}_set_degree(&loop, mu));
    }
    const double effort = {{ c }}_step(
      &loop, each.stamp_ns, each.reference_position, each.reference_velocity, each.position,
      each.has_velocity ? &each.velocity : nullptr);
    largest = std::max(largest, std::abs(effort - each.effort));
  }
  return largest;
}

}  // namespace

{% for each in loops %}
{% set name = each.c|upper %}
TEST(Loops, {{ each.joint }})
{
  Settings settings{};
{% for field in fields %}
{% set value = each.settings[field.parameter] %}
  settings.{{ field.name }} = {{ value|double if field.range else field.enumerator(C, value) if field.choices else value|lower }};
{% endfor %}
  const double deviation = largest_deviation(
    settings, {{ each.c }}_golden, {{ name }}_GOLDEN_RETUNE, {{ name }}_GOLDEN_P, {{ name }}_GOLDEN_I,
    {{ name }}_GOLDEN_D, {{ name }}_GOLDEN_MU);
  EXPECT_LE(deviation, {{ name }}_GOLDEN_DOUBLE);
  RecordProperty("largest_deviation", std::to_string(deviation));
}

{% endfor %}
