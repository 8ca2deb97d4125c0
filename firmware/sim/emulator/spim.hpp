// SPIM1 (0x40004000) and SPIM2 (0x40023000): an SPI master with EasyDMA.
//
// A transfer takes bytes x 8 / f plus an overhead. It takes effect on the device and in RAM at its end. The
// chip select is a GPIO; only one transfer per chip-select window is modelled, as all drivers here use it.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <vector>

#include "firmware/sim/emulator/easy_dma.hpp"
#include "firmware/sim/emulator/peripheral.hpp"

namespace groma::sim {

struct SpimPins {
  std::uint32_t sck;
  std::uint32_t mosi;
  std::uint32_t miso;
};

class Spim final : public Peripheral {
 public:
  // Makes the transfer with the selected device; `end` is local time. False: no device is selected.
  using Exchange = std::function<bool(SimTime end, std::span<const std::uint8_t> mosi,
                                      std::span<std::uint8_t> miso, std::uint32_t hz)>;

  // `wired`: the pins that lead to the device; a transfer over others fails the run. `overhead`: from START
  // to the first clock edge plus from the last edge to END.
  Spim(std::string name, const SpimPins& wired, EasyDma dma, SimTime overhead, Exchange exchange);

  void reset();
  [[nodiscard]] bool busy() const noexcept { return end_at_ != kNever; }
  // The processor falls asleep at t: if a transfer has just started, these bits of its first byte are
  // inverted.
  void spoil_start(SimTime t, std::uint8_t bits) noexcept;
  // Total duration and number of transfers since construction.
  [[nodiscard]] SimTime busy_time() const noexcept { return busy_time_; }
  [[nodiscard]] std::uint64_t transfers() const noexcept { return transfers_; }

  [[nodiscard]] std::optional<std::uint32_t> read(SimTime t, std::uint32_t offset) override;
  [[nodiscard]] bool write(SimTime t, std::uint32_t offset, std::uint32_t value) override;
  [[nodiscard]] SimTime next_event() const noexcept override { return end_at_; }
  void advance(SimTime t) override;
  [[nodiscard]] bool irq() const noexcept override { return events_.irq(); }

 private:
  static constexpr unsigned kStopped = 1;
  static constexpr unsigned kEndRx = 4;
  static constexpr unsigned kEnd = 6;
  static constexpr unsigned kEndTx = 8;
  static constexpr unsigned kStarted = 19;
  static constexpr std::uint32_t kEvents =
      1U << kStopped | 1U << kEndRx | 1U << kEnd | 1U << kEndTx | 1U << kStarted;

  void start(SimTime t);
  [[nodiscard]] std::uint32_t clock_hz() const;

  std::string name_;
  std::string receive_name_;
  std::string transmit_name_;
  SpimPins wired_;
  EasyDma dma_;
  SimTime overhead_;
  Exchange exchange_;

  EventRegisters events_{kEvents};
  bool enabled_ = false;
  std::array<std::uint32_t, 3> pins_{};
  std::uint32_t frequency_ = 0x04000000;
  std::uint32_t over_read_ = 0;
  DmaRegisters buffers_;

  SimTime started_at_ = 0;
  SimTime end_at_ = kNever;
  std::uint8_t spoiled_ = 0;  // bits of the first byte
  DmaBuffer receiving_;
  DmaBuffer sending_;
  std::vector<std::uint8_t> mosi_;
  std::vector<std::uint8_t> miso_;
  SimTime busy_time_ = 0;
  std::uint64_t transfers_ = 0;
};

}  // namespace groma::sim
