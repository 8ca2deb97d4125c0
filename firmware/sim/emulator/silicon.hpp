// What the nRF52832's silicon does beyond its product specification: docs/explanation/silicon.md has the
// sources, and what is uncertain. Each quirk can be switched off; the start of the crystal is a time.
#pragma once

#include "firmware/sim/time.hpp"

namespace groma::sim {

struct SiliconQuirks {
  // Anomaly 109: the first byte that EasyDMA reads is wrong if the processor falls asleep just after the
  // start of the transfer (kDmaStart, easy_dma.hpp). In the model it is always wrong, by seeded bits.
  bool spim_start = true;
  bool uarte_start = true;  // of a transmission
  bool ecb_start = true;    // no list of the anomaly has ECB; another user of the same AES engine showed it

  // Anomaly 220: RAM is not written in the first cycle after a wake-up. In the model a sleep fails the run
  // unless PRIMASK is set and four NOPs follow, so that nothing is written before.
  bool wake_up = true;

  // An SPI master needs the input buffer of its clock pin, by most of Nordic's drivers. In the model a
  // transfer without it fails the run.
  bool sck_input = true;

  // Anomaly 132: the low-frequency clock may not start if it is started soon after it stopped, or after a
  // reset. In the model this fails the run (ClockPower::kLfclkRestart).
  bool lfclk_restart = true;

  // From the request of the main crystal to its run; the specification has 360 us as typical.
  SimTime hfxo_start = 360 * kUnitsPerMicrosecond;
};

}  // namespace groma::sim
