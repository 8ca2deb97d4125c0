#pragma once

#include <bit>
#include <cstdint>
#include <type_traits>

namespace groma::mac {

// The number behind an enumeration that was decoded from the wire. It may be none of the enumerators, and
// then even to look at it as an enumeration is undefined.
template <class E>
[[nodiscard]] constexpr std::uint32_t number_of(const E& value) noexcept {
  return static_cast<std::uint32_t>(std::bit_cast<std::underlying_type_t<E>>(value));
}

}  // namespace groma::mac
