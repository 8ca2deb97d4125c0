// Types for the MCP2518FD's registers and their fields, so that registers.hpp can be a table.
#pragma once

#include <cstdint>
#include <type_traits>

namespace groma::mcp2518fd {

// A register of 32 bits, little-endian; each of its bytes can be written alone.
template <std::uint16_t Address>
struct Register {
  static_assert(Address < 0x1000 && Address % 4 == 0);
  static constexpr std::uint16_t kAddress = Address;
};

// `Width` bits of register `R` from bit `Lsb` on.
template <class R, unsigned Lsb, unsigned Width = 1>
struct Field {
  static_assert(Width >= 1 && Lsb + Width <= 32, "the field leaves its register");
  using Of = R;
  static constexpr unsigned kLsb = Lsb;
  static constexpr std::uint32_t kLargest = Width == 32 ? ~0U : (1U << Width) - 1U;
  static constexpr std::uint32_t kMask = kLargest << Lsb;
};

// The content of a register, with access to its fields by name. Accepts only fields of R.
template <class R>
class Value {
 public:
  constexpr Value() noexcept = default;
  constexpr explicit Value(std::uint32_t word) noexcept : word_(word) {}

  [[nodiscard]] constexpr std::uint32_t word() const noexcept { return word_; }
  [[nodiscard]] constexpr std::uint8_t byte(unsigned index) const noexcept {
    return static_cast<std::uint8_t>(word_ >> (8 * index));
  }

  template <class F>
  [[nodiscard]] constexpr std::uint32_t get(F) const noexcept {
    static_assert(std::is_same_v<typename F::Of, R>, "a field of another register");
    return (word_ & F::kMask) >> F::kLsb;
  }
  template <class F>
  [[nodiscard]] constexpr bool has(F) const noexcept {
    static_assert(std::is_same_v<typename F::Of, R>, "a field of another register");
    return (word_ & F::kMask) != 0;
  }
  // Sets the field to the low bits of `value`.
  template <class F>
  constexpr Value& set(F, std::uint32_t value = F::kLargest) noexcept {
    static_assert(std::is_same_v<typename F::Of, R>, "a field of another register");
    word_ = (word_ & ~F::kMask) | ((value << F::kLsb) & F::kMask);
    return *this;
  }
  friend constexpr bool operator==(const Value&, const Value&) noexcept = default;

 private:
  std::uint32_t word_ = 0;
};

}  // namespace groma::mcp2518fd
