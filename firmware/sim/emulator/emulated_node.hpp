// A node on the medium that runs the shipped image in the processor emulator.
//
//   const FirmwareImage image = read_firmware_image("build/dwm1001/groma-node.hex");
//   network.add(make_emulated_node({.chip = {.id = 1}}, image, network.medium()));
//
// The processor may run ahead of the network by a quantum. Its actions still have their exact times, so
// timestamps and bytes do not depend on the quantum. In its NodeSpec, `cpu` has no effect, and the image has
// to send at `uart.bits_per_s`.
#pragma once

#include <cstdint>
#include <memory>
#include <span>

#include "firmware/sim/emulator/board_wiring.hpp"
#include "firmware/sim/emulator/cortex_m4.hpp"
#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/emulator/nrf52832.hpp"
#include "firmware/sim/emulator/silicon.hpp"
#include "firmware/sim/network.hpp"

namespace groma::sim {

struct EmulatorOptions {
  // Must be below both the look-ahead of the medium (dw1000_chip.hpp) and the delay of the host's bytes.
  SimTime quantum = 40 * kUnitsPerMicrosecond;
  CpuTiming timing{};
  SiliconQuirks silicon{};
  SimTime spi_overhead = kSpiOverhead;
  // The CAN controller, in world time; it must outlive the node.
  SpiDevice* can = nullptr;
  BoardWiring board = kDwm1001;  // the one that the image is for
};

// Totals since the first power-on.
struct EmulatorUsage {
  double powered_s = 0.0;
  double cpu_load = 0.0;  // share of powered_s without sleep, flash stalls and resets
  double radio_spi_s = 0.0;
  double can_spi_s = 0.0;
  std::uint64_t radio_transfers = 0;
  std::uint64_t instructions = 0;
  std::uint64_t interrupts = 0;  // with other exceptions
  std::uint64_t resets = 0;
};

class EmulatedNode final : public NodeHost {
 public:
  // Attaches itself to the medium; unpowered until spec.power_on. spec.stored_config is placed in the flash's
  // last two pages as the firmware would store it. Throws SimulationError for a quantum that is too long or a
  // configuration that does not fit.
  EmulatedNode(const NodeSpec& spec, const FirmwareImage& image, Medium& medium,
               const EmulatorOptions& options);
  ~EmulatedNode() override;

  [[nodiscard]] Dw1000Chip& chip() noexcept override;
  [[nodiscard]] UartLine& uart_out() noexcept override;
  [[nodiscard]] UartLine& uart_in() noexcept override;
  [[nodiscard]] SimTime next_work() override;
  [[nodiscard]] bool shares_bus() const noexcept override;
  void run(SimTime now) override;
  void set_power(bool on, SimTime now) override;

  // The reset pin is pulled low and released.
  void press_reset(SimTime now);

  // For fault injection in tests. Change registers and memory only between runs of the network.
  [[nodiscard]] CortexM4& cpu() noexcept;
  [[nodiscard]] const Nrf52832& soc() const noexcept;
  [[nodiscard]] std::span<std::uint8_t> flash() noexcept;  // after a change call cpu().flash_changed()
  [[nodiscard]] std::span<std::uint8_t> ram() noexcept;

  // Up to `now`, the network's time.
  [[nodiscard]] EmulatorUsage usage(SimTime now) const;

 private:
  class Machine;
  std::unique_ptr<Machine> machine_;
};

[[nodiscard]] std::unique_ptr<EmulatedNode> make_emulated_node(const NodeSpec& spec,
                                                               const FirmwareImage& image, Medium& medium,
                                                               const EmulatorOptions& options = {});

}  // namespace groma::sim
