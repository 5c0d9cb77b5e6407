#include "pipeline/report_page.h"

#include <cstdint>
#include <stdexcept>

namespace nrff {

// In the source file that tools/embed.cmake makes.
std::string_view EmbeddedPageFile(std::string_view name);

namespace {

// JSON for the inside of <script>: '<' would let text end the element or open a comment.
std::string ScriptJson(const Json& data) {
  const std::string json = data.dump(-1, ' ', false, Json::error_handler_t::replace);
  std::string safe;
  safe.reserve(json.size());
  for (char c : json) {
    if (c == '<') {
      safe += "\\u003c";
    } else {
      safe += c;
    }
  }
  return safe;
}

}  // namespace

std::string FillPage(std::string_view name, std::string_view title, const Json& data) {
  std::string page;
  std::string_view rest = EmbeddedPageFile(name);
  for (size_t open = rest.find("{{"); open != std::string_view::npos; open = rest.find("{{")) {
    const size_t close = rest.find("}}", open);
    if (close == std::string_view::npos) throw std::logic_error("unclosed {{ in the page " + std::string(name));
    const std::string_view key = rest.substr(open + 2, close - open - 2);
    page += rest.substr(0, open);
    if (key == "title") {
      page += EscapeHtml(title);
    } else if (key == "data") {
      page += ScriptJson(data);
    } else {
      page += EmbeddedPageFile(key);
    }
    rest.remove_prefix(close + 2);
  }
  page += rest;
  return page;
}

std::string EscapeHtml(std::string_view text) {
  std::string escaped;
  for (char c : text) {
    switch (c) {
      case '&':
        escaped += "&amp;";
        break;
      case '<':
        escaped += "&lt;";
        break;
      case '>':
        escaped += "&gt;";
        break;
      case '"':
        escaped += "&quot;";
        break;
      case '\'':
        escaped += "&#39;";
        break;
      default:
        escaped += c;
    }
  }
  return escaped;
}

std::string Base64(std::string_view bytes) {
  constexpr char kDigits[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::string text;
  text.reserve((bytes.size() + 2) / 3 * 4);
  for (size_t i = 0; i < bytes.size(); i += 3) {
    const size_t n = std::min<size_t>(3, bytes.size() - i);
    uint32_t bits = 0;
    for (size_t k = 0; k < 3; ++k) bits = bits << 8 | (k < n ? uint8_t(bytes[i + k]) : 0);
    for (size_t k = 0; k < 4; ++k) text += k <= n ? kDigits[bits >> (18 - 6 * k) & 63] : '=';
  }
  return text;
}

}  // namespace nrff
