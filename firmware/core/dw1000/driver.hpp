// Driver of the DW1000 on its SPI bus: implements radio::Radio.
//
//        bring_up()         load() and launch(); receive_at(); receive_now()
//   kDown --------> kIdle ---------------- [kLoaded] -----------------> kTransmitting / kReceiving
//                     ^                                                        |
//                     +------------ poll_event() reports the end, or stop() ---+
//
// An operation requested in any state other than kIdle is refused (Start::kNotIdle) without access to the
// chip, so it cannot disturb a frame in progress. The receiver does not re-enable itself: one buffer, one
// frame. If time is short, receive_at() may arm the next listening between poll_event() and read_frame(): the
// chip is idle until that listening begins (user manual 4.2), and until then keeps the data of the last
// frame.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/dw1000/bus.hpp"
#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/dw1000/receive_quality.hpp"
#include "firmware/core/dw1000/registers.hpp"
#include "firmware/core/dw1000/spi.hpp"
#include "firmware/core/dw1000/start_up.hpp"
#include "firmware/core/radio/radio.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::dw1000 {

using radio::Ambient;
using radio::Event;
using radio::EventKind;
using radio::Start;

enum class State : std::uint8_t { kDown, kIdle, kLoaded, kTransmitting, kReceiving };

// The least time from the end of a frame of `heard` bytes to the preamble of an answer of `sent` bytes,
// without frame checks, and from the end of a frame to the preamble of the next one to be heard: if the
// processor needs none at all and SPI runs at 8 MHz, 1 us a byte, each transfer with its header. SYS_STATUS
// read and cleared 10, RX_FINFO 5, RX_BUFFER 1 and the frame, RX_TIME 10, DX_TIME 6, TX_BUFFER 1 and the
// answer, PMSC 2, SYS_CTRL 3, the transmitter's power-up 6, the receiver's start-up 16. The frame of a gap is
// read after that.
[[nodiscard]] constexpr std::uint32_t least_turnaround_us(std::size_t heard, std::size_t sent) noexcept {
  return 10 + 5 + 1 + static_cast<std::uint32_t>(heard) + 10 + 6 + 1 + static_cast<std::uint32_t>(sent) + 2 +
         3 + 6;
}
inline constexpr std::uint32_t kLeastGap_us = 10 + 6 + 3 + 16;

template <Spi S>
class Dw1000 {
 public:
  using BringUp = dw1000::BringUp;

  explicit Dw1000(S& spi) noexcept : spi_(spi), start_up_(spi) {}

  // Afterwards the bus is fast and the driver is kIdle; if the result is not kOk, the driver is kDown.
  template <class Reset, class Delay>
  [[nodiscard]] BringUp bring_up(const Settings& settings, Reset&& reset, Delay&& delay_us) noexcept {
    state_ = State::kDown;
    const BringUp result = start_up_.run(settings, reset, delay_us);
    if (result != BringUp::kOk) return result;
    frame_format_ = start_up_.frame_format();
    forget_operations();
    state_ = State::kIdle;
    return BringUp::kOk;
  }

  // Checks that the chip answers, has kept its registers, and that its counter runs: the driver is then
  // kIdle, otherwise kDown.
  template <class Delay>
  [[nodiscard]] bool restart(Delay&& delay_us) noexcept {
    stop();
    forget_operations();
    write(spi_, Value<reg::DrxPretoc>());
    const bool works = state_ == State::kIdle && start_up_.works(delay_us);
    if (!works) state_ = State::kDown;
    return works;
  }

  [[nodiscard]] State state() const noexcept { return state_; }
  // The last bring-up found the chip asleep.
  [[nodiscard]] bool woken() const noexcept { return start_up_.woken(); }
  // Since the last bring-up.
  [[nodiscard]] const radio::Phy& phy() const noexcept { return start_up_.phy(); }
  [[nodiscard]] ranging::Ticks transmit_antenna_delay() const noexcept {
    return ranging::Ticks(start_up_.transmit_antenna_delay_dtu());
  }
  // What the host should know about a chip that came up; empty if nothing. At most 47 characters.
  [[nodiscard]] const char* warning() const noexcept {
    return start_up_.delay_replaced() ? "antenna delay not plausible, 16436 used" : "";
  }
  // Times that poll_event() found CLKPLL_LL or RFPLL_LL set.
  [[nodiscard]] std::uint32_t pll_flags() const noexcept { return pll_flags_; }

