// A model of the MCP2518FD with its registers and message RAM: SPI on one side, a CanBus on the other, an
// interrupt line (data sheet DS20006027, family reference manual DS20005678).
//
// Modelled: reset, oscillator, the modes configuration, normal CAN FD and normal CAN 2.0; bit timing; the 31
// FIFOs and 32 filters; interrupts; error counters, error states, bus-off and its recovery after 128 times 11
// recessive bits, with the transmit FIFOs emptied; RAM error detection, which reports words that were never
// written. FIFOCI always reads wrong, as it sometimes does by erratum 6 of DS80000789.
//
// The model is strict: an access to a register that is not modelled (the transmit queue, the event FIFO,
// timestamps, CRC commands, GPIO and others), or a use that the real chip does not support, leaves a message
// in fault().
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string>

#include "firmware/sim/can_bus.hpp"
#include "firmware/sim/spi_device.hpp"
#include "firmware/sim/time.hpp"

namespace groma::sim {

struct Mcp2518fdSpec {
  std::uint32_t clock_hz = 40'000'000;
  bool oscillates = true;                    // false: a dead crystal
  bool is_mcp2517fd = false;                 // the predecessor, which has no low-power mode
  bool keeps_ram = true;                     // false: all bits of the RAM read as zero
  std::uint32_t transceiver_delay_ns = 220;  // from its transmit pin to its receive pin
};

class Mcp2518fdChip final : public SpiDevice, public CanStation {
 public:
  static constexpr SimTime kOscillatorStart = 2 * kUnitsPerMillisecond;

  // Attaches itself to the bus. Unpowered until set_power().
  Mcp2518fdChip(CanBus& bus, const Mcp2518fdSpec& spec);

  void set_power(bool on, SimTime t);

  // ---- SpiDevice
  void transfer(SimTime end, std::span<const std::uint8_t> mosi, std::span<std::uint8_t> miso,
                std::uint32_t hz) override;
  void advance(SimTime t) override;
  [[nodiscard]] SimTime next_event() const override;
  [[nodiscard]] bool irq() const override;

  // The first misuse of the chip; empty without one.
  [[nodiscard]] const std::string& fault() const noexcept { return fault_; }
  [[nodiscard]] bool bus_off() const noexcept { return bus_off_; }
  [[nodiscard]] unsigned transmit_errors() const noexcept { return transmit_errors_; }
  [[nodiscard]] unsigned receive_errors() const noexcept { return receive_errors_; }

  // ---- CanStation
  [[nodiscard]] std::optional<Offer> offer() const override;
  [[nodiscard]] bool participates() const override { return on_bus() && !bus_off_; }
  [[nodiscard]] bool error_passive() const override;
  [[nodiscard]] const CanRates& rates() const override { return rates_; }
  void frame_begins(SimTime t) override;
  void sent(SimTime end) override;
  void send_failed(SimTime t, CanError error) override;
  void received(const wire::CanFrame& frame, SimTime end) override;
  void receive_failed(SimTime t) override;

 private:
  static constexpr unsigned kRamBytes = 2048;
  static constexpr unsigned kFifos = 32;  // the first is not used: it is the transmit queue
  static constexpr unsigned kFilters = 32;
  static constexpr unsigned kRegisterWords = 0x300 / 4;

  enum class Mode : std::uint8_t { kNormalFd = 0, kConfiguration = 4, kNormalClassic = 6 };
  enum class ErrorState : std::uint8_t { kActive, kWarning, kPassive, kOff };

  struct Fifo {
    unsigned base = 0;  // in the RAM
    unsigned object_bytes = 0;
    unsigned payload_bytes = 0;
    unsigned depth = 0;
    unsigned tail = 0;
    unsigned count = 0;
    bool transmits = false;
    bool requested = false;  // TXREQ
    bool overrun = false;
    [[nodiscard]] unsigned head() const noexcept { return (tail + count) % depth; }
    [[nodiscard]] unsigned address(unsigned index) const noexcept { return base + index * object_bytes; }
  };

  void reset();
  void complain(const std::string& message);
  void settle(SimTime t);
  [[nodiscard]] bool on_bus() const noexcept { return powered_ && mode_ != Mode::kConfiguration; }

  // SPI
  std::uint8_t read_byte(unsigned address);
  void write_bytes(unsigned address, std::span<const std::uint8_t> bytes);
  [[nodiscard]] std::uint32_t read_register(unsigned address);
  void write_register(unsigned address, std::uint32_t value, std::uint32_t mask);
  void write_con(std::uint32_t value, std::uint32_t mask);
  void write_fifo_con(unsigned index, std::uint32_t value, std::uint32_t mask);
  [[nodiscard]] std::uint32_t fifo_status(unsigned index) const;
  [[nodiscard]] std::uint32_t interrupts() const;
  void config_only(const char* name, unsigned address, std::uint32_t value, std::uint32_t mask,
                   std::uint32_t writable, std::uint32_t protected_bits);

  // RAM
  [[nodiscard]] std::uint32_t ram_word(unsigned offset);
  void set_ram_word(unsigned offset, std::uint32_t word);

  // modes
  void request_mode(unsigned mode);
  void enter_configuration();
  void enter_normal(Mode mode);
  void lay_out_fifos();
  void load_bit_timing();

  // transmission and errors
  void load_next_frame(SimTime t);
  [[nodiscard]] ErrorState error_state() const noexcept;
  void errors_changed(ErrorState before);
  void go_bus_off(SimTime t);
  [[nodiscard]] std::optional<unsigned> fifo_for(std::uint32_t id);

  [[nodiscard]] std::uint32_t& word(unsigned address) { return registers_[address / 4]; }
  [[nodiscard]] std::uint32_t word(unsigned address) const { return registers_[address / 4]; }

  CanBus& bus_;
  Mcp2518fdSpec spec_;
  bool powered_ = false;
  SimTime now_ = 0;
  SimTime oscillator_ready_at_ = kNever;

  std::array<std::uint32_t, kRegisterWords> registers_{};
  std::uint32_t osc_ = 0;
  std::uint32_t ecc_control_ = 0;
  std::uint32_t ecc_status_ = 0;
  std::array<std::uint8_t, kRamBytes> ram_{};
  std::array<bool, kRamBytes / 4> written_{};
  std::array<Fifo, kFifos> fifos_{};

  Mode mode_ = Mode::kConfiguration;
  std::optional<Mode> requested_mode_;
  SimTime requested_at_ = 0;
  CanRates rates_{};
  bool can_check_own_bits_ = true;

  unsigned sending_ = 0;  // the FIFO whose object is next_frame_
  std::optional<wire::CanFrame> next_frame_;
  SimTime offer_since_ = 0;

  unsigned transmit_errors_ = 0;
  unsigned receive_errors_ = 0;
  bool bus_off_ = false;
  bool was_bus_off_ = false;  // since the flag was last cleared
  SimTime bus_off_at_ = 0;
  std::int64_t recessive_sequences_ = 0;  // of 11 bits, seen before the last frame began
  std::string fault_;
};

}  // namespace groma::sim
