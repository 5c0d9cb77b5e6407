// Self-contained HTML pages from the templates in pipeline/report_page/, which are put into the program when it is
// built (tools/embed.cmake).
#pragma once

#include <string>
#include <string_view>

#include "pipeline/json.h"

namespace nrff {

// The template `name` with {{title}}, {{data}} and {{FILE}} (another file of pipeline/report_page/, as it is) filled
// in. `data` goes in as JSON that is safe inside a <script> element.
std::string FillPage(std::string_view name, std::string_view title, const Json& data);

std::string EscapeHtml(std::string_view text);
std::string Base64(std::string_view bytes);

}  // namespace nrff
