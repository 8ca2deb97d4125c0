// Access to memory-mapped registers, and the registers of the Cortex-M4 itself (ARM DDI 0403E, B3).
#pragma once

#include <cstdint>

namespace groma::cortex_m4 {

using Register = volatile std::uint32_t;

[[nodiscard]] inline Register& at(std::uint32_t address) noexcept {
  return *reinterpret_cast<Register*>(address);  // NOLINT(performance-no-int-to-ptr): that is what it is
}

// A peripheral's registers: each a 32-bit word at an offset from its base.
class Block {
 public:
  explicit constexpr Block(std::uint32_t base) noexcept : base_(base) {}
  [[nodiscard]] Register& operator[](std::uint32_t offset) const noexcept { return at(base_ + offset); }

 private:
  std::uint32_t base_;
};

namespace scb {
inline constexpr Block kBlock{0xE000'E000};
inline constexpr std::uint32_t kNvicEnable = 0x100;    // plus 4 per 32 interrupts
inline constexpr std::uint32_t kNvicPriority = 0x400;  // one byte per interrupt
inline constexpr std::uint32_t kResetControl = 0xD0C;
inline constexpr std::uint32_t kResetRequest = 0x05FA'0004;
inline constexpr std::uint32_t kConfigControl = 0xD14;
inline constexpr std::uint32_t kTrapDivideByZero = 1U << 4;
inline constexpr std::uint32_t kFaultStatus = 0xD28;
inline constexpr std::uint32_t kCoprocessorAccess = 0xD88;
inline constexpr std::uint32_t kFpuAccess = 0xFU << 20;
}  // namespace scb

}  // namespace groma::cortex_m4
