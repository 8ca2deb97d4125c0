// A register-level model of the DW1000: SPI on one side, the medium on the other, an interrupt line.
//
// The caller advances its time: advance(t), or an SPI transfer that ends at t. Internal events between two
// calls take effect at their own instants. A chip may be ahead of its neighbours by less than the time from a
// frame's first symbol to the first effect at a receiver (one PAC, 8 us or more). A frame that is announced
// later than that is still received correctly if the receiver did not change its state in between;
// late_announcements() counts the others.
//
// How receptions end:
//   - The receiver detects a preamble of which it hears two chunks of PAC symbols or more. Its hunt begins 16
//   us
//     after it was switched on (ChipQuirks).
//   - Two frames overlap at a receiver that is locked to the first. If the first is stronger by capture_db it
//     is received. If the second is stronger by capture_db and begins before the first's RMARKER it is
//     received instead. Otherwise the first is damaged from where the second begins (no SFD, then header
//     error, then frame-check error) and the second is not detected.
//   - A receiver that is switched on during a frame receives a later frame that is stronger by capture_db.
//   - After a header error, a Reed-Solomon error or a time-out, timestamps are wrong until the receiver is
//     reset.
//
// The model is strict: an access to a register that is not modelled, a mode that is not modelled, or a
// command that the real chip does not support leaves a message in fault().
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "firmware/sim/dw1000_air_time.hpp"
#include "firmware/sim/dw1000_registers.hpp"
#include "firmware/sim/dw1000_tuning.hpp"
#include "firmware/sim/medium.hpp"
#include "firmware/sim/node_clock.hpp"
#include "firmware/sim/time.hpp"

