#include "firmware/sim/emulator/peripheral.hpp"

#include <array>
#include <cstdio>

namespace groma::sim {

namespace {

constexpr std::uint32_t kFirstEvent = 0x100;
constexpr std::uint32_t kLastEvent = 0x17C;
constexpr std::uint32_t kIntenset = 0x304;
constexpr std::uint32_t kIntenclr = 0x308;

}  // namespace

std::string hexadecimal(std::uint32_t value) {
  std::array<char, 16> text{};
  std::snprintf(text.data(), text.size(), "0x%08X", static_cast<unsigned>(value));
  return text.data();
}

bool EventRegisters::is_event(std::uint32_t offset) const noexcept {
  return offset >= kFirstEvent && offset <= kLastEvent &&
         (modelled_ >> ((offset - kFirstEvent) / 4) & 1U) != 0;
}

std::optional<std::uint32_t> EventRegisters::read(std::uint32_t offset) const noexcept {
  if (is_event(offset)) return raised((offset - kFirstEvent) / 4) ? 1 : 0;
  if (offset == kIntenset || offset == kIntenclr) return enabled_;
  return std::nullopt;
}

bool EventRegisters::write(std::uint32_t offset, std::uint32_t value) noexcept {
  if (is_event(offset)) {
    const std::uint32_t bit = 1U << ((offset - kFirstEvent) / 4);
    events_ = value != 0 ? events_ | bit : events_ & ~bit;
    return true;
  }
  std::uint32_t enabled = enabled_;
  switch (offset) {
    case kIntenset:
      enabled |= value;
      break;
    case kIntenclr:
      // Drivers clear all bits first, those of events that are not modelled too.
      enabled &= ~value;
      break;
    default:
      return false;
  }
  if ((enabled & (~modelled_ | polled_only_)) != 0) return false;
  enabled_ = enabled;
  return true;
}

}  // namespace groma::sim
