// Signed 128-bit integers for exact reference results: the compiler's type or, if it has none (32-bit
// targets), two's complement arithmetic on words with bitwise long division.
#pragma once

#include <cstdint>

namespace groma::test {

#ifdef __SIZEOF_INT128__

__extension__ using Int128 = __int128;

#else

class Int128 {
 public:
  constexpr Int128(std::int64_t value) noexcept  // implicit, like integer conversions
      : high_(value < 0 ? ~std::uint64_t{0} : 0), low_(static_cast<std::uint64_t>(value)) {}

  constexpr explicit operator std::int64_t() const noexcept { return static_cast<std::int64_t>(low_); }

  friend constexpr Int128 operator+(const Int128& a, const Int128& b) noexcept {
    const std::uint64_t low = a.low_ + b.low_;
    return {a.high_ + b.high_ + (low < a.low_ ? 1U : 0U), low};
  }
  friend constexpr Int128 operator-(const Int128& a) noexcept {
    return Int128(~a.high_, ~a.low_) + Int128(1);
  }
  friend constexpr Int128 operator-(const Int128& a, const Int128& b) noexcept { return a + -b; }
  friend constexpr Int128 operator*(const Int128& a, const Int128& b) noexcept {
    // Modulo 2^128, in limbs of 32 bits.
    std::uint32_t limbs[4] = {};
    for (int i = 0; i < 4; ++i) {
      std::uint64_t carry = 0;
      for (int k = 0; i + k < 4; ++k) {
        carry += limbs[i + k] + std::uint64_t{a.limb(i)} * b.limb(k);
        limbs[i + k] = static_cast<std::uint32_t>(carry);
        carry >>= 32;
      }
    }
    return {std::uint64_t{limbs[3]} << 32 | limbs[2], std::uint64_t{limbs[1]} << 32 | limbs[0]};
  }
  // Rounded towards zero.
  friend constexpr Int128 operator/(const Int128& a, const Int128& b) noexcept {
    const Int128 quotient = divide(a.magnitude(), b.magnitude());
    return a.negative() != b.negative() ? -quotient : quotient;
  }
  friend constexpr bool operator==(const Int128&, const Int128&) noexcept = default;
  friend constexpr bool operator<(const Int128& a, const Int128& b) noexcept { return (a - b).negative(); }

 private:
  constexpr Int128(std::uint64_t high, std::uint64_t low) noexcept : high_(high), low_(low) {}

  [[nodiscard]] constexpr bool bit(int index) const noexcept {
    return ((index < 64 ? low_ >> index : high_ >> (index - 64)) & 1) != 0;
  }
  [[nodiscard]] constexpr std::uint32_t limb(int index) const noexcept {
    return static_cast<std::uint32_t>((index < 2 ? low_ : high_) >> (index % 2 * 32));
  }
  [[nodiscard]] constexpr bool negative() const noexcept { return bit(127); }
  [[nodiscard]] constexpr Int128 magnitude() const noexcept { return negative() ? -*this : *this; }
  // Divides magnitudes; b is not 0.
  static constexpr Int128 divide(const Int128& a, const Int128& b) noexcept {
    Int128 quotient = 0;
    Int128 remainder = 0;
    for (int bit = 127; bit >= 0; --bit) {
      quotient = quotient + quotient;
      remainder = remainder + remainder + Int128(a.bit(bit) ? 1 : 0);
      if (remainder < b) continue;
      remainder = remainder - b;
      quotient = quotient + Int128(1);
    }
    return quotient;
  }

  std::uint64_t high_;
  std::uint64_t low_;
};

#endif

}  // namespace groma::test
