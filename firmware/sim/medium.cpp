#include "firmware/sim/medium.hpp"

#include <cmath>
#include <utility>

#include "firmware/sim/dw1000_chip.hpp"

namespace groma::sim {

namespace {

constexpr double kSpeedOfLight_mps = 299'792'458.0;
constexpr double kTicksPerSecond = 63.8976e9;

// An upper bound of a frame's duration. Receivers ask for a frame's reception before its end.
constexpr SimTime kLongestFrame = 10 * kUnitsPerMillisecond;

// Purposes of draws.
enum : std::uint64_t { kTimestampNoise = 0x5A01, kCarrierNoise, kLossDraw, kLossKind, kJunk, kFade };

Loss kind_of_loss(double uniform) {
  if (uniform < 0.50) return Loss::kUnheard;
  if (uniform < 0.65) return Loss::kSfd;
  if (uniform < 0.80) return Loss::kHeader;
  return Loss::kData;
}

}  // namespace

Medium::Medium(const PropagationModel& propagation, const MediumSettings& settings, std::uint64_t seed)
    : propagation_(propagation), settings_(settings), random_(seed) {}

std::size_t Medium::attach(Dw1000Chip& chip, std::uint16_t id) {
  stations_.push_back({&chip, id, {}});
  return stations_.size() - 1;
}

std::size_t Medium::attach_sender(std::uint16_t id) {
  stations_.push_back({nullptr, id, {}});
  return stations_.size() - 1;
}

void Medium::announce(const std::shared_ptr<const AirFrame>& frame) {
  if (witness_ != nullptr) witness_->announced(*frame);
  post(frame->source, {Notice::Kind::kAnnounced, frame, nullptr, 0});
}

void Medium::retract(const std::shared_ptr<const AirFrame>& frame) {
  post(frame->source, {Notice::Kind::kRetracted, frame, nullptr, 0});
}

void Medium::cut(const std::shared_ptr<AirFrame>& frame, SimTime at) {
  post(frame->source, {Notice::Kind::kCut, nullptr, frame, at});
}

void Medium::post(std::size_t source, const Notice& notice) {
  if (holding_) {
    stations_[source].pending.push_back(notice);
  } else {
    deliver(source, notice);
  }
}

void Medium::deliver(std::size_t source, const Notice& notice) {
  if (notice.kind == Notice::Kind::kCut) {
    notice.cut_frame->cut_at = notice.at;
    return;
  }
  for (std::size_t i = 0; i < stations_.size(); ++i) {
    if (i == source || stations_[i].chip == nullptr) continue;
    if (notice.kind == Notice::Kind::kAnnounced) {
      stations_[i].chip->incoming(notice.frame);
    } else {
      stations_[i].chip->withdraw(*notice.frame);
    }
  }
}

void Medium::hold() {
  holding_ = true;
}

void Medium::release() {
  holding_ = false;
  for (std::size_t source = 0; source < stations_.size(); ++source) {
    for (const Notice& notice : stations_[source].pending) deliver(source, notice);
    stations_[source].pending.clear();
  }
}

Reception Medium::reception(const AirFrame& frame, std::size_t receiver) const {
  const std::uint16_t from = stations_[frame.source].id;
  const std::uint16_t to = stations_[receiver].id;
  const Propagation path = [&] {
    const std::lock_guard lock(propagation_mutex_);
    return propagation_.between(from, to, to_seconds(frame.rmarker));
  }();
  Reception reception;
  reception.audible = path.audible;
  if (!path.audible) return reception;

  const double flight = path.flight_m / kSpeedOfLight_mps * static_cast<double>(kUnitsPerSecond);
  const double whole = std::floor(flight);
  reception.delay = static_cast<SimTime>(whole);
  reception.delay_residue_ticks = (flight - whole) / static_cast<double>(kUnitsPerTick);
  reception.receive_power_dbm = path.receive_power_dbm;
  reception.first_path_power_dbm = path.first_path_power_dbm;

  const auto draw = [&](std::uint64_t purpose) { return random_.of(purpose, from, to, frame.number); };
  reception.junk = draw(kJunk).bits();
  if (settings_.timestamp_noise_s > 0.0)
    reception.timestamp_noise_ticks =
        draw(kTimestampNoise).normal() * settings_.timestamp_noise_s * kTicksPerSecond;
  if (settings_.carrier_noise_ppm > 0.0)
    reception.carrier_noise_ppm = draw(kCarrierNoise).normal() * settings_.carrier_noise_ppm;
  if (settings_.loss_probability > 0.0 && draw(kLossDraw).uniform() < settings_.loss_probability)
    reception.loss = kind_of_loss(draw(kLossKind).uniform());
  if (!fades_.empty() && reception.loss != Loss::kUnheard) fade(frame, from, to, reception);
  return reception;
}

void Medium::add_fade(Fade fade, SimTime now) {
  std::erase_if(fades_, [now](const NumberedFade& old) { return old.fade.until < now - kLongestFrame; });
  fades_.push_back({std::move(fade), fades_added_++});
}

// The worst loss of all fades that affect the frame.
void Medium::fade(const AirFrame& frame, std::uint16_t from, std::uint16_t to, Reception& reception) const {
  for (const auto& [fade, number] : fades_) {
    if (frame.rmarker < fade.from || frame.rmarker >= fade.until) continue;
    if (fade.hits && !fade.hits(frame, from, to)) continue;
    const KeyedRandom draw = random_.of(kFade, number, from, to, frame.number);
    if (draw.uniform() >= fade.probability) continue;
    const Loss loss = fade.silent ? Loss::kUnheard : kind_of_loss(draw.of(kLossKind).uniform());
    if (reception.loss == Loss::kNone || loss < reception.loss) reception.loss = loss;
  }
}

}  // namespace groma::sim
