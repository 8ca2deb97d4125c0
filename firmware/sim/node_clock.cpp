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

std::vector<DriftRamp> up_and_down(double ppm_per_s, double height_ppm, double from_s, double until_s) {
  const double side_s = std::abs(height_ppm / ppm_per_s);
  std::vector<DriftRamp> ramps;
  for (double start_s = from_s; start_s + 2.0 * side_s <= until_s; start_s += 2.0 * side_s) {
    const double top_s = start_s + side_s;
    ramps.push_back({ppm_per_s, start_s, top_s});
    ramps.push_back({-ppm_per_s, top_s, top_s + side_s});
  }
  return ramps;
}

NodeClock::NodeClock(const ClockSpec& spec) noexcept
    : offset_(to_fraction(spec.offset_ppm * 1e-6)), first_tick_(static_cast<std::int64_t>(spec.first_tick)) {
  const auto add = [&](const DriftRamp& ramp) {
    const std::int64_t first = from_seconds(std::max(ramp.from_s, 0.0)) >> kPieceBits;
    const std::int64_t pieces = std::max<std::int64_t>((from_seconds(ramp.until_s) >> kPieceBits) - first, 0);
    const std::int64_t a_piece = to_fraction(ramp.ppm_per_s * 1e-6 * to_seconds(kPiece));
    if (a_piece != 0 && pieces != 0) ramps_.push_back({a_piece, first, pieces});
  };
  add({spec.drift_ppm_per_s, spec.drift_from_s, spec.drift_until_s});
  for (const DriftRamp& ramp : spec.more_ramps) add(ramp);
}

std::int64_t NodeClock::offset_of_piece(std::int64_t piece) const noexcept {
  std::int64_t offset = offset_;
  for (const Ramp& ramp : ramps_)
    offset += ramp.offset_a_piece * std::clamp<std::int64_t>(piece - ramp.first, 0, ramp.pieces);
  return offset;
}

NodeClock::Phase NodeClock::phase(SimTime t) const noexcept {
  Wide excess = static_cast<Wide>(t) * offset_;
  const std::int64_t piece = t >> kPieceBits;
  for (const Ramp& ramp : ramps_) {
    // The sum of the ramp's steps over all whole pieces before this one. The steps are none before the ramp,
    // one more in each of its pieces, and all of them after it.
    const std::int64_t grown = std::clamp<std::int64_t>(piece - ramp.first, 0, ramp.pieces);
    const Wide steps =
        static_cast<Wide>(grown) * (grown - 1) / 2 +
        static_cast<Wide>(std::max<std::int64_t>(piece - ramp.first - ramp.pieces, 0)) * ramp.pieces;
    excess += ((steps << kPieceBits) + static_cast<Wide>(t & (kPiece - 1)) * grown) * ramp.offset_a_piece;
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
  // The offset is below 1e-3, so each step reduces the error to at most a thousandth. The last unit is found
  // by trying.
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
