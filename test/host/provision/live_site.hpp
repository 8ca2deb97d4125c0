// Simulated nodes in free space, each on a real pseudo-terminal, running in real time in a thread.
#pragma once

#include <array>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <span>
#include <string>
#include <thread>
#include <vector>

#include "firmware/sim/emulator/emulated_node.hpp"
#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/network.hpp"
#include "host/provision/site_plan.hpp"
#include "host/simulation/pty_port.hpp"
#include "test/sim/site_bench.hpp"

namespace groma::provision::test {

class LiveSite {
 public:
  // Modifies the bytes on a line; called with each chunk, in both directions.
  using Line = std::function<void(std::vector<std::uint8_t>&)>;

  // Nodes 1 (tag), 10, 11, 12 (anchors), all unconfigured. They run the image or, if null, the firmware
  // compiled for the host.
  explicit LiveSite(const sim::FirmwareImage* image = nullptr) : network_(space_, {}, 1) {
    constexpr std::array<std::uint16_t, 4> kIds{1, 10, 11, 12};
    for (const std::uint16_t id : kIds) {
      space_.put(id, {id == 1 ? 3.0 : 4.0 * (id - 10), id == 1 ? 4.0 : 0.5 * id, 1.5});
      sim::NodeSpec spec;
      spec.chip.id = id;
      const std::size_t node = image == nullptr
                                   ? network_.add_native(spec)
                                   : network_.add(sim::make_emulated_node(spec, *image, network_.medium()));
      ports_.push_back({node, std::make_unique<simulation::PtyPort>()});
    }
    thread_ = std::thread([this] { run(); });
  }
  ~LiveSite() {
    stop_ = true;
    thread_.join();
  }
  LiveSite(const LiveSite&) = delete;
  LiveSite& operator=(const LiveSite&) = delete;

  // The plan of all four nodes.
  [[nodiscard]] SitePlan plan() {
    SitePlan plan;
    SiteSettings site;
    site.network_id = 77;
    site.tag_ids = {1};
    site.anchor_ids = {10, 11, 12};
    site.master_id = 10;
    site.backup_ids = {11, 12};  // the default of a plan that names none
    for (std::size_t i = 0; i < ports_.size(); ++i) {
      PlannedNode node;
      node.id = i == 0 ? model::NodeId{1} : static_cast<model::NodeId>(9 + i);
      node.role = i == 0 ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR;
      node.port = ports_[i].pty->path();
      node.config = config_of(site, node.role, node.id);
      plan.nodes.push_back(node);
    }
    return plan;
  }

  void set_line(Line line) {
    const std::lock_guard lock(mutex_);
    line_ = std::move(line);
  }
  // Unplugs the cable of the first node.
  void unplug() {
    const std::lock_guard lock(mutex_);
    ports_.front().pty.reset();
  }

 private:
  struct Port {
    std::size_t node;
    std::unique_ptr<simulation::PtyPort> pty;
  };

  void run() {
    using Clock = std::chrono::steady_clock;
    const Clock::time_point begin = Clock::now();
    for (int steps = 1; !stop_; ++steps) {
      std::this_thread::sleep_until(begin + steps * std::chrono::milliseconds(2));
      const std::lock_guard lock(mutex_);
      for (const Port& port : ports_) {
        if (!port.pty) continue;
        std::array<std::uint8_t, 512> chunk{};
        const std::size_t size = port.pty->read(chunk);
        bytes_.assign(chunk.begin(), chunk.begin() + static_cast<std::ptrdiff_t>(size));
        if (line_) line_(bytes_);
        if (!bytes_.empty()) (void)network_.send(port.node, bytes_);
      }
      network_.run_until(sim::SimTime{steps} * 2 * sim::kUnitsPerMillisecond);
      for (const Port& port : ports_) {
        taken_.clear();
        network_.take(port.node, taken_);
        if (!port.pty) continue;
        bytes_.clear();
        for (const sim::TimedByte& byte : taken_) bytes_.push_back(byte.value);
        if (line_) line_(bytes_);
        if (!bytes_.empty()) (void)port.pty->write(bytes_);
      }
    }
  }

  sim::FreeSpace space_;
  sim::Network network_;
  std::vector<Port> ports_;
  std::mutex mutex_;
  Line line_;
  std::vector<std::uint8_t> bytes_;
  std::vector<sim::TimedByte> taken_;
  std::atomic<bool> stop_ = false;
  std::thread thread_;
};

}  // namespace groma::provision::test
