// The loop's parameters: which there are, and where each one goes.
#ifndef PARAMETERS_HPP_
#define PARAMETERS_HPP_

#include <array>
#include <cmath>
#include <string>

#include "{{ c }}.h"
#include "rclcpp/parameter.hpp"

namespace {{ package }}
{

constexpr std::array<const char *, {{ fields|length }}> kSettings = {
{% for field in fields %}
  "{{ field.parameter }}",
{% endfor %}
};

{% for field in fields if field.choices %}
/// A name that is none of them cannot come: the parameter's validation refuses it.
inline {{ c }}_{{ field.name }} to_{{ field.name }}(const std::string & name)
{
{% for choice in field.choices[1:] %}
  if (name == "{{ choice }}") {
    return {{ field.enumerator(C, choice) }};
  }
{% endfor %}
  return {{ field.enumerator(C, field.choices[0]) }};
}

{% endfor %}
/// Puts a parameter where it belongs; others do not concern the loop.
inline void assign({{ c }}_settings_type & settings, const rclcpp::Parameter & parameter)
{
  const std::string & name = parameter.get_name();
{% for field in fields %}
  {{ "} else " if not loop.first }}if (name == "{{ field.parameter }}") {
    settings.{{ field.name }} = {{ "to_%s(parameter.as_string())"|format(field.name) if field.choices else "parameter.as_double()" if field.range else "parameter.as_bool()" }};
{% endfor %}
  }
}

/// Returns which parameter is not a number; a range lets NaN through.
inline std::string not_a_number(const {{ c }}_settings_type & settings)
{
{% for field in fields if field.range %}
  if (std::isnan(settings.{{ field.name }})) {
    return "{{ field.parameter }}";
  }
{% endfor %}
  return "";
}

}  // namespace {{ package }}

#endif  // PARAMETERS_HPP_
