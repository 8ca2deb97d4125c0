#include "host/io/error.hpp"

#include <fmt/format.h>

namespace groma::io {

std::string to_string(const FilePlace& place) {
  std::string text = place.path.string();
  if (place.line > 0) text += fmt::format(":{}", place.line);
  if (place.line > 0 && place.column > 0) text += fmt::format(":{}", place.column);
  return text;
}

Error::Error(const FilePlace& place, std::string_view problem, std::string_view remedy)
    : std::runtime_error(fmt::format("{}: {}; {}", to_string(place), problem, remedy)), place_(place) {}

std::string escaped(std::string_view text) {
  constexpr std::size_t kMaxShown = 40;
  std::string out;
  for (const char c : text.substr(0, kMaxShown)) {
    const bool printable = c >= ' ' && c <= '~';
    if (printable) {
      out += c;
    } else {
      out += fmt::format("\\x{:02x}", static_cast<unsigned char>(c));
    }
  }
  if (text.size() > kMaxShown) out += "...";
  return out;
}

std::string shown(std::string_view text) {
  return fmt::format("'{}'", escaped(text));
}

}  // namespace groma::io
