#include "firmware/sim/dw1000_tuning.hpp"

#include <algorithm>

namespace groma::sim {

namespace {

// LDE_REPC by preamble code at 6.8 Mbit/s (user manual, table 51).
constexpr std::uint64_t replica_coefficient(std::uint8_t code) noexcept {
  switch (code) {
    case 9:
      return 0x28F4;
    case 10:
      return 0x3332;
    case 11:
      return 0x3AE0;
    case 12:
      return 0x3D70;
    default:
      return 0;
  }
}

// DRX_TUNE2 by PAC at PRF 64 MHz (table 33).
constexpr std::uint16_t pac_of(std::uint64_t drx_tune2) noexcept {
  switch (drx_tune2) {
    case 0x313B006B:
      return 8;
    case 0x333B00BE:
      return 16;
    case 0x353B015E:
      return 32;
    case 0x373B0296:
      return 64;
    default:
      return 0;
  }
}

struct PreambleSpan {
  std::uint16_t shortest = 0;
  std::uint16_t longest = 0;
};

// The recommended PAC (table 6).
constexpr PreambleSpan preambles_of_pac(std::uint16_t pac) noexcept {
  switch (pac) {
    case 8:
      return {64, 128};
    case 16:
      return {256, 512};
    case 32:
      return {1024, 1024};
    case 64:
      return {1536, 4096};
    default:
      return {};
  }
}

// DRX_TUNE1b and DRX_TUNE4H (tables 32 and 34), at 6.8 Mbit/s.
constexpr PreambleSpan preambles_of_tune(std::uint64_t tune1b, std::uint64_t tune4h) noexcept {
  if (tune1b == 0x0010 && tune4h == 0x0010) return {64, 64};
  if (tune1b == 0x0020 && tune4h == 0x0028) return {128, 1024};
  return {};
}

}  // namespace

Tuning read_tuning(const Dw1000Registers& registers) noexcept {
  const auto holds = [&](Reg reg, std::uint64_t value) { return registers.get(reg) == value; };
  Tuning tuning;
  const std::uint64_t channel = registers.get(Reg::kChanCtrl);
  tuning.transmit_code = static_cast<std::uint8_t>((channel >> 22) & 0x1F);
  tuning.receive_code = static_cast<std::uint8_t>(channel >> 27);
  const bool synthesizer = holds(Reg::kFsPllCfg, 0x0800041D) && holds(Reg::kFsPllTune, 0xBE);
  const auto code_is_modelled = [](std::uint8_t code) { return code >= 9 && code <= 12; };

  tuning.transmits = synthesizer && (channel & 0xF) == 5 && holds(Reg::kRfTxCtrl, 0x001E3FE3) &&
                     holds(Reg::kTcPgDelay, 0xB5) && code_is_modelled(tuning.transmit_code);

  const bool prf_64 = ((channel >> 18) & 3) == 2;
  tuning.receives = synthesizer && prf_64 && ((channel >> 4) & 0xF) == 5 && holds(Reg::kRfRxCtrlH, 0xD8) &&
                    holds(Reg::kAgcTune1, 0x889B) && holds(Reg::kAgcTune2, 0x2502A907) &&
                    holds(Reg::kAgcTune3, 0x0035) && holds(Reg::kDrxTune0b, 0x0001) &&
                    holds(Reg::kDrxTune1a, 0x008D) && code_is_modelled(tuning.receive_code);
  tuning.pac_symbols = pac_of(registers.get(Reg::kDrxTune2));
  const PreambleSpan by_pac = preambles_of_pac(tuning.pac_symbols);
  const PreambleSpan by_tune =
      preambles_of_tune(registers.get(Reg::kDrxTune1b), registers.get(Reg::kDrxTune4h));
  tuning.shortest_preamble = std::max(by_pac.shortest, by_tune.shortest);
  tuning.longest_preamble = std::min(by_pac.longest, by_tune.longest);

  tuning.timestamps_valid = holds(Reg::kLdeCfg1, 0x6D) && holds(Reg::kLdeCfg2, 0x0607) &&
                            registers.get(Reg::kLdeRepc) == replica_coefficient(tuning.receive_code);
  return tuning;
}

}  // namespace groma::sim
