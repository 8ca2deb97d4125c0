// Access to the registers of one DW1000 on its SPI bus.
#pragma once

#include <cstddef>

#include "firmware/core/dw1000/register.hpp"
#include "firmware/core/dw1000/spi.hpp"

namespace groma::dw1000 {

// Reads bytes `First` to `First + Count - 1` of the register; the others are zero.
template <class R, std::size_t First, std::size_t Count, Spi S>
[[nodiscard]] Value<R> read_part(S& spi) noexcept {
  static_assert(R::kReadable, "a register that cannot be read");
  Value<R> value;
  spi.read(TransactionHeader(false, R::kId, R::kSub + First).bytes(),
           value.bytes().template subspan<First, Count>());
  return value;
}
template <class R, std::size_t First, std::size_t Count, Spi S>
void write_part(S& spi, const Value<R>& value) noexcept {
  static_assert(R::kWritable, "a register that cannot be written");
  spi.write(TransactionHeader(true, R::kId, R::kSub + First).bytes(),
            value.bytes().template subspan<First, Count>());
}

template <class R, Spi S>
[[nodiscard]] Value<R> read(S& spi) noexcept {
  return read_part<R, 0, R::kLength>(spi);
}
template <class R, Spi S>
void write(S& spi, const Value<R>& value) noexcept {
  write_part<R, 0, R::kLength>(spi, value);
}

}  // namespace groma::dw1000