namespace groma::sim {

// The one-time programmable words that firmware may read.
struct OtpWords {
  std::uint32_t ldo_tune = 0x8A9AAA88;
  std::uint32_t part_id = 0x10000001;
  std::uint32_t lot_id = 0x0D0D0001;
  std::uint32_t supply = 0x000000A9;       // the converter's reading at 3.3 V
  std::uint32_t temperature = 0x0000007D;  // the converter's reading at 23 degrees C
  std::uint32_t antenna_delay = 0;
  std::uint32_t crystal_trim = 0x10;
};

// The chip's operating conditions.
struct Ambient {
  double temperature_c = 23.0;
  double supply_v = 3.3;
};

// Biases of the timestamps. The model applies them to the receive timestamps alone; each end of a two-way
// range contributes half.
struct TimestampBias {
  bool drift = false;  // range per end: 2.15 mm per degree C from 23, and 5.35 cm per volt from 3.3
  bool power = false;  // depends on receive power: APS011, table 2, for PRF 64 MHz
};

// What the silicon does and the manual's model of it does not show; see docs/explanation/silicon.md.
struct ChipQuirks {
  // Erratum SYSSTAT-1: CLKPLL_LL or RFPLL_LL is set although both PLLs are locked, this often on average, and
  // CLKPLL_LL also 10 to 500 us after half of the locks. 0: never.
  double false_pll_flags_per_minute = 1.0;
  // At power-on the chip sleeps, as another firmware left it: only the select line wakes it, held low for
  // kWakeUpSelect. The next reset puts it to sleep again unless its always-on memory was cleared before.
  bool asleep = false;
  // The receiver hunts for preambles from kReceiverStartTicks after it was switched on, and then also detects
  // a preamble that has begun, if kLeastChunks of it are left. Its time-outs run from when it was switched
  // on.
  bool receiver_start_up = true;
  // A delayed transmission without time for the power-up (TXPUTE) is never sent and never reported.
  bool missed_starts = true;
  // A reset of the receiver counts only after TRXOFF: without it timestamps stay wrong.
  bool reset_needs_off = true;
  // At the launch of a delayed transmission the counter gains this share of the time from the command to the
  // RMARKER, as one bench has measured. Off by default, because no second source has seen it.
  double delayed_transmit_gain_ppm = 0.0;
};

struct ChipSpec {
  std::uint16_t id = 0;  // names the antenna to the propagation model
  ClockSpec clock{};
  OtpWords otp{};
  // The antennas' true delays; registers with the same values give unbiased ranges.
  std::uint32_t transmit_antenna_delay_ticks = 16436;
  std::uint32_t receive_antenna_delay_ticks = 16436;
  Ambient ambient{};
  TimestampBias bias{};
  ChipQuirks quirks{};
};

class Dw1000Chip {
 public:
  // From the release of the reset line, or from power-on, to the first SPI access that succeeds, and to the
  // lock of the clock PLL.
  static constexpr SimTime kSpiReadyAfterReset = 1500 * kUnitsPerMicrosecond;
  static constexpr SimTime kPllLockAfterReset = 2100 * kUnitsPerMicrosecond;
  // From a wake-up to the first SPI access that succeeds.
  static constexpr SimTime kSpiReadyAfterWakeUp = 4000 * kUnitsPerMicrosecond;
  static constexpr SimTime kWakeUpSelect = 500 * kUnitsPerMicrosecond;
  static constexpr SimTime kPllLockAfterSoftReset = 10 * kUnitsPerMicrosecond;
  // One conversion of temperature and supply, with the PLL's clock.
  static constexpr SimTime kConversionTime = 900 * kUnitsPerMicrosecond;
  static constexpr SimTime kLdeLoadTime = 120 * kUnitsPerMicrosecond;
  static constexpr std::int64_t kTransmitterPowerUpTicks = 351'437;  // 5.5 us
  static constexpr std::int64_t kReceiverStartTicks =
      std::int64_t{1'997} * 512;  // 16 us in periods of the 125 MHz clock
  // Chunks of PAC symbols that the receiver needs to detect a preamble.
  static constexpr std::int64_t kLeastChunks = 2;

  // Attaches itself to the medium, which must outlive it. Unpowered until set_power().
  Dw1000Chip(const ChipSpec& spec, Medium& medium);
  Dw1000Chip(const Dw1000Chip&) = delete;
  Dw1000Chip& operator=(const Dw1000Chip&) = delete;
  ~Dw1000Chip() = default;

  void set_power(bool on, SimTime t);
  // The reset line is released at t. The 40-bit counter restarts at the clock's first_tick.
  void reset(SimTime t);
  // The select line is pulled low or released at t. Only a chip that sleeps needs these calls.
  void select(SimTime t, bool low);

  // One chip-select window that ends at t: a header of 1 to 3 bytes, then the payload. hz: the SPI clock.
  void write(SimTime t, std::span<const std::uint8_t> header, std::span<const std::uint8_t> out,
             std::uint32_t hz);
  void read(SimTime t, std::span<const std::uint8_t> header, std::span<std::uint8_t> in, std::uint32_t hz);
  // The same as one full-duplex transfer of equal length both ways.
  void transfer(SimTime t, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                std::uint32_t hz);

  void advance(SimTime t);
  // The next internal event, or kNever.
  [[nodiscard]] SimTime next_event() const noexcept { return next_event_; }
  [[nodiscard]] SimTime now() const noexcept { return now_; }
  // The next end of a transmission or of a reception sets no flag, so the processor never hears of it.
  void lose_next_event() noexcept { loses_event_ = true; }
  void set_ambient(const Ambient& ambient) noexcept { spec_.ambient = ambient; }

  // The interrupt line, active high, at now().
  [[nodiscard]] bool irq() const noexcept;

  // The first misuse of the chip; empty without one.
  [[nodiscard]] const std::string& fault() const noexcept { return fault_; }
  [[nodiscard]] std::uint64_t late_announcements() const noexcept { return late_announcements_; }
  // SPI transfers that were too fast for the system clock: writes had no effect, reads returned garbage.
  [[nodiscard]] std::uint64_t garbled_transfers() const noexcept { return garbled_transfers_; }
  [[nodiscard]] std::uint16_t id() const noexcept { return spec_.id; }
  [[nodiscard]] bool powered() const noexcept { return powered_; }
  [[nodiscard]] const NodeClock& clock() const noexcept { return clock_; }
  // SYS_TIME with all its bits, unwrapped.
  [[nodiscard]] std::int64_t ticks(SimTime t) const noexcept { return clock_.ticks(t) - counter_base_; }
  [[nodiscard]] std::uint64_t register_value(Reg reg) const noexcept { return registers_.get(reg); }

  // Called by the medium.
  void incoming(std::shared_ptr<const AirFrame> frame);
  void withdraw(const AirFrame& frame);

 private:
  struct Transmission {
    std::shared_ptr<AirFrame> frame;
    bool delayed = false;
    bool wait_for_response = false;
    bool announced = false;
    std::int64_t start_tick = 0;
    std::int64_t rmarker_tick = 0;  // without antenna delay: TX_RAWST
    std::int64_t gain_ticks = 0;    // of the counter at the launch
    SimTime announce_at = 0;
    // Starts of preamble, SFD and data, and the end: when TXFRB, TXPRS, TXPHS and TXFRS are set.
    std::array<SimTime, 4> at{};
    std::size_t stage = 0;
  };

  struct Arrival {
    std::shared_ptr<const AirFrame> frame;
    Reception reception;
    bool resolved = false;
    bool started = false;
  };

  enum class Receiver : std::uint8_t { kOff, kDelayed, kHunting, kPreamble, kFrame };

  // dw1000_chip.cpp: power, SPI, commands, transmitter
  void restart_counter(SimTime t) noexcept;
  void boot(SimTime t, SimTime until_spi);
  void lock_pll();
  void draw_pll_flag(SimTime from);
  void clear_radio();
  bool spi_answers(std::uint32_t hz);
  void write_register(const RegisterInfo& info, std::size_t at, std::span<const std::uint8_t> bytes);
  void register_written(Reg reg);
  void system_configuration_written();
  void otp_control_written();
  void power_management_written(std::uint32_t before);
  void converter_written();
  void finish_conversion();
  void soft_reset();
  void command(std::uint32_t bits);
  void start_transmit(bool delayed, bool wait_for_response);
  void start_receive(bool delayed);
  void transceiver_off();
  bool radio_clocked(const char* what);
  void load_frame(AirFrame& frame);
  void transmission_step();
  void update_next_event() noexcept;
  [[nodiscard]] SimTime time_of(std::int64_t tick) const noexcept {
    return clock_.time_of_tick(tick + counter_base_);
  }
  [[nodiscard]] std::uint64_t live_status() const noexcept;
  [[nodiscard]] double timestamp_bias_ticks(double receive_power_dbm) const noexcept;
  // The absolute tick at which the counter's low 40 bits next are `value`.
  [[nodiscard]] std::int64_t next_tick_with(std::uint64_t value) const noexcept;
  void count_event(Reg counter);
  void complain(const std::string& message);

  // dw1000_receiver.cpp
  [[nodiscard]] SimTime next_receiver_event() const noexcept;
  void receiver_step(SimTime at);
  void receiver_on(SimTime at);
  void receiver_ends(std::uint64_t event, Reg counter, bool needs_reset);
  void preamble_begins(Arrival& arrival);
  [[nodiscard]] std::int64_t detection_of(const Arrival& arrival);
  [[nodiscard]] bool detectable(const Arrival& arrival);
  void lock(const Arrival& arrival);
  void overlap(const Arrival& later);
  void report_overlap(const AirFrame& lost, const AirFrame& by) const;
  void damage_from(SimTime at);
  void header_ends();
  void frame_ends();
  void invalidate_last_frame();
  void write_reception(bool damaged);
  void write_measurements();
  void receiver_off();
  void resolve(Arrival& arrival);
  void drop_past_frames();
  const Tuning& tuning();
  [[nodiscard]] bool listening() const noexcept { return receiver_ >= Receiver::kHunting; }

  Medium& medium_;
  std::size_t station_;
  ChipSpec spec_;
  NodeClock clock_;
  Dw1000Registers registers_;

  SimTime now_ = 0;
  SimTime next_event_ = kNever;
  std::int64_t counter_base_ = 0;
  bool powered_ = false;
  bool asleep_ = false;
  SimTime selected_at_ = kNever;  // when the select line was pulled low; kNever: it is high
  // The always-on memory's AON_CFG0 and AON_WCFG.
  std::uint64_t kept_sleep_settings_ = 0;
  std::uint64_t kept_wake_settings_ = 0;
  SimTime spi_ready_at_ = kNever;
  SimTime pll_locks_at_ = kNever;
  bool pll_locked_ = false;
  SimTime pll_flag_at_ = kNever;  // the next false flag
  std::uint64_t pll_flag_ = 0;    // its bit of SYS_STATUS
  std::uint64_t pll_flags_drawn_ = 0;
  SimTime lde_loaded_at_ = kNever;
  bool lde_loaded_ = false;
  SimTime converted_at_ = kNever;
  std::uint64_t status_ = 0;
  Tuning tuning_;
  bool tuning_valid_ = false;

  Transmission transmission_;  // has a frame while one is pending or being sent
  std::uint32_t frames_sent_ = 0;

  Receiver receiver_ = Receiver::kOff;
  bool receiver_needs_reset_ = false;
  bool turned_off_ = true;               // by TRXOFF since the receiver was last on
  std::int64_t receive_start_tick_ = 0;  // delayed
  SimTime receiver_on_at_ = 0;
  SimTime hunts_from_ = 0;
  SimTime last_on_at_ = kNever;  // of the previous listening period
  SimTime last_off_at_ = 0;
  SimTime preamble_timeout_at_ = kNever;
  SimTime frame_timeout_at_ = kNever;
  SimTime sfd_timeout_at_ = kNever;
  Arrival current_;  // has a frame while one is being received
  Loss damage_ = Loss::kNone;
  bool header_done_ = false;
  SimTime detected_at_ = kNever;
  std::int64_t accumulated_symbols_ = 0;
  std::vector<Arrival> arrivals_;  // sorted by (start, source); past frames are removed

  bool loses_event_ = false;
  std::uint64_t late_announcements_ = 0;
  std::uint64_t garbled_transfers_ = 0;
  std::string fault_;
};

}  // namespace groma::sim