  [[nodiscard]] ranging::DeviceTime now() noexcept {
    return ranging::DeviceTime(read<reg::SysTime>(spi_).word());
  }

  void expect_length(std::size_t bytes) noexcept {
    if ((state_ == State::kIdle || state_ == State::kReceiving) &&
        bytes + kFrameCheckBytes <= kMaxFrameBytes) {
      set_length(bytes);
    }
  }

  template <class Complete>
  [[nodiscard]] Start load(ranging::DeviceTime timestamp, std::span<const std::uint8_t> frame,
                           Complete&& complete) noexcept {
    if (state_ != State::kIdle) return Start::kNotIdle;
    if (frame.size() + kFrameCheckBytes > kMaxFrameBytes) return Start::kTooLong;
    write(spi_, Value<reg::DxTime>((timestamp - transmit_antenna_delay()).count()));
    set_length(frame.size());
    complete();
    spi_.write(TransactionHeader(true, reg::TxBuffer::kId, reg::TxBuffer::kSub).bytes(), frame);
    state_ = State::kLoaded;
    return Start::kStarted;
  }
  // Starts the transmission of the loaded frame. The chip may shift its clock by a share of the time from
  // here to the RMARKER (docs/explanation/silicon.md), so call it at a fixed time before.
  [[nodiscard]] Start launch() noexcept {
    if (state_ != State::kLoaded) return Start::kNotIdle;
    // Erratum TX-1: without this clock the chip does not report the end of a delayed transmission.
    write(spi_, kTransmitClockForced);
    command(kTransmitDelayed);
    state_ = State::kTransmitting;
    // HPDWARN, and TXPUTE.
    const auto status = read_part<reg::SysStatus, 3, 2>(spi_);
    if (status.has(reg::sys_status::kHalfPeriod) || status.has(reg::sys_status::kPowerUpError)) {
      stop();
      return status.has(reg::sys_status::kHalfPeriod) ? Start::kLate : Start::kTooClose;
    }
    return Start::kStarted;
  }

  // `frame_timeout` is rounded up to 1.03 us, at most 67 ms, and `preamble_timeout` to a chunk of symbols.
  [[nodiscard]] Start receive_at(ranging::DeviceTime from, ranging::Ticks frame_timeout,
                                 std::optional<ranging::Ticks> preamble_timeout) noexcept {
    if (state_ != State::kIdle) return Start::kNotIdle;
    set_timeouts(frame_timeout, preamble_timeout);
    write(spi_, Value<reg::DxTime>(from.count()));
    command(kReceiveDelayed);
    if (read_part<reg::SysStatus, 3, 1>(spi_).has(reg::sys_status::kHalfPeriod)) {
      // The receiver was not on, so it needs no reset.
      command(kOff);
      write(spi_, kAllEvents);
      return Start::kLate;
    }
    state_ = State::kReceiving;
    return Start::kStarted;
  }

  [[nodiscard]] Start receive_now(ranging::Ticks frame_timeout,
                                  std::optional<ranging::Ticks> preamble_timeout) noexcept {
    if (state_ != State::kIdle) return Start::kNotIdle;
    set_timeouts(frame_timeout, preamble_timeout);
    command(kReceiveNow);
    state_ = State::kReceiving;
    return Start::kStarted;
  }

