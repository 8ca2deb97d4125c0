// Many nodes on one medium, run in order of time.
//
//   Network network(world, MediumSettings{.loss_probability = 0.02}, seed);
//   const std::size_t tag = network.add_native({.chip = {.id = 1, .clock = {.offset_ppm = 12.0}}});
//   network.send(tag, bytes);                 // host to node, over the serial line
//   network.run_until(from_seconds(1.0));
//   network.take(tag, received);              // node to host: the bytes that left by then, each with its
//   time
//
// The same nodes, settings, seed and bytes sent at the same times give the same run, whatever the steps of
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

// How fast a native node's processor gets its work done. Computing itself costs nothing.
struct CpuSettings {
  double interrupt_us = 4.0;        // from the interrupt line to the first instruction of the handler's work
  double spi_transaction_us = 2.5;  // set-up, chip select and end-of-transfer interrupt of each transaction
  std::uint32_t spi_slow_hz = 2'000'000;
  std::uint32_t spi_fast_hz = 8'000'000;
};

struct NodeSpec {
  ChipSpec chip{};                       // the node's id on the medium, the DW1000's crystal, its antennas
  std::optional<ClockSpec> cpu_clock{};  // without it the processor shares the DW1000's crystal
  CpuSettings cpu{};
  UartSettings uart{};
  SimTime power_on = 0;
  std::vector<std::uint8_t> stored_config{};  // what store_config() kept in an earlier life
};

// A node as the network runs it: native firmware, a processor emulator, a test's script.
class NodeHost {
 public:
  NodeHost() = default;
  NodeHost(const NodeHost&) = delete;
  NodeHost& operator=(const NodeHost&) = delete;
  virtual ~NodeHost() = default;

  [[nodiscard]] virtual Dw1000Chip& chip() noexcept = 0;
  // To the host and from it.
  [[nodiscard]] virtual UartLine& uart_out() noexcept = 0;
  [[nodiscard]] virtual UartLine& uart_in() noexcept = 0;

  // When run() has to be called next, beside the chip's own next_event(); kNever: not at all. Changes only by
  // run(), set_power() and bytes on uart_in().
  [[nodiscard]] virtual SimTime next_work() = 0;
  // What other nodes do on a bus that they share changes it too.
  [[nodiscard]] virtual bool shares_bus() const noexcept { return false; }
  // Does what is due at `now`. May reach ahead of it by the time that the work takes.
  virtual void run(SimTime now) = 0;
  // Brown-out, and power back: volatile state is lost.
  virtual void set_power(bool on, SimTime now) = 0;
};

class Network {
 public:
  // Keeps a reference to the propagation model.
  Network(const PropagationModel& propagation, const MediumSettings& settings, std::uint64_t seed);
  ~Network();

  // The node's index. Nodes are added before time passes their power_on.
  std::size_t add_native(const NodeSpec& spec);
  // For hosts that are built on medium(); the host's chip must be attached to it.
  std::size_t add(std::unique_ptr<NodeHost> host);

  // From here on nodes that work at the same time are run by that many threads. They do the same whatever the
  // number, as long as no node acts upon another sooner than kWindow and its run's reach after it decides to:
  // the chips count where it was not so (late_announcements()). Nodes that share a bus
  // are run by one thread all the same.
  void set_threads(unsigned threads);
  static constexpr SimTime kWindow = 10 * kUnitsPerMicrosecond;

  // Throws SimulationError that names node and cause.
  void run_until(SimTime t);
  [[nodiscard]] SimTime now() const noexcept { return now_; }

  // Bytes from the host: on the line from now() on, at its bit rate. False: the line's queue is full.
  bool send(std::size_t node, std::span<const std::uint8_t> bytes);
  // Appends the bytes from the node that were through the line by now().
  void take(std::size_t node, std::vector<TimedByte>& out);

  void set_power(std::size_t node, bool on);

  [[nodiscard]] NodeHost& node(std::size_t index) { return *nodes_[index]; }
  [[nodiscard]] std::size_t size() const noexcept { return nodes_.size(); }
  [[nodiscard]] Medium& medium() noexcept { return medium_; }

 private:
  struct Due {
    const Dw1000Chip* chip;
    SimTime work;  // the host's next_work(), unless it shares a bus: that is asked each time
    bool shares_bus;
  };

  [[nodiscard]] SimTime next_of(std::size_t node);
  void run_node(std::size_t node, SimTime now);
  void run_in_order(SimTime t);
  void run_in_windows(SimTime t);

  Medium medium_;
  std::vector<std::unique_ptr<NodeHost>> nodes_;
  std::vector<Due> due_;                 // the same order
  std::unique_ptr<WorkerPool> workers_;  // without: one node after the other
  bool shared_bus_ = false;
  std::vector<std::size_t> at_work_;
  std::vector<std::exception_ptr> failures_;
  SimTime now_ = 0;
};

}  // namespace groma::sim
