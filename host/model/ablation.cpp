#include "host/model/ablation.hpp"

#ifdef GROMA_ABLATION

#include <bitset>
#include <charconv>
#include <cstddef>
#include <cstdio>
#include <cstdlib>
#include <string_view>
#include <system_error>

namespace groma::model {
namespace {

constexpr auto kCount = static_cast<std::size_t>(Mechanism::kCount);

// scripts/ablation numbers the names as ablation.hpp lists them.
std::bitset<kCount> read() {
  std::bitset<kCount> out;
  const char* text = std::getenv("GROMA_ABLATE");
  for (std::string_view left = text == nullptr ? "" : text; !left.empty();) {
    const std::size_t end = left.find(',');
    const std::string_view part = left.substr(0, end);
    std::size_t number = kCount;
    const auto [rest, error] = std::from_chars(part.data(), part.data() + part.size(), number);
    if (error != std::errc{} || rest != part.data() + part.size() || number >= kCount) {
      std::fputs("GROMA_ABLATE: no such mechanism\n", stderr);
      std::exit(2);
    }
    out.set(number);
    left = end == std::string_view::npos ? "" : left.substr(end + 1);
  }
  return out;
}

}  // namespace

bool is_ablated(Mechanism mechanism) noexcept {
  static const std::bitset<kCount> kAblated = read();
  return kAblated[static_cast<std::size_t>(mechanism)];
}

}  // namespace groma::model

#endif
