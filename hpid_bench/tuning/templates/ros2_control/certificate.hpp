// For which settings each joint's loop is certified stable, as config/certificates.json has it.
#ifndef CERTIFICATE_HPP_
#define CERTIFICATE_HPP_

#include <string>

#include "{{ c }}.h"

namespace {{ package }}
{

/// Returns why settings of a joint are outside its certificate, in one line; empty if they are not.
std::string refusal(const std::string & joint, const {{ c }}_settings_type & settings);

/// Returns why a file is not the one from which these certificates come; empty if it is.
std::string file_refusal(const std::string & path);

}  // namespace {{ package }}

#endif  // CERTIFICATE_HPP_
