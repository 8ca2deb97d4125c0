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

// A beacon as it was heard.
struct BeaconStamp {
  std::uint32_t superframe = 0;
  ranging::Ticks place{};  // of its RMARKER from the superframe's start, by the network's time
  ranging::ClockTime heard{};
  std::int32_t offset_ppb = 0;  // the sender's clock against this node's, as the carrier tells
  // Of what the sender knows of the network's time.
  std::uint8_t hop = 0;
  std::uint8_t age = 0;
};

class Synchronizer {
 public:
  // Keeps a reference.
  explicit Synchronizer(const Superframe& superframe) noexcept : superframe_(superframe) {}

  // This node founds a session: superframe 0 starts at `start`.
  void found(ranging::ClockTime start) noexcept;
  // This node is the master from now on, or is it no more; the time goes on as it is known.
  void lead() noexcept;
  void follow() noexcept;
  // Forgets everything.
  void search() noexcept;

  // Takes the first beacon of a timeline. Its sender need not be the master: the carrier tells of the
  // sender's clock, which may be off by some ppm against the network's.
  void adopt(const BeaconStamp& beacon) noexcept;
  // Takes a further one. `other_path`: from another sender than those before, so that its flight time is
  // another. False where it does not fit to those before: then it is not used, unless it is the third such in
  // a row and `persuasive`.
  bool on_beacon(const BeaconStamp& beacon, bool other_path, bool persuasive = true) noexcept;
  // The beacon due in superframe `number` did not come.
  void on_beacon_missed() noexcept;
  // Superframe `number` begins. Ends the coasting when its time is not known within the guard any more, or
  // nothing was heard for 100 superframes.
  void begin(std::uint32_t number) noexcept;

  [[nodiscard]] SyncState state() const noexcept { return state_; }
  [[nodiscard]] std::uint32_t missed_in_a_row() const noexcept { return missed_; }
  [[nodiscard]] std::int32_t skew_ppb() const noexcept { return leading_ ? 0 : tracker_.skew_ppb(); }

  // Not while searching: the start of superframe `number` on this node's clock, and how far off it may be (5
  // sigma).
  [[nodiscard]] ranging::ClockTime start(std::uint32_t number) const noexcept;
  [[nodiscard]] ranging::Ticks margin(std::uint32_t number) const noexcept;
  // The network's time, counted from the start of superframe 0, that it is at `local`. Continuous over a
  // change of master.
  [[nodiscard]] ranging::Ticks network_time(ranging::ClockTime local) const noexcept;

 private:
  [[nodiscard]] ranging::Ticks master_time(std::uint32_t number) const noexcept;

  const Superframe& superframe_;
  ClockTracker tracker_;
  SyncState state_ = SyncState::kSearching;
  bool leading_ = false;
  std::uint32_t base_ = 0;        // superframe at which the tracker takes the network's time as 0
  std::uint32_t last_heard_ = 0;  // superframe
  std::uint32_t missed_ = 0;
  std::uint32_t misfits_ = 0;
};

}  // namespace groma::mac
