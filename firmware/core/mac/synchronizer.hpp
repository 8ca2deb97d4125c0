// Maps superframes to this node's clock.
#pragma once

#include <cstdint>

#include "firmware/core/mac/clock_tracker.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/step.hpp"
#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {

enum class SyncState : std::uint8_t {
  kSearching,  // time not known
  kLocked,     // the last beacon was heard
  kCoasting,   // predicted by the clock filter alone
};

class Synchronizer {
 public:
  // Keeps a reference to the superframe.
  explicit Synchronizer(const Superframe& superframe) noexcept : superframe_(superframe) {}

  // This node starts a session: superframe 0 starts at `start`.
  void found(ClockTime start) noexcept;
  // This node becomes the master, or stops being it; the time continues.
  void lead() noexcept;
  void follow() noexcept;
  // Discards the time.
  void search() noexcept;
  // This node's clock has continued over a restart, with an error of some us.
  void on_clock_restart() noexcept;

  // Initializes the time from the first beacon of a timeline. Its sender may be a relay: the carrier then
  // gives the relay's clock, which may be some ppm off the network's.
  void adopt(const Beacon& beacon, const Reception& reception) noexcept;
  // Updates with a further beacon. `other_path`: its sender, and so its flight time, differs from those
  // before. Returns false and ignores the beacon if it does not fit; but a `persuasive` third misfit in a row
  // re-initializes the time.
  bool on_beacon(const Beacon& beacon, const Reception& reception, bool other_path, bool persuasive) noexcept;
  // The beacon due in the present superframe did not come.
  void on_beacon_missed() noexcept;
  // Superframe `number` begins. Gives up coasting if the uncertainty exceeds the guard, or after 100
  // superframes without a beacon.
  void begin(std::uint32_t number) noexcept;

  [[nodiscard]] SyncState state() const noexcept { return state_; }
  [[nodiscard]] std::uint32_t missed_in_a_row() const noexcept { return missed_; }
  [[nodiscard]] std::int32_t skew_ppb() const noexcept { return leading_ ? 0 : tracker_.skew_ppb(); }

  // Not while searching: the start of superframe `number` on this node's clock, and its uncertainty (5
  // sigma).
  [[nodiscard]] ClockTime start(std::uint32_t number) const noexcept;
  [[nodiscard]] Ticks margin(std::uint32_t number) const noexcept;
  // How far the timeline of a beacon heard at `heard` is ahead of this node's.
  [[nodiscard]] Ticks ahead_by(const Beacon& beacon, ClockTime heard) const noexcept {
    return start(beacon.superframe) + superframe_.rmarker(beacon) - heard;
  }
  // The network time when this node's clock shows `local`, since the start of superframe 0. Continuous over a
  // change of master.
  [[nodiscard]] Ticks network_time(ClockTime local) const noexcept;

 private:
  [[nodiscard]] Ticks master_time(std::uint32_t number) const noexcept;
  void enter(SyncState state) noexcept;

  const Superframe& superframe_;
  ClockTracker tracker_;
  SyncState state_ = SyncState::kSearching;
  bool leading_ = false;
  std::uint32_t base_ = 0;        // superframe at which the tracker's master time is 0
  std::uint32_t last_heard_ = 0;  // superframe
  std::uint32_t missed_ = 0;
  std::uint32_t misfits_ = 0;
};

}  // namespace groma::mac
