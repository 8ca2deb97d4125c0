// The registers of the nRF52832 that the image uses (nRF52832 Product Specification v1.4, with the section at
// each block).
#pragma once

#include <cstdint>

#include "firmware/arch/cortex_m4/registers.hpp"

namespace groma::nrf52832 {

using cortex_m4::at;
using cortex_m4::Block;
using cortex_m4::Register;

// Waits until a write has reached the register's peripheral, so that its interrupt is not taken again at the
// handler's return (6.1.8).
inline void settle(const Register& reg) noexcept {
  [[maybe_unused]] const std::uint32_t read_back = reg;
}

inline void clear_event(Register& event) noexcept {
  event = 0;
  settle(event);
}

enum class Irq : std::uint8_t {
  kPowerClock = 0,
  kUarte0 = 2,
  kGpiote = 6,
  kTimer0 = 8,
  kEcb = 14,
  kWatchdog = 16,
};

// ---- FICR (13) and UICR (14) -----------------------------------------------------------------------------
namespace ficr {
inline constexpr Block kBlock{0x1000'0000};
// Not in the product specification: Nordic's start-up code reads part and revision there.
inline constexpr std::uint32_t kPart = 0x130;
inline constexpr std::uint32_t kNrf52832 = 6;
inline constexpr std::uint32_t kRevision = 0x134;
inline constexpr std::uint32_t kRevision3 = 7;
inline constexpr std::uint32_t kErratum108 = 0x258;
}  // namespace ficr

namespace uicr {
inline constexpr Block kBlock{0x1000'1000};
inline constexpr std::uint32_t kErased = 0xFFFF'FFFF;
inline constexpr std::uint32_t kApprotect = 0x208;
inline constexpr std::uint32_t kApprotectOpen = 0x5A;
}  // namespace uicr

// ---- POWER and CLOCK (18, 19) ----------------------------------------------------------------------------
namespace power {
inline constexpr Block kBlock{0x4000'0000};
inline constexpr std::uint32_t kHfclkStart = 0x000;
inline constexpr std::uint32_t kLfclkStart = 0x008;
inline constexpr std::uint32_t kHfclkStarted = 0x100;
inline constexpr std::uint32_t kResetReason = 0x400;
inline constexpr std::uint32_t kLfclkSource = 0x518;
inline constexpr std::uint32_t kApprotectDisable = 0x558;
inline constexpr std::uint32_t kErratum108 = 0xEE4;
inline constexpr std::uint32_t kResetPin = 1U << 0;
inline constexpr std::uint32_t kResetWatchdog = 1U << 1;
inline constexpr std::uint32_t kResetSoftware = 1U << 2;
inline constexpr std::uint32_t kResetLockup = 1U << 3;
}  // namespace power

// ---- P0 (20) and GPIOTE (21) -----------------------------------------------------------------------------
namespace gpio {
inline constexpr Block kBlock{0x5000'0000};
inline constexpr std::uint32_t kOutSet = 0x508;
inline constexpr std::uint32_t kOutClear = 0x50C;
inline constexpr std::uint32_t kIn = 0x510;
inline constexpr std::uint32_t kDirectionSet = 0x518;
inline constexpr std::uint32_t kDirectionClear = 0x51C;
inline constexpr std::uint32_t kPinConfig = 0x700;  // plus 4 per pin
// Pin configurations: output without and with its input buffer; input without and with a pull.
inline constexpr std::uint32_t kOutput = 0x3;
inline constexpr std::uint32_t kOutputWithInput = 0x1;
inline constexpr std::uint32_t kInput = 0x0;
inline constexpr std::uint32_t kInputPulledDown = 0x4;
inline constexpr std::uint32_t kInputPulledUp = 0xC;
}  // namespace gpio

namespace gpiote {
inline constexpr Block kBlock{0x4000'6000};
inline constexpr std::uint32_t kEventIn = 0x100;  // plus 4 per channel
inline constexpr std::uint32_t kInterruptSet = 0x304;
inline constexpr std::uint32_t kConfig = 0x510;  // plus 4 per channel
inline constexpr std::uint32_t kEventMode = 1;
inline constexpr std::uint32_t kPinShift = 8;
inline constexpr std::uint32_t kRising = 1U << 16;
inline constexpr std::uint32_t kFalling = 2U << 16;
}  // namespace gpiote

// ---- SPIM (31) -------------------------------------------------------------------------------------------
namespace spim {
inline constexpr std::uint32_t kBase1 = 0x4000'4000;
inline constexpr std::uint32_t kBase2 = 0x4002'3000;
inline constexpr std::uint32_t kStart = 0x010;
inline constexpr std::uint32_t kEventEnd = 0x118;
inline constexpr std::uint32_t kEnable = 0x500;
inline constexpr std::uint32_t kEnabled = 7;
inline constexpr std::uint32_t kPinClock = 0x508;
inline constexpr std::uint32_t kPinOut = 0x50C;
inline constexpr std::uint32_t kPinIn = 0x510;
inline constexpr std::uint32_t kFrequency = 0x524;
inline constexpr std::uint32_t kReceivePointer = 0x534;
inline constexpr std::uint32_t kReceiveCount = 0x538;
inline constexpr std::uint32_t kTransmitPointer = 0x544;
inline constexpr std::uint32_t kTransmitCount = 0x548;
inline constexpr std::uint32_t kConfig = 0x554;
inline constexpr std::uint32_t kOverReadByte = 0x5C0;
}  // namespace spim

// ---- UARTE (35) ------------------------------------------------------------------------------------------
namespace uarte {
inline constexpr Block kBlock{0x4000'2000};
inline constexpr std::uint32_t kStartReceive = 0x000;
inline constexpr std::uint32_t kStartTransmit = 0x008;
inline constexpr std::uint32_t kEventByteReceived = 0x108;
inline constexpr std::uint32_t kEventReceiveEnd = 0x110;
inline constexpr std::uint32_t kEventByteSent = 0x11C;
inline constexpr std::uint32_t kEventTransmitEnd = 0x120;
inline constexpr std::uint32_t kEventReceiveStarted = 0x14C;
inline constexpr std::uint32_t kShortcuts = 0x200;
inline constexpr std::uint32_t kShortReceiveEndToStart = 1U << 5;
inline constexpr std::uint32_t kInterruptSet = 0x304;
inline constexpr std::uint32_t kInterruptClear = 0x308;
inline constexpr std::uint32_t kInterruptByteReceived = 1U << 2;
inline constexpr std::uint32_t kInterruptReceiveEnd = 1U << 4;
inline constexpr std::uint32_t kInterruptTransmitEnd = 1U << 8;
inline constexpr std::uint32_t kEnable = 0x500;
inline constexpr std::uint32_t kEnabled = 8;
inline constexpr std::uint32_t kPinTransmit = 0x50C;
inline constexpr std::uint32_t kPinReceive = 0x514;
inline constexpr std::uint32_t kBaudRate = 0x524;
inline constexpr std::uint32_t k1Mbaud = 0x1000'0000;
inline constexpr std::uint32_t kReceivePointer = 0x534;
inline constexpr std::uint32_t kReceiveCount = 0x538;
inline constexpr std::uint32_t kTransmitPointer = 0x544;
inline constexpr std::uint32_t kTransmitCount = 0x548;
}  // namespace uarte

// ---- TIMER (24) ------------------------------------------------------------------------------------------
namespace timer {
inline constexpr Block kBlock0{0x4000'8000};
inline constexpr std::uint32_t kStart = 0x000;
inline constexpr std::uint32_t kClear = 0x00C;
inline constexpr std::uint32_t kCapture = 0x040;       // plus 4 per channel
inline constexpr std::uint32_t kEventCompare = 0x140;  // plus 4 per channel
inline constexpr std::uint32_t kInterruptSet = 0x304;
inline constexpr std::uint32_t kInterruptCompare0 = 1U << 16;
inline constexpr std::uint32_t kMode = 0x504;
inline constexpr std::uint32_t kTimerMode = 0;
inline constexpr std::uint32_t kBitMode = 0x508;
inline constexpr std::uint32_t k32Bits = 3;
inline constexpr std::uint32_t kPrescaler = 0x510;
inline constexpr std::uint32_t k1MHz = 4;
inline constexpr std::uint32_t kCompare = 0x540;  // plus 4 per channel
}  // namespace timer

// ---- ECB (28) --------------------------------------------------------------------------------------------
namespace ecb {
inline constexpr Block kBlock{0x4000'E000};
inline constexpr std::uint32_t kStart = 0x000;
inline constexpr std::uint32_t kStop = 0x004;
inline constexpr std::uint32_t kEventEnd = 0x100;
inline constexpr std::uint32_t kEventError = 0x104;
inline constexpr std::uint32_t kInterruptSet = 0x304;
inline constexpr std::uint32_t kInterruptEnd = 1U << 0;
inline constexpr std::uint32_t kInterruptError = 1U << 1;
inline constexpr std::uint32_t kDataPointer = 0x504;
}  // namespace ecb

// ---- WDT (36) --------------------------------------------------------------------------------------------
namespace wdt {
inline constexpr Block kBlock{0x4001'0000};
inline constexpr std::uint32_t kStart = 0x000;
inline constexpr std::uint32_t kEventTimeout = 0x100;
inline constexpr std::uint32_t kInterruptSet = 0x304;
inline constexpr std::uint32_t kInterruptTimeout = 1U << 0;
inline constexpr std::uint32_t kReloadValue = 0x504;
inline constexpr std::uint32_t kReloadEnable = 0x508;
inline constexpr std::uint32_t kConfig = 0x50C;
inline constexpr std::uint32_t kRunsInSleepAlone = 1U << 0;  // not while a debugger holds the processor
inline constexpr std::uint32_t kReload = 0x600;
inline constexpr std::uint32_t kReloadKey = 0x6E52'4635;
}  // namespace wdt

// ---- NVMC (11) -------------------------------------------------------------------------------------------
namespace nvmc {
inline constexpr Block kBlock{0x4001'E000};
inline constexpr std::uint32_t kReady = 0x400;
inline constexpr std::uint32_t kConfig = 0x504;
inline constexpr std::uint32_t kReadOnly = 0;
inline constexpr std::uint32_t kWrite = 1;
inline constexpr std::uint32_t kErase = 2;
inline constexpr std::uint32_t kErasePage = 0x508;
inline constexpr std::uint32_t kCacheConfig = 0x540;
inline constexpr std::uint32_t kCacheEnabled = 1;
}  // namespace nvmc

}  // namespace groma::nrf52832
