// The receiver of the chip: from a frame's preamble to the registers that describe its reception.
#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "firmware/sim/dw1000_chip.hpp"

namespace groma::sim {

namespace {

constexpr std::uint64_t kTimestampMask = (std::uint64_t{1} << 40) - 1;
constexpr std::uint64_t kWaitTimeout = 1U << 28;
constexpr std::uint64_t kLderune = 1U << 17;
// The longest time of flight (30 km): no frame arrives later than this after its last symbol was sent.
constexpr SimTime kMaxFlight = 100 * kUnitsPerMicrosecond;

// User manual 4.7: power = 10 log10(sum 2^k / N^2) - A at PRF 64 MHz.
constexpr double kPowerConstant_db = 121.74;
// RXPACC also counts symbols of the SFD while it is not saturated: 5 with the 8-symbol SFD (table 18).
constexpr std::int64_t kSfdAccumulation = 5;
constexpr double kCarIntPpm = -5.7312e-4;  // ppm per unit of DRX_CAR_INT on channel 5 at 6.8 Mbit/s
constexpr std::int64_t kTrackingInterval = 0x01FC0000;  // RX_TTCKI at PRF 64 MHz
constexpr double kNoisePower_dbm = -120.0;              // reported in STD_NOISE

std::uint64_t to_register(double value, std::uint64_t largest) {
  if (!(value > 0.0)) return 0;
  return static_cast<std::uint64_t>(std::min(std::round(value), static_cast<double>(largest)));
}

void put(std::span<std::uint8_t> bytes, std::size_t at, std::size_t count, std::uint64_t value) {
  for (std::size_t i = 0; i < count; ++i) bytes[at + i] = static_cast<std::uint8_t>(value >> (8 * i));
}

}  // namespace

// ---- from the medium ------------------------------------------------------------------------------

void Dw1000Chip::incoming(std::shared_ptr<const AirFrame> frame) {
  if (!powered_ || asleep_) return;
  const SimTime latest_on = spec_.quirks.receiver_start_up ? frame->rmarker : frame->preamble_start;
  if (frame->preamble_start < now_ && last_on_at_ <= latest_on && frame->preamble_start < last_off_at_)
    ++late_announcements_;
  const auto before = [](const Arrival& a, const Arrival& b) {
    return a.frame->preamble_start != b.frame->preamble_start
               ? a.frame->preamble_start < b.frame->preamble_start
               : a.frame->source < b.frame->source;
  };
  Arrival arrival;
  arrival.frame = std::move(frame);
  const auto at = std::upper_bound(arrivals_.begin(), arrivals_.end(), arrival, before);
  arrivals_.insert(at, std::move(arrival));
  update_next_event();
}

void Dw1000Chip::withdraw(const AirFrame& frame) {
  std::erase_if(arrivals_, [&](const Arrival& arrival) { return arrival.frame.get() == &frame; });
  if (current_.frame.get() == &frame) {
    current_ = {};
    if (listening()) receiver_ = Receiver::kHunting;
  }
  update_next_event();
}

// ---- receiver states ------------------------------------------------------------------------------

SimTime Dw1000Chip::next_receiver_event() const noexcept {
  const SimTime rmarker = current_.frame ? current_.frame->rmarker + current_.reception.delay : kNever;
  switch (receiver_) {
    case Receiver::kOff:
      return kNever;
    case Receiver::kDelayed:
      return receiver_on_at_;
    case Receiver::kHunting:
      return std::min({frame_timeout_at_, preamble_timeout_at_, detected_at_});
    case Receiver::kPreamble:
      return std::min({frame_timeout_at_, sfd_timeout_at_, damage_ == Loss::kSfd ? kNever : rmarker});
    case Receiver::kFrame: {
      const SimTime part_ends = header_done_ ? current_.frame->end : current_.frame->data_start;
      return std::min(frame_timeout_at_, part_ends + current_.reception.delay);
    }
  }
  return kNever;
}

void Dw1000Chip::receiver_step(SimTime at) {
  if (next_receiver_event() > at) {
    const auto first = std::find_if(arrivals_.begin(), arrivals_.end(),
                                    [](const Arrival& arrival) { return !arrival.started; });
    first->started = true;
    preamble_begins(*first);
    drop_past_frames();
    return;
  }
  const SimTime cut_at = current_.frame && current_.frame->cut_at != kNever ? current_.frame->cut_at : kNever;
  if (cut_at < at) damage_from(cut_at);
  switch (receiver_) {
    case Receiver::kOff:
      break;
    case Receiver::kDelayed:
      receiver_on(at);
      break;
    case Receiver::kHunting:
      if (detected_at_ <= at) {
        status_ |= status::kRxprd;
        receiver_ = Receiver::kPreamble;
        preamble_timeout_at_ = kNever;
        const auto symbols = static_cast<std::int64_t>(registers_.get(Reg::kDrxSfdtoc));
        sfd_timeout_at_ =
            symbols == 0 ? kNever : time_of(ticks(detected_at_) + symbols * kPreambleSymbolTicks);
      } else if (preamble_timeout_at_ <= at) {
        receiver_ends(status::kRxpto, Reg::kEvcPto, true);
      } else {
        receiver_ends(status::kRxrfto, Reg::kEvcFwto, true);
      }
      break;
    case Receiver::kPreamble:
      if (damage_ != Loss::kSfd && current_.frame->rmarker + current_.reception.delay <= at) {
        status_ |= status::kRxsfdd;
        receiver_ = Receiver::kFrame;
        invalidate_last_frame();
        header_done_ = false;
      } else if (sfd_timeout_at_ <= at) {
        receiver_ends(status::kRxsfdto, Reg::kEvcSto, true);
      } else {
        receiver_ends(status::kRxrfto, Reg::kEvcFwto, true);
      }
      break;
    case Receiver::kFrame:
      if (frame_timeout_at_ <= at) {
        receiver_ends(status::kRxrfto, Reg::kEvcFwto, true);
      } else if (!header_done_) {
        header_ends();
      } else {
        frame_ends();
      }
      break;
  }
}

void Dw1000Chip::receiver_on(SimTime at) {
  status_ &= ~status::kAllRx;
  turned_off_ = false;
  receiver_ = Receiver::kHunting;
  receiver_on_at_ = at;
  current_ = {};
  detected_at_ = kNever;
  sfd_timeout_at_ = kNever;
  // From here on the demodulator's registers belong to the next frame.
  registers_.set(Reg::kDrxCarInt, 0);
  registers_.set(Reg::kRxpaccNosat, 0);
  const std::int64_t on = ticks(at);
  hunts_from_ = spec_.quirks.receiver_start_up ? time_of(on + kReceiverStartTicks) : at;
  const auto chunks = static_cast<std::int64_t>(registers_.get(Reg::kDrxPretoc));
  // The chip adds one to the counter (user manual 7.2.40.9).
  preamble_timeout_at_ =
      chunks == 0 ? kNever : time_of(on + (chunks + 1) * tuning().pac_symbols * kPreambleSymbolTicks);
  const bool limited = (registers_.get(Reg::kSysCfg) & kWaitTimeout) != 0;
  frame_timeout_at_ =
      limited ? time_of(on + static_cast<std::int64_t>(registers_.get(Reg::kRxFwto)) * kTicksPerUus) : kNever;
  if (!spec_.quirks.receiver_start_up) return;
  for (Arrival& arrival : arrivals_)
    if (arrival.started && arrival.frame->rmarker > at) preamble_begins(arrival);
}

void Dw1000Chip::receiver_ends(std::uint64_t event, Reg counter, bool needs_reset) {
  if (!std::exchange(loses_event_, false)) status_ |= event;
  count_event(counter);
  if (Witness* const witness = medium_.witness(); witness != nullptr)
    witness->reception_ended(spec_.id, event);
  receiver_off();
  receiver_needs_reset_ = receiver_needs_reset_ || needs_reset;
}

void Dw1000Chip::receiver_off() {
  if (listening()) {
    last_on_at_ = receiver_on_at_;
    last_off_at_ = now_;
  }
  receiver_ = Receiver::kOff;
  current_ = {};
}

void Dw1000Chip::resolve(Arrival& arrival) {
  if (arrival.resolved) return;
  arrival.resolved = true;
  arrival.reception = medium_.reception(*arrival.frame, station_);
}

// Or the receiver is switched on during it.
void Dw1000Chip::preamble_begins(Arrival& arrival) {
  if (!listening() || !tuning().can_receive(arrival.frame->format)) return;
  if (!spec_.quirks.receiver_start_up && receiver_on_at_ > arrival.frame->preamble_start) return;
  resolve(arrival);
  if (!arrival.reception.audible || arrival.reception.loss == Loss::kUnheard) return;
  if (current_.frame) {
    overlap(arrival);
    return;
  }
  if (!detectable(arrival)) return;
  const SimTime from = std::max(arrival.frame->preamble_start + arrival.reception.delay, hunts_from_);
  for (Arrival& other : arrivals_) {
    if (&other == &arrival || !other.started || !tuning().can_receive(other.frame->format)) continue;
    resolve(other);
    const bool over = std::min(other.frame->end, other.frame->cut_at) + other.reception.delay <= from;
    if (!over && other.reception.audible && other.reception.loss != Loss::kUnheard &&
        arrival.reception.receive_power_dbm <
            other.reception.receive_power_dbm + medium_.settings().capture_db) {
      report_overlap(*arrival.frame, *other.frame);
      return;
    }
  }
  lock(arrival);
}

// The preamble is detected at the end of the first chunk of PAC symbols that lies wholly within it. Chunks
// are counted from the start of the hunt.
std::int64_t Dw1000Chip::detection_of(const Arrival& arrival) {
  const std::int64_t chunk = tuning().pac_symbols * kPreambleSymbolTicks;
  const std::int64_t hunt = ticks(hunts_from_);
  const std::int64_t begin = ticks(arrival.frame->preamble_start + arrival.reception.delay);
  return hunt + ((std::max(begin - hunt, std::int64_t{0}) + chunk - 1) / chunk + 1) * chunk;
}

bool Dw1000Chip::detectable(const Arrival& arrival) {
  const std::int64_t chunk = tuning().pac_symbols * kPreambleSymbolTicks;
  const SimTime sfd = arrival.frame->rmarker - kSfdSymbols * kPreambleSymbolTicks * kUnitsPerTick;
  const SimTime end = std::min(sfd, arrival.frame->cut_at) + arrival.reception.delay;
  return detection_of(arrival) + (kLeastChunks - 1) * chunk <= ticks(end);
}

void Dw1000Chip::lock(const Arrival& arrival) {
  current_ = arrival;
  damage_ = arrival.reception.loss;
  receiver_ = Receiver::kHunting;
  const std::int64_t begin = ticks(arrival.frame->preamble_start + arrival.reception.delay);
  const std::int64_t detected = detection_of(arrival);
  detected_at_ = time_of(detected);
  accumulated_symbols_ = std::max<std::int64_t>(
      arrival.frame->format.preamble_symbols - (detected - begin) / kPreambleSymbolTicks, 1);
}

void Dw1000Chip::overlap(const Arrival& later) {
  const double stronger_db = later.reception.receive_power_dbm - current_.reception.receive_power_dbm;
  const double capture_db = medium_.settings().capture_db;
  const SimTime begins = later.frame->preamble_start + later.reception.delay;
  if (stronger_db >= capture_db && begins < current_.frame->rmarker + current_.reception.delay) {
    report_overlap(*current_.frame, *later.frame);
    lock(later);
    return;
  }
  report_overlap(*later.frame, *current_.frame);
  if (stronger_db <= -capture_db || begins >= current_.frame->end + current_.reception.delay) return;
  report_overlap(*current_.frame, *later.frame);
  damage_from(begins - current_.reception.delay);
}

void Dw1000Chip::report_overlap(const AirFrame& lost, const AirFrame& by) const {
  if (Witness* const witness = medium_.witness(); witness != nullptr) witness->overlapped(lost, by, spec_.id);
}

// `at`: in the time at the transmitter's antenna.
void Dw1000Chip::damage_from(SimTime at) {
  const Loss damage = at < current_.frame->rmarker      ? Loss::kSfd
                      : at < current_.frame->data_start ? Loss::kHeader
                      : at < current_.frame->end        ? Loss::kData
                                                        : Loss::kNone;
  if (damage == Loss::kNone) return;
  // Of two damages the one to the earlier part of the frame counts.
  if (damage_ == Loss::kNone || damage < damage_) damage_ = damage;
}

void Dw1000Chip::header_ends() {
  if (damage_ == Loss::kHeader) {
    receiver_ends(status::kRxphe, Reg::kEvcPhe, true);
    return;
  }
  status_ |= status::kRxphd;
  header_done_ = true;
}

void Dw1000Chip::frame_ends() {
  const bool damaged = damage_ == Loss::kData;
  if (damaged && current_.reception.junk % 4 == 0) {
    receiver_ends(status::kRxrfsl, Reg::kEvcRse, true);
    return;
  }
  write_reception(damaged);
  write_measurements();
  if (lde_loaded_ && (registers_.get(Reg::kPmscCtrl1) & kLderune) != 0) status_ |= status::kLdedone;
  status_ |= status::kRxdfr;
  receiver_ends(damaged ? status::kRxfce : status::kRxfcg, damaged ? Reg::kEvcFce : Reg::kEvcFcg, false);
}

// Drops frames that can no longer be received or disturb others.
void Dw1000Chip::drop_past_frames() {
  std::erase_if(arrivals_, [&](const Arrival& arrival) {
    if (!arrival.started) return false;
    if (arrival.resolved && (!arrival.reception.audible || arrival.reception.loss == Loss::kUnheard))
      return true;
    return arrival.frame->end + kMaxFlight < now_;
  });
}

// A receive timestamp that is late by b at each end lengthens a range by c b.
double Dw1000Chip::timestamp_bias_ticks(double receive_power_dbm) const noexcept {
  constexpr double kTicksPerMetre = 63.8976e9 / 299'792'458.0;
  double bias_m = 0.0;
  if (spec_.bias.drift) {
    // The bias is per end, and an end's receive timestamps enter the range by half: hence the factor 2.
    bias_m +=
        2.0 * (0.00215 * (spec_.ambient.temperature_c - 23.0) + 0.0535 * (spec_.ambient.supply_v - 3.3));
  }
  if (spec_.bias.power) {
    constexpr std::array<double, 17> kBias_m = {0.081,  0.076,  0.071,  0.062,  0.049,  0.042,
                                                0.035,  0.021,  0.0,    -0.027, -0.051, -0.069,
                                                -0.082, -0.093, -0.100, -0.105, -0.110};
    const double at = std::clamp((receive_power_dbm + 93.0) / 2.0, 0.0, 16.0);
    const auto below = static_cast<std::size_t>(std::min(std::floor(at), 15.0));
    const double rest = at - static_cast<double>(below);
    bias_m += (1.0 - rest) * kBias_m[below] + rest * kBias_m[below + 1];
  }
  return bias_m * kTicksPerMetre;
}

// ---- registers that describe a received frame -----------------------------------------------------

// With a single buffer the next frame overwrites the last one. The chip does so gradually; the model spoils
// the registers as soon as the new frame has begun, so that a test finds a driver that reads too late.
void Dw1000Chip::invalidate_last_frame() {
  for (const Reg reg : {Reg::kRxFinfo, Reg::kRxBuffer, Reg::kRxFqual, Reg::kRxTime, Reg::kLdePpIndx}) {
    const std::span<std::uint8_t> bytes = registers_.bytes(reg);
    std::fill(bytes.begin(),
              bytes.begin() + static_cast<std::ptrdiff_t>(std::min<std::size_t>(bytes.size(), 16)),
              std::uint8_t{0xA5});
  }
}

void Dw1000Chip::write_reception(bool damaged) {
  const AirFrame& frame = *current_.frame;
  const std::span<std::uint8_t> buffer = registers_.bytes(Reg::kRxBuffer);
  std::copy_n(frame.data.begin(), frame.length, buffer.begin());
  if (damaged) {
    const std::size_t at = (current_.reception.junk >> 8) % frame.length;
    buffer[at] = static_cast<std::uint8_t>(buffer[at] ^ ((current_.reception.junk >> 24) & 0xFF) ^ 0x10);
  }

  const std::int64_t symbols = frame.format.preamble_symbols;
  const std::uint64_t rxpsr = symbols >= 4096 ? 3 : symbols >= 1024 ? 2 : 1;
  const auto accumulated = static_cast<std::uint64_t>(accumulated_symbols_ + kSfdAccumulation);
  registers_.set(Reg::kRxFinfo, static_cast<std::uint64_t>(frame.length) | 2ULL << 13 |
                                    (frame.ranging ? 1ULL << 15 : 0ULL) | 2ULL << 16 | rxpsr << 18 |
                                    accumulated << 20);
  registers_.set(Reg::kRxpaccNosat, accumulated);

  // When the RMARKER reached the antenna, in the chip's ticks.
  const Reception& reception = current_.reception;
  const std::int64_t rmarker =
      clock_.nearest_tick(frame.rmarker + reception.delay,
                          static_cast<double>(spec_.receive_antenna_delay_ticks) +
                              reception.delay_residue_ticks + reception.timestamp_noise_ticks +
                              timestamp_bias_ticks(reception.receive_power_dbm)) -
      counter_base_;
  std::uint64_t timestamp = static_cast<std::uint64_t>(rmarker) - registers_.get(Reg::kLdeRxAntd);
  const bool lde_runs = lde_loaded_ && (registers_.get(Reg::kPmscCtrl1) & kLderune) != 0;
  if (!lde_runs) {
    timestamp = reception.junk;
  } else if (receiver_needs_reset_ || !tuning().timestamps_valid) {
    // An error of 1 to 16 ns of either sign.
    const std::uint64_t error = 64 + ((reception.junk >> 16) & 0x3BF);
    timestamp = (reception.junk & 1) != 0 ? timestamp + error : timestamp - error;
  }
  const std::span<std::uint8_t> time = registers_.bytes(Reg::kRxTime);
  put(time, 0, 5, timestamp & kTimestampMask);
  put(time, 9, 5, static_cast<std::uint64_t>(rmarker) & kTimestampMask & ~std::uint64_t{0x1FF});
}

void Dw1000Chip::write_measurements() {
  const AirFrame& frame = *current_.frame;
  const Reception& reception = current_.reception;

  const auto n = static_cast<double>(accumulated_symbols_);
  const auto amplitude_squared = [&](double power_dbm) {
    return std::pow(10.0, (power_dbm + kPowerConstant_db) / 10.0) * n * n;
  };
  const double first_path = amplitude_squared(reception.first_path_power_dbm);
  const double received = amplitude_squared(reception.receive_power_dbm);
  const std::span<std::uint8_t> quality = registers_.bytes(Reg::kRxFqual);
  put(quality, 0, 2, to_register(std::sqrt(amplitude_squared(kNoisePower_dbm)), 0xFFFF));
  // The three first-path amplitudes get unequal shares of the power, so that a test notices a mix-up.
  put(quality, 2, 2, to_register(std::sqrt(0.45 * first_path), 0xFFFF));
  put(quality, 4, 2, to_register(std::sqrt(0.30 * first_path), 0xFFFF));
  put(quality, 6, 2, to_register(received / 131072.0, 0xFFFF));
  const std::span<std::uint8_t> time = registers_.bytes(Reg::kRxTime);
  put(time, 7, 2, to_register(std::sqrt(0.25 * first_path), 0xFFFF));

  // The first path is near sample 746. The more power arrives after it, the later is the peak.
  const double hidden_db = std::max(reception.receive_power_dbm - reception.first_path_power_dbm, 0.0);
  const double first_index = 746.0 + static_cast<double>(reception.junk >> 56) / 64.0;
  put(time, 5, 2, to_register(first_index * 64.0, 0xFFFF));
  registers_.set(Reg::kLdePpIndx, to_register(first_index + 0.9 + 0.4 * hidden_db, 0xFFFF));
  registers_.set(Reg::kLdePpAmpl, to_register(std::sqrt(0.5 * received), 0xFFFF));
  registers_.set(Reg::kLdeThresh, to_register(13.0 * std::sqrt(amplitude_squared(kNoisePower_dbm)), 0xFFFF));

  // Both registers report the transmitter's frequency relative to the receiver's.
  const double ratio = (1.0 + frame.clock_offset) / (1.0 + clock_.offset(frame.rmarker)) - 1.0;
  const double ppm = ratio * 1e6 + reception.carrier_noise_ppm;
  registers_.set(Reg::kDrxCarInt, static_cast<std::uint64_t>(std::llround(ppm / kCarIntPpm)) & 0x1FFFFF);
  registers_.set(Reg::kRxTtcki, static_cast<std::uint64_t>(kTrackingInterval));
  registers_.set(Reg::kRxTtcko, static_cast<std::uint64_t>(
                                    std::llround(ppm * 1e-6 * static_cast<double>(kTrackingInterval))) &
                                    0x7FFFF);
}

}  // namespace groma::sim
