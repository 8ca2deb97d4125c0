// A radio that no one sells, to show what the seam (firmware/core/radio/radio.hpp) leaves to a radio: a tick
// of 1/(64 x 38.4 MHz) = 407 ps, a counter of 32 bits that wraps each 1.75 s, air times of its own, no
// carrier offset and no first path's power. OtherChip is the hardware, on an air without loss, OtherRadio its
// driver.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "firmware/core/radio/radio.hpp"

namespace groma::testing {

inline constexpr std::int64_t kOtherTick = 26;  // network ticks in one of its own

// A preamble symbol of 1.3 us and a data bit of 160 ns. The radio transmits at each of its ticks, which are
// no multiple of a power of two, so it rounds by itself and reports what was requested.
constexpr radio::Phy other_phy_of(radio::Preamble preamble) noexcept {
  const int symbols = preamble == radio::Preamble::k64 ? 64 : preamble == radio::Preamble::k128 ? 128 : 256;
  return {preamble,
          {.synchronization = (symbols + 16) * ranging::Ticks(83'070),
           .header = ranging::Ticks(1'600'000),
           .data_bit = ranging::Ticks(10'224),
           .receiver_start = ranging::Ticks::from_us(25),
           .transmit_grid = ranging::Ticks(1)}};
}

// Times on the air are in network ticks of a perfect clock.
class OtherChip {
 public:
  struct Air {
    double now = 0.0;
    std::vector<OtherChip*> chips;
  };
  struct Settings {
    double x_m = 0.0;
    double offset_ppm = 0.0;
    std::uint64_t first_count = 0;  // of the counter, at time 0
  };
  static constexpr double kNever = std::numeric_limits<double>::infinity();
  static constexpr std::int64_t kAntennaDelay = 15'611;  // of each direction, in network ticks

  OtherChip(Air& air, const Settings& settings) : air_(air), settings_(settings) {
    air.chips.push_back(this);
  }
  OtherChip(const OtherChip&) = delete;
  OtherChip& operator=(const OtherChip&) = delete;

  // ---- registers -----------------------------------------------------------------------------------------
  void use(const radio::Phy& phy) noexcept { phy_ = phy; }
  [[nodiscard]] std::uint32_t counter() const noexcept { return count_at(air_.now); }
  // Its RMARKER passes the transmitter when the counter reads `at`. False: too late.
  [[nodiscard]] bool transmit(std::uint32_t at, std::span<const std::uint8_t> frame) noexcept {
    rmarker_ = time_of(at) + static_cast<double>(kAntennaDelay);
    start_ = rmarker_ - ticks(phy_.before_rmarker());
    if (start_ < air_.now) return false;
    ++transmissions;
    state_ = State::kTransmitting;
    begun_ = false;
    timestamp_ = at;
    bytes_.assign(frame.begin(), frame.end());
    return true;
  }
  // Durations in its ticks. False: too late.
  [[nodiscard]] bool receive(std::uint32_t from, std::uint32_t frame_timeout,
                             std::optional<std::uint32_t> preamble_timeout) noexcept {
    start_ = time_of(from);
    if (start_ < air_.now - kOtherTick) return false;
    start_ = std::max(start_, air_.now);
    ++receptions;
    state_ = State::kListening;
    end_ = start_ + static_cast<double>(std::int64_t{frame_timeout} * kOtherTick);
    preamble_end_ =
        preamble_timeout ? start_ + static_cast<double>(std::int64_t{*preamble_timeout} * kOtherTick) : end_;
    source_ = nullptr;
    return true;
  }
  void off() noexcept {
    loaded = false;
    state_ = State::kIdle;
    result_ = radio::EventKind::kNone;
  }
  // The interrupt line is high while there is a result.
  [[nodiscard]] bool interrupt() const noexcept { return result_ != radio::EventKind::kNone; }
  [[nodiscard]] radio::EventKind take_result() noexcept {
    return std::exchange(result_, radio::EventKind::kNone);
  }
  [[nodiscard]] std::uint32_t timestamp() const noexcept { return timestamp_; }
  [[nodiscard]] std::span<const std::uint8_t> bytes() const noexcept { return bytes_; }

  // ---- time ----------------------------------------------------------------------------------------------
  [[nodiscard]] double next_event() const noexcept {
    if (state_ == State::kTransmitting) return begun_ ? end_of_frame() : start_;
    if (state_ == State::kListening && source_ == nullptr) return std::min(preamble_end_, end_);
    return kNever;
  }
  // Call when the air's time is that of the next event.
  void advance() noexcept {
    if (state_ == State::kListening) return end(radio::EventKind::kFrameTimeout);
    if (!std::exchange(begun_, true)) {
      for (OtherChip* chip : air_.chips) chip->detect(*this);
      return;
    }
    end(radio::EventKind::kTransmitted);
    for (OtherChip* chip : air_.chips) chip->hear(*this);
  }

  std::size_t transmissions = 0;
  std::size_t receptions = 0;
  bool absent = false;
  bool loaded = false;  // its driver has a frame to be launched

 private:
  enum class State : std::uint8_t { kIdle, kTransmitting, kListening };
  static constexpr double kSlop = 1e-3;  // for an instant that is a whole tick

  static double ticks(ranging::Ticks t) noexcept { return static_cast<double>(t.count()); }
  [[nodiscard]] double rate() const noexcept { return (1.0 + settings_.offset_ppm * 1e-6) / kOtherTick; }
  [[nodiscard]] std::uint32_t count_at(double time) const noexcept {
    return static_cast<std::uint32_t>(settings_.first_count +
                                      static_cast<std::uint64_t>(std::floor(time * rate() + kSlop)));
  }
  // The instant nearest to now.
  [[nodiscard]] double time_of(std::uint32_t count) const noexcept {
    const double whole = std::floor(air_.now * rate() + kSlop);
    return (whole + static_cast<std::int32_t>(count - count_at(air_.now))) / rate();
  }
  [[nodiscard]] double end_of_frame() const noexcept {
    return rmarker_ + ticks(phy_.after_rmarker(bytes_.size() + radio::kFrameCheckBytes));
  }
  void detect(OtherChip& sender) noexcept {
    const bool hunts = state_ == State::kListening && source_ == nullptr && &sender != this &&
                       start_ + ticks(phy_.receiver_start()) <= air_.now && air_.now <= preamble_end_;
    if (hunts) source_ = &sender;
  }
  void hear(const OtherChip& sender) noexcept {
    if (state_ != State::kListening || source_ != &sender) return;
    constexpr double kTicksPerMetre = static_cast<double>(ranging::Ticks::kPerSecond) / 299'792'458.0;
    const double flight = std::abs(sender.settings_.x_m - settings_.x_m) * kTicksPerMetre;
    timestamp_ = count_at(sender.rmarker_ + flight + static_cast<double>(kAntennaDelay));
    bytes_ = sender.bytes_;
    end(radio::EventKind::kReceived);
  }
  void end(radio::EventKind result) noexcept {
    state_ = State::kIdle;
    result_ = result;
  }

  Air& air_;
  Settings settings_;
  radio::Phy phy_ = other_phy_of(radio::Preamble::k128);
  State state_ = State::kIdle;
  double start_ = 0.0;  // of the preamble, or of the listening
  double rmarker_ = 0.0;
  double end_ = 0.0;
  double preamble_end_ = 0.0;
  bool begun_ = false;
  const OtherChip* source_ = nullptr;  // of the frame being received
  radio::EventKind result_ = radio::EventKind::kNone;
  std::uint32_t timestamp_ = 0;
  std::vector<std::uint8_t> bytes_;
};

class OtherRadio {
 public:
  enum class BringUp : std::uint8_t { kOk, kNoChip };
  static constexpr std::uint32_t kSampling_us = 1;

  explicit OtherRadio(OtherChip& chip) noexcept : chip_(chip) {}

  template <class Reset, class Delay>
  BringUp bring_up(const radio::Settings& settings, Reset&& reset, Delay&&) noexcept {
    reset();
    if (chip_.absent) return BringUp::kNoChip;
    phy_ = other_phy_of(settings.preamble);
    chip_.use(phy_);
    stop();
    latest_ = chip_.counter();
    return BringUp::kOk;
  }
  template <class Delay>
  bool restart(Delay&&) noexcept {
    stop();
    return !chip_.absent;
  }
  void stop() noexcept {
    chip_.off();
    idle_ = true;
  }
  [[nodiscard]] bool woken() const noexcept { return false; }
  [[nodiscard]] const char* warning() const noexcept { return ""; }
  [[nodiscard]] std::uint32_t pll_flags() const noexcept { return 0; }
  [[nodiscard]] const radio::Phy& phy() const noexcept { return phy_; }
  [[nodiscard]] ranging::Ticks transmit_antenna_delay() const noexcept {
    return ranging::Ticks(OtherChip::kAntennaDelay);
  }

  ranging::DeviceTime now() noexcept { return time_of(extend(chip_.counter())); }
  void expect_length(std::size_t) noexcept {}

  template <class Complete>
  radio::Start load(ranging::DeviceTime timestamp, std::span<const std::uint8_t> frame,
                    Complete&& complete) noexcept {
    if (!idle_ || chip_.loaded) return radio::Start::kNotIdle;
    complete();
    frame_.assign(frame.begin(), frame.end());
    requested_ = timestamp;
    chip_.loaded = true;
    return radio::Start::kStarted;
  }
  radio::Start launch() noexcept {
    if (!std::exchange(chip_.loaded, false)) return radio::Start::kNotIdle;
    if (!chip_.transmit(count_of(requested_ - transmit_antenna_delay()), frame_)) return late();
    idle_ = false;
    return radio::Start::kStarted;
  }
  radio::Start receive_at(ranging::DeviceTime from, ranging::Ticks frame_timeout,
                          std::optional<ranging::Ticks> preamble_timeout) noexcept {
    return receive(count_of(from), frame_timeout, preamble_timeout);
  }
  radio::Start receive_now(ranging::Ticks frame_timeout,
                           std::optional<ranging::Ticks> preamble_timeout) noexcept {
    return receive(chip_.counter(), frame_timeout, preamble_timeout);
  }

  radio::Event poll_event() noexcept {
    const radio::EventKind kind = chip_.take_result();
    if (kind == radio::EventKind::kNone) return {};
    idle_ = true;
    if (kind == radio::EventKind::kReceived) timestamp_ = extend(chip_.timestamp());
    return {.kind = kind, .timestamp = requested_, .timestamp_valid = true};
  }
  template <class OnBytes>
  void read_frame(radio::Event& event, OnBytes&& on_bytes) noexcept {
    frame_.assign(chip_.bytes().begin(), chip_.bytes().end());
    event.frame = frame_;
    // The frame came half a tick after the counter's last step, on average.
    event.timestamp = time_of(timestamp_) + ranging::Ticks(kOtherTick / 2 - OtherChip::kAntennaDelay);
    constexpr float kReceivePower = 1e4F;  // -81.74 dBm
    if (on_bytes(event.frame)) event.quality = {.receive_power = kReceivePower};
  }
  void start_sampling() noexcept {}
  std::optional<radio::Ambient> finish_sampling() noexcept { return std::nullopt; }

 private:
  // Extends the counter over its wraps: readings are up to 0.44 s old and up to 1.3 s apart.
  std::uint64_t extend(std::uint32_t count) noexcept {
    constexpr std::uint32_t kOld = std::uint32_t{1} << 30;
    const std::uint32_t ahead = count - static_cast<std::uint32_t>(latest_) + kOld;
    const std::uint64_t result = latest_ + ahead - kOld;
    latest_ = std::max(latest_, result);
    return result;
  }
  static ranging::DeviceTime time_of(std::uint64_t count) noexcept {
    return ranging::DeviceTime(count * static_cast<std::uint64_t>(kOtherTick));
  }
  // The tick nearest to `t`.
  [[nodiscard]] std::uint32_t count_of(ranging::DeviceTime t) const noexcept {
    const std::int64_t ahead = (t - time_of(latest_)).count();
    const std::int64_t rounding = ahead < 0 ? -kOtherTick / 2 : kOtherTick / 2;
    return static_cast<std::uint32_t>(latest_ + static_cast<std::uint64_t>((ahead + rounding) / kOtherTick));
  }
  static std::uint32_t rounded_up(ranging::Ticks t) noexcept {
    return static_cast<std::uint32_t>((t.count() + kOtherTick - 1) / kOtherTick);
  }
  radio::Start receive(std::uint32_t from, ranging::Ticks frame_timeout,
                       std::optional<ranging::Ticks> preamble_timeout) noexcept {
    if (!idle_) return radio::Start::kNotIdle;
    std::optional<std::uint32_t> preamble;
    if (preamble_timeout) preamble = rounded_up(*preamble_timeout);
    if (!chip_.receive(from, rounded_up(frame_timeout), preamble)) return late();
    idle_ = false;
    return radio::Start::kStarted;
  }
  radio::Start late() noexcept {
    chip_.off();
    return radio::Start::kLate;
  }

  OtherChip& chip_;
  radio::Phy phy_ = other_phy_of(radio::Preamble::k128);
  bool idle_ = true;
  std::uint64_t latest_ = 0;     // reading of the counter, extended
  std::uint64_t timestamp_ = 0;  // of the frame received
  ranging::DeviceTime requested_;
  std::vector<std::uint8_t> frame_;
};

[[nodiscard]] constexpr const char* describe(OtherRadio::BringUp result) noexcept {
  return result == OtherRadio::BringUp::kOk ? "" : "no other chip answers";
}

static_assert(radio::Radio<OtherRadio>);

}  // namespace groma::testing
