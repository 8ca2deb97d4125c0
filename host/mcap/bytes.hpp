// Little-endian numbers in strings of bytes.
#pragma once

#include <bit>
#include <cstddef>
#include <string>
#include <type_traits>

namespace groma::mcap {

static_assert(std::endian::native == std::endian::little, "numbers are written as they are in memory");

template <typename Number>
void append(std::string& out, Number value) {
  static_assert(std::is_arithmetic_v<Number>);
  out.append(reinterpret_cast<const char*>(&value), sizeof value);
}

}  // namespace groma::mcap
