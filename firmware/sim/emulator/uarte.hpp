// UARTE0 (0x40002000): transmitter and receiver with EasyDMA, 8 data bits, no parity, no flow control.
//
// The transmitter passes its bytes to the host's line when the first one has been sent; the line computes the
// time of each byte. TXDRDY is raised after the first and the last byte of a transfer, not after each. A
// change of the buffer before the transfer ends fails the run. The receiver takes each byte at its own time.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <span>
#include <vector>

#include "firmware/sim/emulator/easy_dma.hpp"
#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

struct UartePins {
  std::uint32_t txd;
  std::uint32_t rxd;
};

class Uarte final : public Peripheral {
 public:
  // The line to the host, in local time. send: bytes from `t` on, which is a byte ago. cut: bytes not
  // complete by `t` are lost.
  struct Line {
    std::uint32_t bits_per_s;
    std::function<void(SimTime t, std::span<const std::uint8_t> bytes)> send;
    std::function<void(SimTime t)> cut;
  };

  Uarte(const UartePins& wired, Line line, EasyDma dma);

  // Cuts off a transfer to the host.
  void reset(SimTime t);
  // As Spim::spoil_start(), for a transmission.
  void spoil_start(SimTime t, std::uint8_t bits) noexcept;
  // A byte from the host whose stop bit ends at t.
  void receive(SimTime t, std::uint8_t byte);

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override;
  void advance(SimTime t) override;
  [[nodiscard]] bool irq() const noexcept override { return events_.irq(); }

  // Bytes from the host that were lost because the receiver was off or its FIFO full.
  [[nodiscard]] std::uint64_t lost_bytes() const noexcept { return lost_bytes_; }

 private:
  static constexpr unsigned kRxdrdy = 2;
  static constexpr unsigned kEndRx = 4;
  static constexpr unsigned kTxdrdy = 7;
  static constexpr unsigned kEndTx = 8;
  static constexpr unsigned kError = 9;
  static constexpr unsigned kRxto = 17;
  static constexpr unsigned kRxStarted = 19;
  static constexpr unsigned kTxStarted = 20;
  static constexpr unsigned kTxStopped = 22;
  static constexpr std::uint32_t kEvents = 1U << kRxdrdy | 1U << kEndRx | 1U << kTxdrdy | 1U << kEndTx |
                                           1U << kError | 1U << kRxto | 1U << kRxStarted | 1U << kTxStarted |
                                           1U << kTxStopped;

  enum class Receiver : std::uint8_t { kOff, kOn, kStopping };

  [[nodiscard]] SimTime byte_time() const noexcept;
  void check_ready(const char* task) const;
  void start_receive();
  void stop_receive(SimTime t);
  void end_receive();
  void flush_receive();
  void start_transmit(SimTime t);
  void stop_transmit(SimTime t);
  void first_transmitted();
  void transmitted();

  UartePins wired_;
  Line line_;
  EasyDma dma_;

  EventRegisters events_{kEvents, 1U << kTxdrdy};
  bool enabled_ = false;
  std::array<std::uint32_t, 4> pins_{};
  std::uint32_t baud_rate_ = 0x04000000;
  std::uint32_t shorts_ = 0;
  std::uint32_t error_source_ = 0;
  DmaRegisters buffers_;

  Receiver receiver_ = Receiver::kOff;
  bool receiving_ = false;  // into in_
  DmaBuffer in_;
  std::vector<std::uint8_t> fifo_;
  SimTime timeout_at_ = kNever;

  SimTime first_sent_at_ = kNever;  // end of the transfer's first byte
  SimTime sent_at_ = kNever;        // end of the transfer
  SimTime sending_since_ = 0;
  std::uint8_t spoiled_ = 0;  // bits of the first byte
  bool stopping_ = false;
  DmaBuffer out_;
  std::vector<std::uint8_t> sending_;
  std::uint64_t lost_bytes_ = 0;
};

}  // namespace groma::sim
