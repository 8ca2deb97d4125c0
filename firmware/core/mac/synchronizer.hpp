// Where the superframes lie on this node's clock.
#pragma once

#include <cstdint>

#include "firmware/core/mac/clock_tracker.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::mac {

enum class SyncState : std::uint8_t {
  kSearching,  // no idea
  kLocked,     // the last beacon was heard
  kCoasting,   // going on by the filter alone
};

class Synchronizer {
 public:
  explicit Synchronizer(const Superframe& superframe) noexcept : superframe_(superframe) {}

  // This node is the master: superframe 0 starts at `start`.
  void lead(ranging::ClockTime start) noexcept;
  // Forgets everything.
  void search() noexcept;

  // A beacon of superframe `number` had its RMARKER at `stamp`; `master_offset_ppb` as its carrier tells.
  // False where it does not fit to those before: then it is not used, unless it is the third such in a row.
  bool on_beacon(std::uint32_t number, ranging::ClockTime stamp, std::int32_t master_offset_ppb) noexcept;
  // The beacon due in superframe `number` did not come. Ends the coasting when the time of the next ones is
  // not known within the guard any more, or after 100 in a row.
  void on_beacon_missed(std::uint32_t number) noexcept;

  [[nodiscard]] SyncState state() const noexcept { return state_; }
  [[nodiscard]] std::uint32_t missed_in_a_row() const noexcept { return missed_; }
  [[nodiscard]] std::int32_t skew_ppb() const noexcept { return leading_ ? 0 : tracker_.skew_ppb(); }

  // Not while searching: the start of superframe `number` on this node's clock, and how far off it may be (5
  // sigma).
  [[nodiscard]] ranging::ClockTime start(std::uint32_t number) const noexcept;
  [[nodiscard]] ranging::Ticks margin(std::uint32_t number) const noexcept;

 private:
  [[nodiscard]] ranging::Ticks master_time(std::uint32_t number) const noexcept;

  Superframe superframe_;
  ClockTracker tracker_;
  SyncState state_ = SyncState::kSearching;
  bool leading_ = false;
  ranging::ClockTime lead_start_;
  std::uint32_t base_ = 0;  // superframe at which the master's time is taken as 0
  std::uint32_t missed_ = 0;
  std::uint32_t misfits_ = 0;
};

}  // namespace groma::mac
