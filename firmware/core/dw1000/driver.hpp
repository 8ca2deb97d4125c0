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

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/dw1000/receive_quality.hpp"
#include "firmware/core/dw1000/registers.hpp"
#include "firmware/core/dw1000/settings.hpp"
#include "firmware/core/dw1000/spi.hpp"
#include "firmware/core/radio/radio.hpp"
#include "firmware/core/ranging/device_time.hpp"

namespace groma::dw1000 {

// Without a configured delay the one that the manufacturer wrote to the OTP memory applies. This one does if
// there is none there, or if either is outside of the limits.
inline constexpr std::uint16_t kDefaultAntennaDelay_dtu = 16436;
// Of one side. Some chips hold the sum of both sides in their OTP memory.
inline constexpr std::uint16_t kLeastAntennaDelay_dtu = 15'000;
inline constexpr std::uint16_t kMostAntennaDelay_dtu = 18'000;
// TX_POWER, equal for all parts of a frame.
inline constexpr std::uint32_t kDefaultTransmitPower = 0x8585'8585;

using radio::Ambient;
using radio::Event;
using radio::EventKind;
using radio::Settings;
using radio::Start;

enum class BringUp : std::uint8_t {
  kOk,
  kNoChip,        // no DW1000 answers on the bus
  kNoLock,        // its clock PLL did not lock
  kNoFastBus,     // it answers at 2 MHz, but not at 8 MHz
  kNotWritable,   // a register did not keep what was written
  kNoTrim,        // the crystal trim register did not keep its value
  kNoTimestamps,  // the leading edge detector's registers did not keep their values, or it is off
};

// At most 31 characters; empty for kOk.
[[nodiscard]] constexpr const char* describe(BringUp result) noexcept {
  switch (result) {
    case BringUp::kOk:
      return "";
    case BringUp::kNoChip:
      return "no DW1000 answers on SPI";
    case BringUp::kNoLock:
      return "clock PLL does not lock";
    case BringUp::kNoFastBus:
      return "SPI fails at full speed";
    case BringUp::kNotWritable:
      return "registers do not keep values";
    case BringUp::kNoTrim:
      return "crystal trim is not kept";
    case BringUp::kNoTimestamps:
      return "leading edge detector not ready";
  }
  return "";
}

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

  explicit Dw1000(S& spi) noexcept : spi_(spi) {}

  // Afterwards the bus is fast and the driver is kIdle; if the result is not kOk, the driver is kDown.
  template <class Reset, class Delay>
  [[nodiscard]] BringUp bring_up(const Settings& settings, Reset&& reset, Delay&& delay_us) noexcept {
    state_ = State::kDown;
    int wake_ups = 0;
    for (;; ++wake_ups) {
      reset();
      spi_.set_speed(SpiSpeed::kSlow);
      if (read<reg::DevId>() == kDeviceId) break;
      if (wake_ups == kMostWakeUps) return BringUp::kNoChip;
      wake_up(wake_ups < kMostWakeUps / 2 ? kWakeUp_us : kLongWakeUp_us, delay_us);
    }
    woken_ = wake_ups > 0;

    write<reg::PmscCtrl0>(kCrystalClock);
    if (const std::uint32_t ldo_tune = read_otp(kOtpLdoTune); (ldo_tune & 0xFF) != 0) {
      write<reg::OtpSf>(kLdoKick);
    }
    settle(settings, read_otp(kOtpAntennaDelay), read_otp(kOtpCrystalTrim));
    supply_at_reference_ = reading_of(read_otp(kOtpSupply), kTypicalSupplyReading);
    temperature_at_reference_ = reading_of(read_otp(kOtpTemperature), kTypicalTemperatureReading);
    load_leading_edge_microcode(delay_us);
    for_each_setting([this](const Setting& s) {
      const auto bytes = s.bytes();
      spi_.write(TransactionHeader(true, s.id, s.sub).bytes(), std::span(bytes).first(s.length));
      return true;
    });
    forget_operations();
    if (!await_lock(delay_us)) return BringUp::kNoLock;

    spi_.set_speed(SpiSpeed::kFast);
    if (read<reg::DevId>() != kDeviceId) return BringUp::kNoFastBus;
    if (const BringUp fault = check_settings(); fault != BringUp::kOk) return fault;
    state_ = State::kIdle;
    return BringUp::kOk;
  }