  [[nodiscard]] Event poll_event() noexcept {
    namespace st = reg::sys_status;
    if (state_ == State::kDown) return {};
    auto status = read_part<reg::SysStatus, 0, 4>(spi_);
    // Erratum SYSSTAT-1: these flags come without cause, too.
    if (status.has(st::kClockPllLosing) || status.has(st::kRfPllLosing)) {
      ++pll_flags_;
      write_part<reg::SysStatus, 3, 1>(spi_, kPllFlags);
    }
    if (state_ == State::kTransmitting && status.has(st::kTransmitted)) return take_transmitted();
    if (state_ == State::kReceiving) {
      if (status.has(st::kReceived)) {
        // The frame may be complete before its leading edge is found.
        for (int i = 0; i < kLdeTries && !status.has(st::kTimestamped) && !status.has(st::kTimestampError);
             ++i) {
          status = read_part<reg::SysStatus, 0, 4>(spi_);
        }
        clear_events();
        state_ = State::kIdle;
        return {.kind = EventKind::kReceived,
                .timestamp_valid = status.has(st::kTimestamped) && !status.has(st::kTimestampError)};
      }
      if (const EventKind failure = failure_of(status); failure != EventKind::kNone) {
        clear_events();
        command(kOff);
        reset_receiver();
        state_ = State::kIdle;
        return {.kind = failure};
      }
    }
    if (status.has(st::kInterrupt)) write(spi_, kAllEvents);
    return {};
  }

  // Must end before the next listening begins, which may be armed already.
  template <class OnBytes>
  void read_frame(Event& event, OnBytes&& on_bytes) noexcept {
    // If the next listening is armed, read first what the receiver overwrites first.
    Value<reg::DrxResults> results;
    const bool armed = state_ == State::kReceiving;
    if (armed) results = read<reg::DrxResults>(spi_);
    const auto info = read<reg::RxFinfo>(spi_);
    const auto length = static_cast<std::size_t>(info.get(reg::rx_finfo::kLength));
    const std::size_t size = length < kFrameCheckBytes ? 0 : length - kFrameCheckBytes;
    const std::span<std::uint8_t> frame =
        std::span(frame_).first(size < frame_.size() ? size : frame_.size());
    spi_.read(TransactionHeader(false, reg::RxBuffer::kId, reg::RxBuffer::kSub).bytes(), frame);
    const bool quality_wanted = on_bytes(std::span<const std::uint8_t>(frame));
    const auto time = read_part<reg::RxTime, 0, 9>(spi_);
    event.timestamp = ranging::DeviceTime(time.get(reg::rx_time::kTimestamp));
    event.frame = frame;
    if (!quality_wanted) return;
    if (!armed) results = read<reg::DrxResults>(spi_);
    const auto quality = read<reg::RxFqual>(spi_);
    const auto peak = read<reg::LdePpindx>(spi_);
    const auto count = info.get(reg::rx_finfo::kPreambleCount);
    const auto unsaturated_count = results.get(reg::drx_results::kUnsaturatedCount);
    event.quality = link_quality({
        .amplitude1 = static_cast<std::uint16_t>(time.get(reg::rx_time::kAmplitude1)),
        .amplitude2 = static_cast<std::uint16_t>(quality.get(reg::rx_fqual::kAmplitude2)),
        .amplitude3 = static_cast<std::uint16_t>(quality.get(reg::rx_fqual::kAmplitude3)),
        .channel_power = static_cast<std::uint16_t>(quality.get(reg::rx_fqual::kChannelPower)),
        .noise = static_cast<std::uint16_t>(quality.get(reg::rx_fqual::kNoise)),
        .first_path_index_64ths = static_cast<std::uint16_t>(time.get(reg::rx_time::kFirstPath)),
        .peak_index = static_cast<std::uint16_t>(peak.word()),
        .preamble_count = corrected_preamble_count(static_cast<std::uint16_t>(count),
                                                   static_cast<std::uint16_t>(unsaturated_count)),
        .carrier_integral = static_cast<std::int32_t>(results.get_signed(reg::drx_results::kIntegral)),
    });
  }

