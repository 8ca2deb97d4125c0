// Maps superframes to this node's clock.
#pragma once

#include <cmath>
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
  void found(ClockTime start) noexcept {
    search();
    base_ = last_heard_ = 0;
    tracker_.seed(Ticks(0), start, 0);
    lead();
  }
  // This node becomes the master, or stops being it; the time continues.
  void lead() noexcept {
    leading_ = true;
    enter(SyncState::kLocked);
  }
  void follow() noexcept {
    if (leading_) tracker_.widen(kFormerMasterSigma_ticks);
    leading_ = false;
  }
  // Discards the time.
  void search() noexcept {
    leading_ = false;
    tracker_ = ClockTracker();
    enter(SyncState::kSearching);
  }
  // This node's clock has continued over a restart, with an error of some us.
  void on_clock_restart() noexcept { tracker_.widen(kRestartSigma_ticks); }

  // Initializes the time from the first beacon of a timeline. Its sender may be a relay: the carrier then
  // gives the relay's clock, which may be some ppm off the network's.
  void adopt(const Beacon& beacon, const Reception& reception) noexcept {
    leading_ = false;
    base_ = last_heard_ = beacon.superframe;
    // A relay's crystal is similar to the master's, no more: the best estimate is half the relay's offset.
    constexpr std::int32_t kCarrierSigma_ppb = 1'000;
    constexpr std::int32_t kRelaySigma_ppb = 15'000;
    // Without the carrier: 5 sigma are two crystals at opposite limits of 20 ppm.
    constexpr std::int32_t kCrystalSigma_ppb = 8'000;
    const bool relayed = beacon.hop != 0;
    const auto& carrier_ppb = reception.quality.clock_offset_ppb;
    const std::int32_t offset_ppb = carrier_ppb.value_or(0);
    tracker_.seed(superframe_.rmarker(beacon), reception.timestamp, relayed ? offset_ppb / 2 : offset_ppb,
                  !carrier_ppb ? kCrystalSigma_ppb
                  : relayed    ? kRelaySigma_ppb
                               : kCarrierSigma_ppb);
    enter(SyncState::kLocked);
  }
  // Updates with a further beacon. `other_path`: its sender, and so its flight time, differs from those
  // before. Returns false and ignores the beacon if it does not fit; but a `persuasive` third misfit in a row
  // re-initializes the time.
  bool on_beacon(const Beacon& beacon, const Reception& reception, bool other_path,
                 bool persuasive) noexcept {
    constexpr std::uint32_t kMisfitsBelieved = 3;
    if (other_path) tracker_.widen(kPathSigma_ticks);
    const float sigma = relay_sigma_ticks(beacon, superframe_.duration());
    const Ticks sent = master_time(beacon.superframe) + superframe_.rmarker(beacon);
    if (!tracker_.update(sent, reception.timestamp, sigma)) {
      if (!persuasive || ++misfits_ < kMisfitsBelieved) return false;
      adopt(beacon, reception);
      return true;
    }
    last_heard_ = beacon.superframe;
    enter(SyncState::kLocked);
    return true;
  }
  // The beacon due in the present superframe did not come.
  void on_beacon_missed() noexcept {
    if (state_ == SyncState::kSearching || leading_) return;
    ++missed_;
    state_ = SyncState::kCoasting;
  }
  // Superframe `number` begins. Gives up coasting if the uncertainty exceeds the guard, or after 100
  // superframes without a beacon.
  void begin(std::uint32_t number) noexcept {
    if (state_ == SyncState::kSearching) return;
    if (leading_) {
      tracker_.rebase(master_time(number));
      last_heard_ = number;
      return;
    }
    constexpr std::int32_t kMostSilent = 100;
    const auto silent = static_cast<std::int32_t>(number - last_heard_);
    if (silent > kMostSilent || margin(number) > superframe_.guard()) search();
  }

  [[nodiscard]] SyncState state() const noexcept { return state_; }
  [[nodiscard]] std::uint32_t missed_in_a_row() const noexcept { return missed_; }
  [[nodiscard]] std::int32_t skew_ppb() const noexcept { return leading_ ? 0 : tracker_.skew_ppb(); }

  // Not while searching: the start of superframe `number` on this node's clock, and its uncertainty (5
  // sigma).
  [[nodiscard]] ClockTime start(std::uint32_t number) const noexcept {
    return tracker_.local(master_time(number));
  }
  [[nodiscard]] Ticks margin(std::uint32_t number) const noexcept {
    constexpr std::int64_t kSigmas = 5;
    return leading_ ? Ticks(0) : kSigmas * tracker_.sigma(master_time(number));
  }
  // How far the timeline of a beacon heard at `heard` is ahead of this node's.
  [[nodiscard]] Ticks ahead_by(const Beacon& beacon, ClockTime heard) const noexcept {
    return start(beacon.superframe) + superframe_.rmarker(beacon) - heard;
  }
  // The network time when this node's clock shows `local`, since the start of superframe 0. Continuous over a
  // change of master.
  [[nodiscard]] Ticks network_time(ClockTime local) const noexcept {
    return std::int64_t{base_} * superframe_.duration() + tracker_.master(local);
  }

 private:
  // Flight times of two senders differ by about 50 m, and a relay's time by as much: 0.2 us.
  static constexpr float kPathSigma_ticks = 12'800.0F;
  // Difference to another master's time, of a master that has led by itself for long.
  static constexpr float kFormerMasterSigma_ticks = 320'000.0F;
  // Error of this node's clock after it has continued by the processor's: 1 us.
  static constexpr float kRestartSigma_ticks = 64'000.0F;

  // The error that a relay adds to a beacon: its receive timestamp's at each hop, and its clock's random walk
  // (as the tracker's: 0.1 ppm in a second) since it received the beacon.
  [[nodiscard]] static float relay_sigma_ticks(const Beacon& beacon, Ticks duration) noexcept {
    constexpr float kBeaconSigma_ticks = 13.0F;
    constexpr float kWalk_ticks = 6'390.0F / 1.732F;
    const float silent_s = static_cast<float>(beacon.age) * static_cast<float>(duration.count()) /
                           static_cast<float>(Ticks::kPerSecond);
    return kBeaconSigma_ticks * static_cast<float>(beacon.hop) + kWalk_ticks * silent_s * std::sqrt(silent_s);
  }
  // The time since superframe `base_`; correct across the number's wrap.
  [[nodiscard]] Ticks master_time(std::uint32_t number) const noexcept {
    return std::int64_t{static_cast<std::int32_t>(number - base_)} * superframe_.duration();
  }
  void enter(SyncState state) noexcept {
    state_ = state;
    missed_ = misfits_ = 0;
  }

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
