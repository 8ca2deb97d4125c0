// The registers that the driver writes at bring-up and reads back, with their values for the PHY in use:
// channel 5, PRF 64 MHz, 6.8 Mbit/s, code 9 (user manual 2.5.5 and 7.2.31 ff.).
#pragma once

#include <array>
#include <cstdint>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/dw1000/registers.hpp"

namespace groma::dw1000 {

// A register of up to four bytes and its value.
struct Setting {
  std::uint8_t id = 0;
  std::uint8_t length = 0;
  std::uint16_t sub = 0;
  std::uint32_t value = 0;

  [[nodiscard]] constexpr std::array<std::uint8_t, 4> bytes() const noexcept {
    return {static_cast<std::uint8_t>(value), static_cast<std::uint8_t>(value >> 8),
            static_cast<std::uint8_t>(value >> 16), static_cast<std::uint8_t>(value >> 24)};
  }
};

template <class R>
[[nodiscard]] constexpr Setting setting(const Value<R>& value) noexcept {
  static_assert(R::kReadable && R::kWritable && R::kLength <= 4, "a register that cannot be read back");
  return {.id = R::kId,
          .length = static_cast<std::uint8_t>(R::kLength),
          .sub = R::kSub,
          .value = static_cast<std::uint32_t>(value.word())};
}

// The events that raise the interrupt line: each end of an operation.
inline constexpr Value<reg::SysMask> kInterrupts = [] {
  namespace st = reg::sys_status;
  const auto bits = Value<reg::SysStatus>()
                        .set(st::kTransmitted)
                        .set(st::kHeaderError)
                        .set(st::kReceived)
                        .set(st::kCheckError)
                        .set(st::kSyncLoss)
                        .set(st::kFrameTimeout)
                        .set(st::kPreambleTimeout)
                        .set(st::kSfdTimeout);
  return Value<reg::SysMask>(bits.word());
}();

inline constexpr std::array kFixedSettings = {
    setting(Value<reg::EcCtrl>().set(reg::ec_ctrl::kLockDetect)),
    setting(Value<reg::SysCfg>()
                .set(reg::sys_cfg::kInterruptHigh)
                .set(reg::sys_cfg::kSingleBuffer)
                .set(reg::sys_cfg::kConstantPower)
                .set(reg::sys_cfg::kFrameWaitTimeout)),
    setting(kInterrupts),
    setting(Value<reg::ChanCtrl>(0x4A480055)),
    setting(Value<reg::AgcTune1>(0x889B)),
    setting(Value<reg::AgcTune2>(0x2502A907)),
    setting(Value<reg::AgcTune3>(0x0035)),
    setting(Value<reg::DrxTune0b>(0x0001)),
    setting(Value<reg::DrxTune1a>(0x008D)),
    setting(Value<reg::RfRxctrlh>(0xD8)),
    setting(Value<reg::RfTxctrl>(0x001E3FE3)),
    setting(Value<reg::TcPgdelay>(0xB5)),
    setting(Value<reg::FsPllcfg>(0x0800041D)),
    setting(Value<reg::FsPlltune>(0xBE)),
    setting(Value<reg::LdeCfg1>(0x6D)),
    setting(Value<reg::LdeCfg2>(0x0607)),
    setting(Value<reg::LdeRepc>(0x28F4)),
};

[[nodiscard]] constexpr std::array<Setting, 4> preamble_settings(Preamble preamble) noexcept {
  const bool is_short = preamble == Preamble::k64;
  const bool is_long = preamble == Preamble::k256;
  // The longest search for an SFD: the whole preamble, the SFD, and one symbol of margin.
  const int search = preamble_symbols(preamble) + 1 + kSfdSymbols - acquisition_chunk_symbols(preamble);
  return {setting(Value<reg::DrxTune1b>(is_short ? 0x0010U : 0x0020U)),
          setting(Value<reg::DrxTune2>(is_long ? 0x333B00BEU : 0x313B006BU)),
          setting(Value<reg::DrxTune4h>(is_short ? 0x0010U : 0x0028U)),
          setting(Value<reg::DrxSfdtoc>(static_cast<std::uint64_t>(search)))};
}

// TXPSR and PE.
[[nodiscard]] constexpr std::uint8_t preamble_code(Preamble preamble) noexcept {
  return preamble == Preamble::k64 ? 0b0001 : preamble == Preamble::k256 ? 0b1001 : 0b0101;
}

}  // namespace groma::dw1000