  // User manual 6.4; switches the sensors on step by step as the manufacturer's driver does. Temperature in
  // steps of 1.14 degrees, supply in steps of 6 mV.
  static constexpr std::uint32_t kSampling_us = 1'000;
  void start_sampling() noexcept {
    if (state_ == State::kDown) return;
    write(spi_, kSensorBias);
    write(spi_, kSensorAndConverterBias);
    write(spi_, kSensorOutputs);
    write(spi_, kConverterOff);
    write(spi_, kConverterOn);
  }
  [[nodiscard]] std::optional<Ambient> finish_sampling() noexcept {
    if (state_ == State::kDown) return std::nullopt;
    const auto supply = static_cast<std::int32_t>(read<reg::TcSarSupply>(spi_).word());
    const auto temperature = static_cast<std::int32_t>(read<reg::TcSarTemperature>(spi_).word());
    write(spi_, kConverterOff);
    // Temperature = (reading - reading at 23 degrees C) 1.14 + 23, supply = (reading - reading at 3.3 V) /
    // 173 + 3.3.
    return Ambient{
        .temperature_cdegc =
            static_cast<std::int16_t>((temperature - start_up_.temperature_at_reference()) * 114 + 2'300),
        .supply_mv =
            static_cast<std::uint16_t>((supply - start_up_.supply_at_reference()) * 1'000 / 173 + 3'300)};
  }

  // Ends the present operation; the driver is kIdle afterwards, unless it is kDown.
  void stop() noexcept {
    if (state_ == State::kDown) return;
    command(kOff);
    write(spi_, kAllEvents);
    if (state_ == State::kTransmitting) write(spi_, kClocksAutomatic);
    if (state_ == State::kReceiving) reset_receiver();
    state_ = State::kIdle;
  }

 private:
  static constexpr Value<reg::PmscClock> kTransmitClockForced{0x20};
  static constexpr Value<reg::PmscClock> kClocksAutomatic{0x00};
  static constexpr Value<reg::PmscReset> kReceiverReset{0xE0};
  static constexpr Value<reg::PmscReset> kNoReset{0xF0};
  static constexpr Value<reg::RfBias> kSensorBias{0x80};
  static constexpr Value<reg::RfSensors> kSensorAndConverterBias{0x0A};
  static constexpr Value<reg::RfSensors> kSensorOutputs{0x0F};
  static constexpr Value<reg::TcSarc> kConverterOff{0x00};
  static constexpr Value<reg::TcSarc> kConverterOn{0x01};

  static constexpr auto kTransmitDelayed =
      Value<reg::SysCtrl>().set(reg::sys_ctrl::kTransmit).set(reg::sys_ctrl::kDelayedTransmit);
  static constexpr auto kReceiveDelayed =
      Value<reg::SysCtrl>().set(reg::sys_ctrl::kReceive).set(reg::sys_ctrl::kDelayedReceive);
  static constexpr auto kReceiveNow = Value<reg::SysCtrl>().set(reg::sys_ctrl::kReceive);
  static constexpr auto kOff = Value<reg::SysCtrl>().set(reg::sys_ctrl::kOff);

  static constexpr auto kPllFlags =
      Value<reg::SysStatus>().set(reg::sys_status::kRfPllLosing).set(reg::sys_status::kClockPllLosing);
  // All except kPllFlags, which only poll_event() clears, so that it counts each of them.
  static constexpr Value<reg::SysStatus> kAllEvents{0x07'FCFF'FFFF};

  // All commands in use are in the low half of the register.
  void command(const Value<reg::SysCtrl>& bits) noexcept { write_part<reg::SysCtrl, 0, 2>(spi_, bits); }
  // Clears all events that end an operation, except late transmissions.
  void clear_events() noexcept { write_part<reg::SysStatus, 0, 4>(spi_, kAllEvents); }

  // The registers that an operation may set are not known, except DRX_PRETOC, which is 0.
  void forget_operations() noexcept {
    preamble_timeout_chunks_ = 0;
    frame_timeout_units_ = 0;
    frame_timeout_ = ranging::Ticks(-1);
    format_length_ = 0;
  }

  void set_timeouts(ranging::Ticks frame_timeout, std::optional<ranging::Ticks> preamble_timeout) noexcept {
    // A listening is usually as long as the one before, and 64-bit divisions take long.
    if (frame_timeout == frame_timeout_ && preamble_timeout == preamble_timeout_) return;
    frame_timeout_ = frame_timeout;
    preamble_timeout_ = preamble_timeout;
    const std::uint16_t units = rounded_up(frame_timeout, ranging::Ticks(ranging::Ticks::kPerUus));
    if (units != frame_timeout_units_) {
      frame_timeout_units_ = units;
      write(spi_, Value<reg::RxFwto>(units));
    }
    const std::uint16_t chunks =
        preamble_timeout ? rounded_up(*preamble_timeout, start_up_.chunk()) : std::uint16_t{0};
    if (chunks == preamble_timeout_chunks_) return;
    preamble_timeout_chunks_ = chunks;
    write(spi_, Value<reg::DrxPretoc>(chunks));
  }

  // In units, rounded up, from 1 to 65535.
  [[nodiscard]] static std::uint16_t rounded_up(ranging::Ticks t, ranging::Ticks unit) noexcept {
    const std::int64_t units = (t.count() + unit.count() - 1) / unit.count();
    return static_cast<std::uint16_t>(units < 1 ? 1 : units > 0xFFFF ? 0xFFFF : units);
  }

  [[nodiscard]] Event take_transmitted() noexcept {
    const ranging::DeviceTime timestamp(read<reg::TxTime>(spi_).get(reg::tx_time::kTimestamp));
    clear_events();
    write(spi_, kClocksAutomatic);
    state_ = State::kIdle;
    return {.kind = EventKind::kTransmitted, .timestamp = timestamp};
  }

  [[nodiscard]] static EventKind failure_of(const Value<reg::SysStatus>& status) noexcept {
    namespace st = reg::sys_status;
    if (status.has(st::kHeaderError) || status.has(st::kSyncLoss)) return EventKind::kHeaderError;
    if (status.has(st::kCheckError)) return EventKind::kCheckError;
    if (status.has(st::kSfdTimeout)) return EventKind::kSfdTimeout;
    if (status.has(st::kPreambleTimeout)) return EventKind::kPreambleTimeout;
    if (status.has(st::kFrameTimeout)) return EventKind::kFrameTimeout;
    return EventKind::kNone;
  }

  // Length of a frame without frame check.
  void set_length(std::size_t bytes) noexcept {
    const std::size_t length = bytes + kFrameCheckBytes;
    if (length == format_length_) return;
    format_length_ = length;
    // Only the low byte: Value::set() works bit by bit, and time may be short.
    static_assert(reg::tx_fctrl::kLength.kLsb == 0 && reg::tx_fctrl::kLength.kWidth >= 8);
    static_assert(kMaxFrameBytes <= 0xFF);
    frame_format_.bytes()[0] = static_cast<std::uint8_t>(length);
    write(spi_, frame_format_);
  }

  // User manual 4.1.6: after an error or a time-out the next timestamp would be wrong. After kOff, as in
  // Decawave's driver.
  void reset_receiver() noexcept {
    write(spi_, kReceiverReset);
    write(spi_, kNoReset);
  }

  static constexpr int kLdeTries = 8;

  S& spi_;
  StartUp<S> start_up_;
  State state_ = State::kDown;
  std::uint32_t pll_flags_ = 0;
  // Cached register values of the chip; 0: not known, except for the first one.
  std::uint16_t preamble_timeout_chunks_ = 0;
  std::uint16_t frame_timeout_units_ = 0;
  ranging::Ticks frame_timeout_{-1};  // the last one requested
  std::optional<ranging::Ticks> preamble_timeout_{};
  std::size_t format_length_ = 0;
  Value<reg::TxFctrl> frame_format_;
  std::array<std::uint8_t, kMaxFrameBytes> frame_{};
};

}  // namespace groma::dw1000
