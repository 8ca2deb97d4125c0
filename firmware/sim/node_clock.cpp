#include "firmware/sim/node_clock.hpp"

#include <algorithm>
#include <cmath>

namespace groma::sim {

namespace {

__extension__ using Wide = __int128;

constexpr int kFractionBits = 48;
constexpr int kPieceBits = 30;
constexpr std::int64_t kPiece = std::int64_t{1} << kPieceBits;

std::int64_t to_fraction(double ratio) noexcept {
  return std::llround(std::ldexp(ratio, kFractionBits));
}

}  // namespace

NodeClock::NodeClock(const ClockSpec& spec) noexcept
    : offset_(to_fraction(spec.offset_ppm * 1e-6)),
      offset_a_piece_(to_fraction(spec.drift_ppm_per_s * 1e-6 * to_seconds(kPiece))),
      drift_first_(from_seconds(std::max(spec.drift_from_s, 0.0)) >> kPieceBits),
      drift_pieces_(
          std::max<std::int64_t>((from_seconds(spec.drift_until_s) >> kPieceBits) - drift_first_, 0)),
      first_tick_(static_cast<std::int64_t>(spec.first_tick)) {}

std::int64_t NodeClock::offset_of_piece(std::int64_t piece) const noexcept {
  return offset_ + offset_a_piece_ * std::clamp<std::int64_t>(piece - drift_first_, 0, drift_pieces_);
}

NodeClock::Phase NodeClock::phase(SimTime t) const noexcept {
  Wide excess = static_cast<Wide>(t) * offset_;
  if (offset_a_piece_ != 0) {
    // The steps of all whole pieces before this one, summed: none, then one more each piece, then all of
    // them.
    const std::int64_t piece = t >> kPieceBits;
    const std::int64_t grown = std::clamp<std::int64_t>(piece - drift_first_, 0, drift_pieces_);
    const Wide steps =
        static_cast<Wide>(grown) * (grown - 1) / 2 +
        static_cast<Wide>(std::max<std::int64_t>(piece - drift_first_ - drift_pieces_, 0)) * drift_pieces_;
    excess += ((steps << kPieceBits) + static_cast<Wide>(t & (kPiece - 1)) * grown) * offset_a_piece_;
  }
  const std::uint64_t mask = (std::uint64_t{1} << kFractionBits) - 1;
  return {t + static_cast<std::int64_t>(excess >> kFractionBits), static_cast<std::uint64_t>(excess) & mask};
}

std::int64_t NodeClock::local_units(SimTime t) const noexcept {
  return phase(t).units;
}

std::int64_t NodeClock::ticks(SimTime t) const noexcept {
  return phase(t).units / kUnitsPerTick + first_tick_;
}

std::int64_t NodeClock::nearest_tick(SimTime t, double plus_ticks) const noexcept {
  const Phase at = phase(t);
  const std::int64_t whole = at.units / kUnitsPerTick;
  const double rest = (static_cast<double>(at.units - whole * kUnitsPerTick) +
                       std::ldexp(static_cast<double>(at.fraction), -kFractionBits)) /
                      static_cast<double>(kUnitsPerTick);
  return whole + first_tick_ + static_cast<std::int64_t>(std::floor(rest + plus_ticks + 0.5));
}

SimTime NodeClock::time_of_local(std::int64_t units) const noexcept {
  if (units <= 0) return 0;
  // The offset is below 1e-3, so that each step leaves at most a thousandth of the error before it; after the
  // first few the last unit is found by trying.
  SimTime t = units;
  for (std::int64_t missing = 2; missing > 1 || missing < -1;) {
    missing = units - phase(t).units;
    t = std::max<SimTime>(t + missing, 0);
  }
  while (phase(t).units < units) ++t;
  while (t > 0 && phase(t - 1).units >= units) --t;
  return t;
}

SimTime NodeClock::time_of_tick(std::int64_t tick) const noexcept {
  return time_of_local((tick - first_tick_) * kUnitsPerTick);
}

double NodeClock::offset(SimTime t) const noexcept {
  return std::ldexp(static_cast<double>(offset_of_piece(t >> kPieceBits)), -kFractionBits);
}

}  // namespace groma::sim
