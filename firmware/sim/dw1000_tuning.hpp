// Which frames a DW1000 can send and receive with its present register values. The values must be those of
// the manual's tables: with any other value the model neither sends nor receives. Modelled: channel 5, PRF 64
// MHz, preamble codes 9 to 12.
#pragma once

#include <cstdint>

#include "firmware/sim/dw1000_registers.hpp"
#include "firmware/sim/medium.hpp"

namespace groma::sim {

struct Tuning {
  bool transmits = false;
  bool receives = false;
  bool timestamps_valid = false;  // the leading-edge detection is set up for the code in use
  std::uint8_t transmit_code = 0;
  std::uint8_t receive_code = 0;
  std::uint16_t pac_symbols = 8;
  std::uint16_t shortest_preamble = 0;  // symbols; the range that the receiver is set up for
  std::uint16_t longest_preamble = 0;

  [[nodiscard]] bool can_receive(const AirFormat& format) const noexcept {
    return receives && format.channel == 5 && format.prf_mhz == 64 && format.preamble_code == receive_code &&
           format.preamble_symbols >= shortest_preamble && format.preamble_symbols <= longest_preamble;
  }
};

[[nodiscard]] Tuning read_tuning(const Dw1000Registers& registers) noexcept;

}  // namespace groma::sim