  // Checks that the chip answers, has kept its registers, and that its counter runs: the driver is then
  // kIdle, otherwise kDown.
  template <class Delay>
  [[nodiscard]] bool restart(Delay&& delay_us) noexcept {
    stop();
    forget_operations();
    const bool works = state_ == State::kIdle && read<reg::DevId>() == kDeviceId &&
                       check_settings() == BringUp::kOk && runs(delay_us);
    if (!works) state_ = State::kDown;
    return works;
  }

  [[nodiscard]] State state() const noexcept { return state_; }
  // The last bring-up found the chip asleep.
  [[nodiscard]] bool woken() const noexcept { return woken_; }
  // Since the last bring-up.
  [[nodiscard]] const radio::Phy& phy() const noexcept { return phy_; }
  [[nodiscard]] ranging::Ticks transmit_antenna_delay() const noexcept {
    return ranging::Ticks(transmit_antenna_delay_dtu_);
  }
  // What the host should know about a chip that came up; empty if nothing. At most 47 characters.
  [[nodiscard]] const char* warning() const noexcept {
    return delay_replaced_ ? "antenna delay not plausible, 16436 used" : "";
  }
  // Times that poll_event() found CLKPLL_LL or RFPLL_LL set.
  [[nodiscard]] std::uint32_t pll_flags() const noexcept { return pll_flags_; }

