// Nodes on one medium, run in order of time.
//
//   Network network(world, MediumSettings{.loss_probability = 0.02}, seed);
//   const std::size_t tag = network.add_native({.chip = {.id = 1, .clock = {.offset_ppm = 12.0}}});
//   network.send(tag, bytes);                 // host to node, over the serial line
//   network.run_until(from_seconds(1.0));
//   network.take(tag, received);              // node to host: the bytes sent by then, with their times
//
// The same nodes, settings, seed and bytes sent at the same times give the same run for any steps of
// run_until().
#pragma once

#include <cstddef>
#include <cstdint>
#include <exception>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#include "firmware/sim/dw1000_chip.hpp"
#include "firmware/sim/medium.hpp"
#include "firmware/sim/node_clock.hpp"
#include "firmware/sim/propagation.hpp"
#include "firmware/sim/simulation_error.hpp"
#include "firmware/sim/time.hpp"
#include "firmware/sim/uart.hpp"
#include "firmware/sim/worker_pool.hpp"

namespace groma::sim {

// The speed of a native node's processor. Computation itself takes no time.
struct CpuSettings {
  double interrupt_us = 5.0;        // wake-up, and to the handler's first useful instruction
  double spi_transaction_us = 9.0;  // per transaction: 5 us in the peripheral, 130 instructions in the driver
  std::uint32_t spi_slow_hz = 2'000'000;
  std::uint32_t spi_fast_hz = 8'000'000;
};

struct NodeSpec {
  ChipSpec chip{};                       // the node's id on the medium, the DW1000's crystal and antennas
  std::optional<ClockSpec> cpu_clock{};  // nullopt: the processor shares the DW1000's crystal
  CpuSettings cpu{};
  UartSettings uart{};
  SimTime power_on = 0;
  std::vector<std::uint8_t> stored_config{};  // the configuration in flash before power-on
};

// A node as the network runs it: native firmware, a processor emulator or a test script.
class NodeHost {
 public:
  NodeHost() = default;
  NodeHost(const NodeHost&) = delete;
  NodeHost& operator=(const NodeHost&) = delete;
  virtual ~NodeHost() = default;

  [[nodiscard]] virtual Dw1000Chip& chip() noexcept = 0;
  // The serial lines to the host and from it.
  [[nodiscard]] virtual UartLine& uart_out() noexcept = 0;
  [[nodiscard]] virtual UartLine& uart_in() noexcept = 0;

  // When run() has to be called next, in addition to the chip's next_event(); kNever: not at all. Only run(),
  // set_power() and bytes on uart_in() change it.
  [[nodiscard]] virtual SimTime next_work() = 0;
  // True: other nodes' actions on a shared bus also change next_work().
  [[nodiscard]] virtual bool shares_bus() const noexcept { return false; }
  // Does the work due at `now`. The node may run ahead of `now` by the time that the work takes.
  virtual void run(SimTime now) = 0;
  // Switches the node's power. Without power it loses its volatile state.
  virtual void set_power(bool on, SimTime now) = 0;
};

class Network {
 public:
  // Keeps a reference to the propagation model.
  Network(const PropagationModel& propagation, const MediumSettings& settings, std::uint64_t seed);
  ~Network();

  // Returns the node's index. Add a node before the network's time passes its power_on.
  std::size_t add_native(const NodeSpec& spec);
  // For hosts that are built on medium(); the host's chip must be attached to it.
  std::size_t add(std::unique_ptr<NodeHost> host);

  // From now on this many threads run the nodes that have work at the same time. The run does not depend on
  // the number if every effect on another node comes later than kWindow plus the lead of the node's run()
  // after the decision; the chips count the exceptions (late_announcements()). If any node shares a bus, one
  // thread runs all nodes.
  void set_threads(unsigned threads);
  static constexpr SimTime kWindow = 10 * kUnitsPerMicrosecond;

  // Throws a SimulationError that names the node, the time and the cause.
  void run_until(SimTime t);
  [[nodiscard]] SimTime now() const noexcept { return now_; }

  // Sends bytes from the host, from now() on at the line's bit rate. False: the line's queue is full.
  bool send(std::size_t node, std::span<const std::uint8_t> bytes);
  // Appends the bytes from the node whose transmission ended by now().
  void take(std::size_t node, std::vector<TimedByte>& out);

  void set_power(std::size_t node, bool on);

  [[nodiscard]] NodeHost& node(std::size_t index) { return *nodes_[index]; }
  [[nodiscard]] std::size_t size() const noexcept { return nodes_.size(); }
  [[nodiscard]] Medium& medium() noexcept { return medium_; }

 private:
  struct Due {
    const Dw1000Chip* chip;
    SimTime work;  // the host's next_work(); not used for hosts that share a bus
    bool shares_bus;
  };

  [[nodiscard]] SimTime next_of(std::size_t node);
  void run_node(std::size_t node, SimTime now);
  void run_in_order(SimTime t);
  void run_in_windows(SimTime t);

  Medium medium_;
  std::vector<std::unique_ptr<NodeHost>> nodes_;
  std::vector<Due> due_;                 // in the order of nodes_
  std::unique_ptr<WorkerPool> workers_;  // null: a single thread runs all nodes
  bool shared_bus_ = false;
  std::vector<std::size_t> at_work_;
  std::vector<std::exception_ptr> failures_;
  SimTime now_ = 0;
};

}  // namespace groma::sim
