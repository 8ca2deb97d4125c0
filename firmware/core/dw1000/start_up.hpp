// The start-up of a DW1000: wakes it, sets its registers for the PHY in use and for this node, and checks
// them.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <span>

#include "firmware/core/dw1000/bus.hpp"
#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/dw1000/settings.hpp"
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

using radio::Settings;

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

template <Spi S>
class StartUp {
 public:
  explicit StartUp(S& spi) noexcept : spi_(spi) {}

  // Afterwards the bus is fast.
  template <class Reset, class Delay>
  [[nodiscard]] BringUp run(const Settings& settings, Reset&& reset, Delay&& delay_us) noexcept {
    int wake_ups = 0;
    for (;; ++wake_ups) {
      reset();
      spi_.set_speed(SpiSpeed::kSlow);
      if (read<reg::DevId>(spi_) == kDeviceId) break;
      if (wake_ups == kMostWakeUps) return BringUp::kNoChip;
      wake_up(wake_ups < kMostWakeUps / 2 ? kWakeUp_us : kLongWakeUp_us, delay_us);
    }
    woken_ = wake_ups > 0;

    write(spi_, kCrystalClock);
    if (const std::uint32_t ldo_tune = read_otp(kOtpLdoTune); (ldo_tune & 0xFF) != 0) {
      write(spi_, kLdoKick);
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
    write(spi_, Value<reg::DrxPretoc>());
    if (!await_lock(delay_us)) return BringUp::kNoLock;

    spi_.set_speed(SpiSpeed::kFast);
    if (read<reg::DevId>(spi_) != kDeviceId) return BringUp::kNoFastBus;
    return check_settings();
  }

  // The chip answers, has kept its registers, and its counter runs.
  template <class Delay>
  [[nodiscard]] bool works(Delay& delay_us) noexcept {
    return read<reg::DevId>(spi_) == kDeviceId && check_settings() == BringUp::kOk && runs(delay_us);
  }

  // Of the last run().
  [[nodiscard]] bool woken() const noexcept { return woken_; }
  [[nodiscard]] const radio::Phy& phy() const noexcept { return phy_; }
  // The symbols that the receiver correlates at a time.
  [[nodiscard]] ranging::Ticks chunk() const noexcept { return chunk_; }
  [[nodiscard]] const Value<reg::TxFctrl>& frame_format() const noexcept { return frame_format_; }
  [[nodiscard]] std::uint16_t transmit_antenna_delay_dtu() const noexcept {
    return transmit_antenna_delay_dtu_;
  }
  // An antenna delay was not plausible.
  [[nodiscard]] bool delay_replaced() const noexcept { return delay_replaced_; }
  // The converter's readings at 3.3 V and 23 degrees C, from the manufacturer's calibration.
  [[nodiscard]] std::uint8_t supply_at_reference() const noexcept { return supply_at_reference_; }
  [[nodiscard]] std::uint8_t temperature_at_reference() const noexcept { return temperature_at_reference_; }

 private:
  static constexpr Value<reg::DevId> kDeviceId{0xDECA0130};
  static constexpr Value<reg::PmscCtrl0> kCrystalClock{0x0201};
  static constexpr Value<reg::PmscCtrl0> kMicrocodeClock{0x0301};
  static constexpr Value<reg::PmscCtrl0> kNormalClock{0x0200};
  static constexpr Value<reg::OtpSf> kLdoKick{0x02};
  static constexpr std::uint8_t kTypicalSupplyReading = 175;
  static constexpr std::uint8_t kTypicalTemperatureReading = 120;
  static constexpr std::uint16_t kOtpLdoTune = 0x04;
  static constexpr std::uint16_t kOtpSupply = 0x08;       // the converter's reading at 3.3 V
  static constexpr std::uint16_t kOtpTemperature = 0x09;  // the converter's reading at 23 degrees C
  static constexpr std::uint16_t kOtpAntennaDelay = 0x1C;
  static constexpr std::uint16_t kOtpCrystalTrim = 0x1E;
  static constexpr Value<reg::SysStatus> kAllFlags{0x07'FFFF'FFFF};
  // Half of the attempts to wake the chip are of the manual's length, the others as long as Decawave's
  // driver's.
  static constexpr int kMostWakeUps = 4;
  static constexpr std::uint32_t kWakeUp_us = 600;
  static constexpr std::uint32_t kLongWakeUp_us = 2'000;

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
    if (read<reg::DevId>(spi_) != kDeviceId) return;
    write(spi_, kCrystalClock);
    write(spi_, Value<reg::AonWcfg>());
    write(spi_, Value<reg::AonCfg0>());
    write(spi_, Value<reg::AonCtrl>().set(reg::aon_ctrl::kSave));
    write(spi_, Value<reg::AonCtrl>());
    write(spi_, Value<reg::AonCtrl>().set(reg::aon_ctrl::kUpload));
    write(spi_, Value<reg::AonCtrl>());
  }

  // User manual 6.3.3. Needs the crystal's clock: words read at the PLL's clock are not reliable.
  [[nodiscard]] std::uint32_t read_otp(std::uint16_t address) noexcept {
    write(spi_, Value<reg::OtpAddr>(address));
    write(spi_, Value<reg::OtpCtrl>().set(reg::otp_ctrl::kReadEnable).set(reg::otp_ctrl::kRead));
    write(spi_, Value<reg::OtpCtrl>());
    return static_cast<std::uint32_t>(read<reg::OtpRdat>(spi_).word());
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
    if (fault == BringUp::kOk && !read<reg::PmscCtrl1>(spi_).has(reg::pmsc_ctrl1::kLeadingEdge)) {
      fault = BringUp::kNoTimestamps;
    }
    return fault;
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
    write(spi_, kMicrocodeClock);
    write(spi_, Value<reg::OtpCtrl>().set(reg::otp_ctrl::kLoadMicrocode));
    delay_us(kLoad_us);
    write(spi_, kNormalClock);
  }

  // Erratum SYSSTAT-1: CPLOCK is not reliable either, so the counter decides.
  template <class Delay>
  [[nodiscard]] bool await_lock(Delay& delay_us) noexcept {
    constexpr int kTries = 50;
    constexpr std::uint32_t kTry_us = 100;
    for (int i = 0; i < kTries && !read<reg::SysStatus>(spi_).has(reg::sys_status::kPllLocked); ++i) {
      delay_us(kTry_us);
    }
    write(spi_, kAllFlags);
    return runs(delay_us);
  }

  // The counter runs at its full rate, that of the PLL; the crystal's is 6.5 times lower.
  template <class Delay>
  [[nodiscard]] bool runs(Delay& delay_us) noexcept {
    constexpr std::uint32_t kWhile_us = 100;
    constexpr ranging::Ticks kLeast = ranging::Ticks::from_us(90);
    const auto counter = [this] { return ranging::DeviceTime(read<reg::SysTime>(spi_).word()); };
    const ranging::DeviceTime from = counter();
    delay_us(kWhile_us);
    return counter() - from >= kLeast;
  }

  S& spi_;
  bool woken_ = false;
  bool delay_replaced_ = false;
  std::uint16_t transmit_antenna_delay_dtu_ = 0;
  std::uint8_t supply_at_reference_ = kTypicalSupplyReading;
  std::uint8_t temperature_at_reference_ = kTypicalTemperatureReading;
  std::array<Setting, 8> node_settings_{};
  radio::Phy phy_ = phy_of(Preamble::k128);
  ranging::Ticks chunk_{1};
  Value<reg::TxFctrl> frame_format_;
};

}  // namespace groma::dw1000
