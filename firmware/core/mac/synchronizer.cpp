#include "firmware/core/mac/synchronizer.hpp"

namespace groma::mac {

using ranging::ClockTime;
using ranging::Ticks;

void Synchronizer::lead(ClockTime start) noexcept {
  leading_ = true;
  lead_start_ = start;
  base_ = 0;
  state_ = SyncState::kLocked;
}

void Synchronizer::search() noexcept {
  leading_ = false;
  tracker_ = ClockTracker();
  state_ = SyncState::kSearching;
  missed_ = 0;
  misfits_ = 0;
}

// Since superframe `base_`: the difference survives the number's wrap.
Ticks Synchronizer::master_time(std::uint32_t number) const noexcept {
  return std::int64_t{static_cast<std::int32_t>(number - base_)} * superframe_.duration();
}

bool Synchronizer::on_beacon(std::uint32_t number, ClockTime stamp, std::int32_t master_offset_ppb) noexcept {
  constexpr std::uint32_t kMisfitsBelieved = 3;
  const ClockTime start = stamp - superframe_.beacon();
  if (state_ != SyncState::kSearching) {
    if (tracker_.update(master_time(number), start)) {
      missed_ = 0;
      misfits_ = 0;
      state_ = SyncState::kLocked;
      return true;
    }
    if (++misfits_ < kMisfitsBelieved) return false;
  }
  base_ = number;
  tracker_.seed(Ticks(0), start, master_offset_ppb);
  missed_ = 0;
  misfits_ = 0;
  state_ = SyncState::kLocked;
  return true;
}

void Synchronizer::on_beacon_missed(std::uint32_t number) noexcept {
  if (state_ == SyncState::kSearching || leading_) return;
  ++missed_;
  state_ = SyncState::kCoasting;
  // A master that is away for longer may have started anew at any other time.
  constexpr std::uint32_t kMostMissed = 100;
  if (missed_ >= kMostMissed || margin(number + 1) > superframe_.guard()) search();
}

ClockTime Synchronizer::start(std::uint32_t number) const noexcept {
  const Ticks master = master_time(number);
  return leading_ ? lead_start_ + master : tracker_.local(master);
}

Ticks Synchronizer::margin(std::uint32_t number) const noexcept {
  constexpr std::int64_t kSigmas = 5;
  return leading_ ? Ticks(0) : kSigmas * tracker_.sigma(master_time(number));
}

}  // namespace groma::mac
