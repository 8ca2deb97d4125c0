// What a tag and an anchor have in common: their place in the site, sending and taking frames, keeping in
// step.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/step.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/mac/synchronizer.hpp"
#include "groma.pb.h"

namespace groma::mac {

struct Site {
  std::uint16_t id = 0;
  std::uint16_t network_id = 0;
  dw1000::Preamble preamble = dw1000::Preamble::k128;
  groma_Schedule schedule = groma_Schedule_init_zero;  // one that check() has passed
  ranging::Ticks transmit_antenna_delay{};
};

class Station {
 public:
  // Counts into `counters`, which outlives it.
  Station(const Site& site, groma_Counters& counters) noexcept;

  [[nodiscard]] const Site& site() const noexcept { return site_; }
  [[nodiscard]] const Superframe& superframe() const noexcept { return superframe_; }
  [[nodiscard]] std::uint32_t hash() const noexcept { return hash_; }
  [[nodiscard]] groma_Counters& counters() noexcept { return counters_; }
  [[nodiscard]] Synchronizer& sync() noexcept { return sync_; }
  [[nodiscard]] const Synchronizer& sync() const noexcept { return sync_; }

  // A frame of this network that is for this node or for all; what is not is counted and nothing.
  [[nodiscard]] std::optional<Frame> accept(const Reception& reception) noexcept;

  // Takes a beacon into the clock filter. False, and counted, where it is not the master's, tells of another
  // schedule, or its stamp is of no use.
  bool take_beacon(const Frame& frame, const Beacon& beacon, const Reception& reception) noexcept;
  void beacon_missed(std::uint32_t superframe) noexcept;

  [[nodiscard]] Action transmit(ranging::ClockTime stamp, std::uint16_t destination,
                                const Body& body) noexcept;
  // The last stamp on the grid that is not after `latest`.
  [[nodiscard]] ranging::ClockTime stamp_not_after(ranging::ClockTime latest) const noexcept {
    return ranging::transmit_stamp_not_after(latest, site_.transmit_antenna_delay);
  }

  // Listens for a frame of up to `bytes` whose RMARKER is due at `due`, `slack` beside the guard on each
  // side.
  [[nodiscard]] Action listen(ranging::ClockTime due, std::size_t bytes, ranging::Ticks slack) const noexcept;
  [[nodiscard]] Action listen_for_beacon(std::uint32_t superframe) const noexcept;
  // Listens for any beacon, for a while.
  [[nodiscard]] static Action search(ranging::ClockTime now) noexcept;
  // The rest of a listening that a frame of no use has ended.
  [[nodiscard]] static Action listen_on(const Action& interrupted) noexcept;

  [[nodiscard]] ranging::ClockTime beacon_due(std::uint32_t superframe) const noexcept {
    return sync_.start(superframe) + superframe_.beacon();
  }
  [[nodiscard]] ranging::ClockTime poll_due(std::uint32_t superframe, std::size_t slot) const noexcept {
    return sync_.start(superframe) + superframe_.poll(slot);
  }
  // A frame due then has its preamble still to come.
  [[nodiscard]] bool ahead(ranging::ClockTime due, ranging::ClockTime now) const noexcept {
    return due - superframe_.phy().before_rmarker() > now;
  }

 private:
  Site site_;
  Superframe superframe_;
  std::uint32_t hash_;
  Synchronizer sync_;
  groma_Counters& counters_;
  std::uint8_t sequence_ = 0;
  FrameBytes outgoing_;
};

}  // namespace groma::mac
