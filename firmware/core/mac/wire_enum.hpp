#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

namespace groma::mac {

// The number of an enumeration that was decoded from the wire. It may be none of the enumerators, and reading
// it as an enumeration is then undefined behaviour.
template <class E>
[[nodiscard]] std::uint32_t number_of(const E& value) noexcept {
  std::underlying_type_t<E> number{};
  std::memcpy(&number, &value, sizeof number);
  return static_cast<std::uint32_t>(number);
}

}  // namespace groma::mac