  [[nodiscard]] ranging::DeviceTime now() noexcept {
    return ranging::DeviceTime(read<reg::SysTime>().word());
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
    write(Value<reg::DxTime>((timestamp - transmit_antenna_delay()).count()));
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
    write<reg::PmscClock>(kTransmitClockForced);
    command(kTransmitDelayed);
    state_ = State::kTransmitting;
    // HPDWARN, and TXPUTE.
    const auto status = read_part<reg::SysStatus, 3, 2>();
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
    write(Value<reg::DxTime>(from.count()));
    command(kReceiveDelayed);
    if (read_part<reg::SysStatus, 3, 1>().has(reg::sys_status::kHalfPeriod)) {
      // The receiver was not on, so it needs no reset.
      command(kOff);
      write(kAllEvents);
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
    auto status = read_part<reg::SysStatus, 0, 4>();
    // Erratum SYSSTAT-1: these flags come without cause, too.
    if (status.has(st::kClockPllLosing) || status.has(st::kRfPllLosing)) {
      ++pll_flags_;
      write_part<reg::SysStatus, 3, 1>(kPllFlags);
    }
    if (state_ == State::kTransmitting && status.has(st::kTransmitted)) return take_transmitted();
    if (state_ == State::kReceiving) {
      if (status.has(st::kReceived)) {
        // The frame may be complete before its leading edge is found.
        for (int i = 0; i < kLdeTries && !status.has(st::kTimestamped) && !status.has(st::kTimestampError);
             ++i) {
          status = read_part<reg::SysStatus, 0, 4>();
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
    if (status.has(st::kInterrupt)) write(kAllEvents);
    return {};
  }

  // Must end before the next listening begins, which may be armed already.
  template <class OnBytes>
  void read_frame(Event& event, OnBytes&& on_bytes) noexcept {
    // If the next listening is armed, read first what the receiver overwrites first.
    Value<reg::DrxResults> results;
    const bool armed = state_ == State::kReceiving;
    if (armed) results = read<reg::DrxResults>();
    const auto info = read<reg::RxFinfo>();
    const auto length = static_cast<std::size_t>(info.get(reg::rx_finfo::kLength));
    const std::size_t size = length < kFrameCheckBytes ? 0 : length - kFrameCheckBytes;
    const std::span<std::uint8_t> frame =
        std::span(frame_).first(size < frame_.size() ? size : frame_.size());
    spi_.read(TransactionHeader(false, reg::RxBuffer::kId, reg::RxBuffer::kSub).bytes(), frame);
    const bool quality_wanted = on_bytes(std::span<const std::uint8_t>(frame));
    const auto time = read_part<reg::RxTime, 0, 9>();
    event.timestamp = ranging::DeviceTime(time.get(reg::rx_time::kTimestamp));
    event.frame = frame;
    if (!quality_wanted) return;
    if (!armed) results = read<reg::DrxResults>();
    const auto quality = read<reg::RxFqual>();
    const auto peak = read<reg::LdePpindx>();
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
    write<reg::RfBias>(kSensorBias);
    write<reg::RfSensors>(kSensorAndConverterBias);
    write<reg::RfSensors>(kSensorOutputs);
    write<reg::TcSarc>(kConverterOff);
    write<reg::TcSarc>(kConverterOn);
  }
  [[nodiscard]] std::optional<Ambient> finish_sampling() noexcept {
    if (state_ == State::kDown) return std::nullopt;
    const auto supply = static_cast<std::int32_t>(read<reg::TcSarSupply>().word());
    const auto temperature = static_cast<std::int32_t>(read<reg::TcSarTemperature>().word());
    write<reg::TcSarc>(kConverterOff);
    // Temperature = (reading - reading at 23 degrees C) 1.14 + 23, supply = (reading - reading at 3.3 V) /
    // 173 + 3.3.
    return Ambient{
        .temperature_cdegc =
            static_cast<std::int16_t>((temperature - temperature_at_reference_) * 114 + 2'300),
        .supply_mv = static_cast<std::uint16_t>((supply - supply_at_reference_) * 1'000 / 173 + 3'300)};
  }

  // Ends the present operation; the driver is kIdle afterwards, unless it is kDown.
  void stop() noexcept {
    if (state_ == State::kDown) return;
    command(kOff);
    write(kAllEvents);
    if (state_ == State::kTransmitting) write<reg::PmscClock>(kClocksAutomatic);
    if (state_ == State::kReceiving) reset_receiver();
    state_ = State::kIdle;
  }

 private:
  static constexpr Value<reg::DevId> kDeviceId{0xDECA0130};
  static constexpr Value<reg::PmscCtrl0> kCrystalClock{0x0201};
  static constexpr Value<reg::PmscCtrl0> kMicrocodeClock{0x0301};
  static constexpr Value<reg::PmscCtrl0> kNormalClock{0x0200};
  static constexpr Value<reg::PmscClock> kTransmitClockForced{0x20};
  static constexpr Value<reg::PmscClock> kClocksAutomatic{0x00};
  static constexpr Value<reg::PmscReset> kReceiverReset{0xE0};
  static constexpr Value<reg::PmscReset> kNoReset{0xF0};
  static constexpr Value<reg::OtpSf> kLdoKick{0x02};
  static constexpr Value<reg::RfBias> kSensorBias{0x80};
  static constexpr Value<reg::RfSensors> kSensorAndConverterBias{0x0A};
  static constexpr Value<reg::RfSensors> kSensorOutputs{0x0F};
  static constexpr Value<reg::TcSarc> kConverterOff{0x00};
  static constexpr Value<reg::TcSarc> kConverterOn{0x01};
  static constexpr std::uint8_t kTypicalSupplyReading = 175;
  static constexpr std::uint8_t kTypicalTemperatureReading = 120;
  static constexpr std::uint16_t kOtpLdoTune = 0x04;
  static constexpr std::uint16_t kOtpSupply = 0x08;       // the converter's reading at 3.3 V
  static constexpr std::uint16_t kOtpTemperature = 0x09;  // the converter's reading at 23 degrees C
  static constexpr std::uint16_t kOtpAntennaDelay = 0x1C;
  static constexpr std::uint16_t kOtpCrystalTrim = 0x1E;

  static constexpr auto kTransmitDelayed =
      Value<reg::SysCtrl>().set(reg::sys_ctrl::kTransmit).set(reg::sys_ctrl::kDelayedTransmit);
  static constexpr auto kReceiveDelayed =
      Value<reg::SysCtrl>().set(reg::sys_ctrl::kReceive).set(reg::sys_ctrl::kDelayedReceive);
  static constexpr auto kReceiveNow = Value<reg::SysCtrl>().set(reg::sys_ctrl::kReceive);
  static constexpr auto kOff = Value<reg::SysCtrl>().set(reg::sys_ctrl::kOff);

  static constexpr Value<reg::SysStatus> kAllFlags{0x07'FFFF'FFFF};
  static constexpr auto kPllFlags =
      Value<reg::SysStatus>().set(reg::sys_status::kRfPllLosing).set(reg::sys_status::kClockPllLosing);
  // All except kPllFlags, which only poll_event() clears, so that it counts each of them.
  static constexpr Value<reg::SysStatus> kAllEvents{0x07'FCFF'FFFF};

  template <class R>
  [[nodiscard]] Value<R> read() noexcept {
    static_assert(R::kReadable, "a register that cannot be read");
    Value<R> value;
    spi_.read(TransactionHeader(false, R::kId, R::kSub).bytes(), value.bytes());
    return value;
  }

  template <class R>
  void write(const Value<R>& value) noexcept {
    static_assert(R::kWritable, "a register that cannot be written");
    spi_.write(TransactionHeader(true, R::kId, R::kSub).bytes(), value.bytes());
  }

  // Reads bytes `First` to `First + Count - 1` of the register; the others are zero.
  template <class R, std::size_t First, std::size_t Count>
  [[nodiscard]] Value<R> read_part() noexcept {
    static_assert(R::kReadable, "a register that cannot be read");
    Value<R> value;
    spi_.read(TransactionHeader(false, R::kId, R::kSub + First).bytes(),
              value.bytes().template subspan<First, Count>());
    return value;
  }
  template <class R, std::size_t First, std::size_t Count>
  void write_part(const Value<R>& value) noexcept {
    static_assert(R::kWritable, "a register that cannot be written");
    spi_.write(TransactionHeader(true, R::kId, R::kSub + First).bytes(),
               value.bytes().template subspan<First, Count>());
  }
  // All commands in use are in the low half of the register.
  void command(const Value<reg::SysCtrl>& bits) noexcept { write_part<reg::SysCtrl, 0, 2>(bits); }
  // Clears all events that end an operation, except late transmissions.
  void clear_events() noexcept { write_part<reg::SysStatus, 0, 4>(kAllEvents); }

  // A chip that other firmware put to sleep wakes by its select line alone (user manual 2.3.2: 500 us), and
  // not always at the first time. From its always-on memory each reset would load the request to sleep again.
  // To clear that memory the manual names UPL_CFG; Decawave's driver uses SAVE.
  template <class Delay>
  void wake_up(std::uint32_t select_us, Delay& delay_us) noexcept {
    constexpr std::uint32_t kCrystal_us = 5'000;
    spi_.select(true);
    delay_us(select_us);
    spi_.select(false);
    delay_us(kCrystal_us);
    if (read<reg::DevId>() != kDeviceId) return;
    write<reg::PmscCtrl0>(kCrystalClock);
    write(Value<reg::AonWcfg>());
    write(Value<reg::AonCfg0>());
    write(Value<reg::AonCtrl>().set(reg::aon_ctrl::kSave));
    write(Value<reg::AonCtrl>());
    write(Value<reg::AonCtrl>().set(reg::aon_ctrl::kUpload));
    write(Value<reg::AonCtrl>());
  }

  // User manual 6.3.3. Needs the crystal's clock: words read at the PLL's clock are not reliable.
  [[nodiscard]] std::uint32_t read_otp(std::uint16_t address) noexcept {
    write(Value<reg::OtpAddr>(address));
    write(Value<reg::OtpCtrl>().set(reg::otp_ctrl::kReadEnable).set(reg::otp_ctrl::kRead));
    write(Value<reg::OtpCtrl>());
    return static_cast<std::uint32_t>(read<reg::OtpRdat>().word());
  }

  // The settings of this node and chip.
  void settle(const Settings& settings, std::uint32_t otp_delay, std::uint32_t otp_trim) noexcept {
    constexpr std::uint32_t kMidRange = 0x10;
    const std::uint32_t trim = otp_trim & 0x1F;
    const auto at_prf64 = static_cast<std::uint16_t>(otp_delay >> 16);
    const std::uint16_t own = at_prf64 == 0 || at_prf64 == 0xFFFF ? kDefaultAntennaDelay_dtu : at_prf64;
    delay_replaced_ = false;
    transmit_antenna_delay_dtu_ = plausible_delay(settings.transmit_antenna_delay_dtu.value_or(own));
    const std::uint16_t receive_delay = plausible_delay(settings.receive_antenna_delay_dtu.value_or(own));
    const auto preamble = preamble_settings(settings.preamble);
    node_settings_ = {
        preamble[0],
        preamble[1],
        preamble[2],
        preamble[3],
        setting(Value<reg::TxPower>(settings.transmit_power.value_or(kDefaultTransmitPower))),
        setting(Value<reg::TxAntd>(transmit_antenna_delay_dtu_)),
        setting(Value<reg::LdeRxantd>(receive_delay)),
        setting(Value<reg::FsXtalt>()
                    .set(reg::fs_xtalt::kFixed, 3)
                    .set(reg::fs_xtalt::kTrim, trim == 0 ? kMidRange : trim)),
    };
    frame_format_ = Value<reg::TxFctrl>()
                        .set(reg::tx_fctrl::kBitRate, 2)
                        .set(reg::tx_fctrl::kRanging)
                        .set(reg::tx_fctrl::kPrf, 2)
                        .set(reg::tx_fctrl::kPreamble, preamble_code(settings.preamble));
    phy_ = phy_of(settings.preamble);
    chunk_ = acquisition_chunk_symbols(settings.preamble) * kPreambleSymbol;
  }

  [[nodiscard]] std::uint16_t plausible_delay(std::uint16_t delay_dtu) noexcept {
    if (delay_dtu >= kLeastAntennaDelay_dtu && delay_dtu <= kMostAntennaDelay_dtu) return delay_dtu;
    delay_replaced_ = true;
    return kDefaultAntennaDelay_dtu;
  }

  // Calls f(setting) until it returns false. Returns whether it never did.
  template <class F>
  bool for_each_setting(const F& f) const noexcept {
    return std::all_of(kFixedSettings.begin(), kFixedSettings.end(), f) &&
           std::all_of(node_settings_.begin(), node_settings_.end(), f);
  }

  // Reads all settings back.
  [[nodiscard]] BringUp check_settings() noexcept {
    BringUp fault = BringUp::kOk;
    for_each_setting([&](const Setting& s) {
      std::array<std::uint8_t, 4> bytes{};
      spi_.read(TransactionHeader(false, s.id, s.sub).bytes(), std::span(bytes).first(s.length));
      if (bytes == s.bytes()) return true;
      fault = s.id == reg::LdeCfg1::kId                                  ? BringUp::kNoTimestamps
              : s.id == reg::FsXtalt::kId && s.sub == reg::FsXtalt::kSub ? BringUp::kNoTrim
                                                                         : BringUp::kNotWritable;
      return false;
    });
    // The microcode cannot be read back. If it is missing, no timestamp is valid, which counters.bad_stamps
    // shows.
    if (fault == BringUp::kOk && !read<reg::PmscCtrl1>().has(reg::pmsc_ctrl1::kLeadingEdge)) {
      fault = BringUp::kNoTimestamps;
    }
    return fault;
  }

  // The registers that each operation may set are as after a reset, or not known.
  void forget_operations() noexcept {
    write(Value<reg::DrxPretoc>());
    preamble_timeout_chunks_ = 0;
    frame_timeout_units_ = 0;
    frame_timeout_ = ranging::Ticks(-1);
    format_length_ = 0;
  }

  // The converter's reading at the reference, from the manufacturer's calibration.
  [[nodiscard]] static std::uint8_t reading_of(std::uint32_t otp_word, std::uint8_t fallback) noexcept {
    const auto reading = static_cast<std::uint8_t>(otp_word);
    return reading == 0 || reading == 0xFF ? fallback : reading;
  }

  // User manual 2.5.5.10. Without microcode the leading edge detector's timestamps are invalid.
  template <class Delay>
  void load_leading_edge_microcode(Delay& delay_us) noexcept {
    constexpr std::uint32_t kLoad_us = 200;
    write(kMicrocodeClock);
    write(Value<reg::OtpCtrl>().set(reg::otp_ctrl::kLoadMicrocode));
    delay_us(kLoad_us);
    write(kNormalClock);
  }

  // Erratum SYSSTAT-1: CPLOCK is not reliable either, so the counter decides.
  template <class Delay>
  [[nodiscard]] bool await_lock(Delay& delay_us) noexcept {
    constexpr int kTries = 50;
    constexpr std::uint32_t kTry_us = 100;
    for (int i = 0; i < kTries && !read<reg::SysStatus>().has(reg::sys_status::kPllLocked); ++i) {
      delay_us(kTry_us);
    }
    write(kAllFlags);
    return runs(delay_us);
  }

  // The counter runs at its full rate, that of the PLL; the crystal's is 6.5 times lower.
  template <class Delay>
  [[nodiscard]] bool runs(Delay& delay_us) noexcept {
    constexpr std::uint32_t kWhile_us = 100;
    constexpr ranging::Ticks kLeast = ranging::Ticks::from_us(90);
    const ranging::DeviceTime from = now();
    delay_us(kWhile_us);
    return now() - from >= kLeast;
  }

  void set_timeouts(ranging::Ticks frame_timeout, std::optional<ranging::Ticks> preamble_timeout) noexcept {
    // A listening is usually as long as the one before, and 64-bit divisions take long.
    if (frame_timeout == frame_timeout_ && preamble_timeout == preamble_timeout_) return;
    frame_timeout_ = frame_timeout;
    preamble_timeout_ = preamble_timeout;
    const std::uint16_t units = rounded_up(frame_timeout, ranging::Ticks(ranging::Ticks::kPerUus));
    if (units != frame_timeout_units_) {
      frame_timeout_units_ = units;
      write(Value<reg::RxFwto>(units));
    }
    const std::uint16_t chunks = preamble_timeout ? rounded_up(*preamble_timeout, chunk_) : std::uint16_t{0};
    if (chunks == preamble_timeout_chunks_) return;
    preamble_timeout_chunks_ = chunks;
    write(Value<reg::DrxPretoc>(chunks));
  }

  // In units, rounded up, from 1 to 65535.
  [[nodiscard]] static std::uint16_t rounded_up(ranging::Ticks t, ranging::Ticks unit) noexcept {
    const std::int64_t units = (t.count() + unit.count() - 1) / unit.count();
    return static_cast<std::uint16_t>(units < 1 ? 1 : units > 0xFFFF ? 0xFFFF : units);
  }

  [[nodiscard]] Event take_transmitted() noexcept {
    const ranging::DeviceTime timestamp(read<reg::TxTime>().get(reg::tx_time::kTimestamp));
    clear_events();
    write<reg::PmscClock>(kClocksAutomatic);
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
    write(frame_format_);
  }

  // User manual 4.1.6: after an error or a time-out the next timestamp would be wrong. After kOff, as in
  // Decawave's driver.
  void reset_receiver() noexcept {
    write(kReceiverReset);
    write(kNoReset);
  }

  static constexpr int kLdeTries = 8;
  // Half of the attempts to wake the chip are of the manual's length, the others as long as Decawave's
  // driver's.
  static constexpr int kMostWakeUps = 4;
  static constexpr std::uint32_t kWakeUp_us = 600;
  static constexpr std::uint32_t kLongWakeUp_us = 2'000;

  S& spi_;
  State state_ = State::kDown;
  bool woken_ = false;
  bool delay_replaced_ = false;
  std::uint16_t transmit_antenna_delay_dtu_ = 0;
  std::uint8_t supply_at_reference_ = kTypicalSupplyReading;
  std::uint8_t temperature_at_reference_ = kTypicalTemperatureReading;
  std::uint32_t pll_flags_ = 0;
  std::array<Setting, 8> node_settings_{};
  // Cached register values of the chip; 0: not known, except for the first one.
  std::uint16_t preamble_timeout_chunks_ = 0;
  std::uint16_t frame_timeout_units_ = 0;
  ranging::Ticks frame_timeout_{-1};  // the last one requested
  std::optional<ranging::Ticks> preamble_timeout_{};
  std::size_t format_length_ = 0;
  radio::Phy phy_ = phy_of(Preamble::k128);
  ranging::Ticks chunk_{1};
  Value<reg::TxFctrl> frame_format_;
  std::array<std::uint8_t, kMaxFrameBytes> frame_{};
};

}  // namespace groma::dw1000
