// Types for registers and their fields, so that registers.hpp can be a table.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <type_traits>

namespace groma::dw1000 {

enum class Access : std::uint8_t { kRead, kWrite, kReadWrite };

// A register, or the part of a register file that is read or written in one transfer. `Sub` is the offset of
// its first byte in the file. Little-endian.
template <std::uint8_t Id, std::uint16_t Sub, std::size_t Length, Access Mode>
struct Register {
  static_assert(Id < 0x40 && Sub < 0x8000 && Length > 0);
  static constexpr std::uint8_t kId = Id;
  static constexpr std::uint16_t kSub = Sub;
  static constexpr std::size_t kLength = Length;
  static constexpr bool kReadable = Mode != Access::kWrite;
  static constexpr bool kWritable = Mode != Access::kRead;
};

// A field of register `R`: `Width` bits (at most 64) from bit `Lsb` on.
template <class R, unsigned Lsb, unsigned Width = 1>
struct Field {
  static_assert(Width >= 1 && Width <= 64 && Lsb + Width <= 8 * R::kLength, "the field leaves its register");
  using Of = R;
  static constexpr unsigned kLsb = Lsb;
  static constexpr unsigned kWidth = Width;
};

// The bytes of register `R`, with access to its fields by name. Accepts only fields of R.
template <class R>
class Value {
 public:
  constexpr Value() noexcept = default;
  // From the low bytes of `word`; for registers of up to 8 bytes.
  constexpr explicit Value(std::uint64_t word) noexcept requires(R::kLength <= 8) {
    for (std::size_t i = 0; i < R::kLength; ++i) bytes_[i] = static_cast<std::uint8_t>(word >> (8 * i));
  }

  [[nodiscard]] constexpr std::uint64_t word() const noexcept requires(R::kLength <= 8) {
    std::uint64_t word = 0;
    for (std::size_t i = 0; i < R::kLength; ++i) word |= std::uint64_t{bytes_[i]} << (8 * i);
    return word;
  }

  template <class F>
  [[nodiscard]] constexpr std::uint64_t get(F) const noexcept {
    static_assert(std::is_same_v<typename F::Of, R>, "a field of another register");
    std::uint64_t value = 0;
    unsigned taken = 0;
    while (taken < F::kWidth) {
      const unsigned bit = F::kLsb + taken;
      value |= (std::uint64_t{bytes_[bit / 8]} >> (bit % 8)) << taken;
      taken += 8 - bit % 8;
    }
    return value & mask(F::kWidth);
  }
  // The field as a two's complement number.
  template <class F>
  [[nodiscard]] constexpr std::int64_t get_signed(F field) const noexcept {
    const std::uint64_t value = get(field);
    const std::uint64_t sign = std::uint64_t{1} << (F::kWidth - 1);
    return static_cast<std::int64_t>((value ^ sign) - sign);
  }
  template <class F>
  [[nodiscard]] constexpr bool has(F field) const noexcept {
    static_assert(F::kWidth == 1);
    return get(field) != 0;
  }
  // Sets the field to the low bits of `value`.
  template <class F>
  constexpr Value& set(F, std::uint64_t value = mask(F::kWidth)) noexcept {
    static_assert(std::is_same_v<typename F::Of, R>, "a field of another register");
    for (unsigned i = 0; i < F::kWidth; ++i) {
      const unsigned bit = F::kLsb + i;
      const auto flag = static_cast<std::uint8_t>(1U << (bit % 8));
      const bool one = ((value >> i) & 1) != 0;
      bytes_[bit / 8] = static_cast<std::uint8_t>(one ? bytes_[bit / 8] | flag : bytes_[bit / 8] & ~flag);
    }
    return *this;
  }

  [[nodiscard]] constexpr std::span<std::uint8_t, R::kLength> bytes() noexcept { return bytes_; }
  [[nodiscard]] constexpr std::span<const std::uint8_t, R::kLength> bytes() const noexcept { return bytes_; }
  friend constexpr bool operator==(const Value&, const Value&) noexcept = default;

 private:
  [[nodiscard]] static constexpr std::uint64_t mask(unsigned width) noexcept {
    return width == 64 ? ~std::uint64_t{0} : (std::uint64_t{1} << width) - 1;
  }

  std::array<std::uint8_t, R::kLength> bytes_{};
};

// The SPI transaction header (user manual 2.2.1.2): 1 byte without a sub-address, 2 up to 0x7F, else 3.
class TransactionHeader {
 public:
  constexpr TransactionHeader(bool write, std::uint8_t id, std::uint16_t sub) noexcept {
    constexpr unsigned kWriteFlag = 0x80;
    constexpr unsigned kSubFollows = 0x40;
    constexpr unsigned kExtended = 0x80;
    bytes_[0] = static_cast<std::uint8_t>((write ? kWriteFlag : 0U) | (sub != 0 ? kSubFollows : 0U) | id);
    if (sub == 0) return;
    bytes_[1] = static_cast<std::uint8_t>((sub & 0x7FU) | (sub > 0x7F ? kExtended : 0U));
    bytes_[2] = static_cast<std::uint8_t>(sub >> 7);
    size_ = sub > 0x7F ? 3 : 2;
  }
  [[nodiscard]] constexpr std::span<const std::uint8_t> bytes() const noexcept {
    return std::span<const std::uint8_t>(bytes_).first(size_);
  }

 private:
  std::array<std::uint8_t, 3> bytes_{};
  std::size_t size_ = 1;
};

}  // namespace groma::dw1000
