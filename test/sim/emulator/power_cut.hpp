// The power fails while a configuration received over the UART is written to flash. At any instant the node
// comes back with the whole old or the whole new configuration.
#pragma once

#include <gtest/gtest.h>

#include <array>
#include <iostream>
#include <set>

#include "firmware/core/storage/config_store.hpp"
#include "firmware/core/storage/counter.hpp"
#include "test/sim/emulator/emulated_site.hpp"

namespace groma::sim {

inline constexpr std::uint32_t kOldDelay = 16'400;
inline constexpr std::uint32_t kNewDelay = 16'500;
inline constexpr double kBooted_s = 0.4;

struct CutPlan {
  bool page_full = false;  // so that the new configuration goes to the other page
  int anchors = 3;         // in the configuration
  std::vector<double> after_us = {0.0, 100.0, 200.0, 360.0, 45'000.0};  // after each operation's start
};

inline groma_Config config_with(std::uint32_t antenna_delay, int anchors) {
  groma_Config config = SiteBench({.tags = 1, .anchors = anchors}).config_of(1, groma_Role_ROLE_TAG);
  config.transmit_antenna_delay_dtu = antenna_delay;
  return config;
}

inline std::vector<std::uint8_t> blob_of(const groma_Config& config) {
  std::array<std::uint8_t, node::kMaxConfigBytes> blob{};
  const std::size_t size = node::encode_config(config, blob);
  return {blob.begin(), blob.begin() + static_cast<std::ptrdiff_t>(size)};
}

// The storage pages in a node's flash.
struct Pages {
  std::span<std::uint8_t> bytes;
  std::uint64_t erases = 0;

  bool erase(std::size_t page) noexcept {
    ++erases;
    std::fill_n(bytes.begin() + static_cast<std::ptrdiff_t>(page * storage::kPageBytes), storage::kPageBytes,
                std::uint8_t{0xFF});
    return true;
  }
  bool write(std::uint32_t offset, std::uint32_t word) noexcept {
    for (unsigned i = 0; i < 4; ++i) bytes[offset + i] &= static_cast<std::uint8_t>(word >> (8 * i));
    return true;
  }
  [[nodiscard]] std::uint32_t read(std::uint32_t offset) const noexcept {
    std::uint32_t word = 0;
    for (unsigned i = 0; i < 4; ++i) word |= static_cast<std::uint32_t>(bytes[offset + i]) << (8 * i);
    return word;
  }
};

// A tag with the old configuration that searches for a network and has received the new configuration.
struct ReconfiguredNode {
  explicit ReconfiguredNode(const CutPlan& plan) : anchors(plan.anchors) {
    const groma_Config old_config = config_with(kOldDelay, anchors);
    groma_Config other_config = old_config;
    other_config.transmit_antenna_delay_dtu = kOldDelay + 1;
    groma_Config new_config = old_config;
    new_config.transmit_antenna_delay_dtu = kNewDelay;
    space.put(1, {});
    NodeSpec spec;
    spec.chip.id = 1;
    auto owned = make_emulated_node(spec, shipped(), network.medium());
    Pages pages{owned->flash().subspan(kFlashBytes - storage::kPages * storage::kPageBytes)};
    storage::ConfigStore store(pages);
    EXPECT_TRUE(store.store(blob_of(old_config)));
    // Fills the page until it has room for the boot's count, but not for another configuration.
    for (std::uint32_t i = 0; plan.page_full; ++i) {
      std::vector<std::uint8_t> copy(pages.bytes.begin(), pages.bytes.end());
      Pages trial{copy};
      EXPECT_EQ(storage::Counter(trial).open_block(), 1U);
      const std::uint64_t erases_of_boot = trial.erases;
      EXPECT_TRUE(storage::ConfigStore(trial).store(blob_of(new_config)));
      if (erases_of_boot == 0 && trial.erases > 0) break;
      EXPECT_TRUE(store.store(blob_of(i % 2 == 0 ? other_config : old_config)));
    }
    node = owned.get();
    network.add(std::move(owned));
    network.run_until(from_seconds(kBooted_s));
    operations_of_boot = node->soc().nvmc().operations();
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = 1;
    command.which_body = groma_HostToNode_write_config_tag;
    command.body.write_config = new_config;
    EXPECT_TRUE(network.send(0, frame_of(command)));
  }

  // Flash operations since the command.
  [[nodiscard]] std::uint64_t operations() const {
    return node->soc().nvmc().operations() - operations_of_boot;
  }

  // Runs until that many flash operations have begun.
  void run_to_operation(std::uint64_t number) {
    while (operations() < number && to_seconds(network.now()) < kBooted_s + 1.0)
      network.run_until(network.now() + 10 * kUnitsPerMicrosecond);
  }

  // The antenna delay in the node's configuration after a power cut now; 0: no configuration.
  std::uint32_t delay_after_power_cut() {
    network.set_power(0, false);
    network.run_until(network.now() + from_seconds(0.1));
    network.set_power(0, true);
    std::vector<TimedByte> bytes;
    network.take(0, bytes);
    network.run_until(network.now() + from_seconds(kBooted_s));
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = 2;
    command.which_body = groma_HostToNode_read_config_tag;
    EXPECT_TRUE(network.send(0, frame_of(command)));
    network.run_until(network.now() + from_seconds(0.1));
    bytes.clear();
    network.take(0, bytes);
    Listener listener;
    listener.take(bytes);
    if (listener.replies.empty() || !listener.replies.back().has_config) return 0;
    EXPECT_EQ(listener.replies.back().config.role, groma_Role_ROLE_TAG);
    EXPECT_EQ(listener.replies.back().config.schedule.anchor_ids_count, anchors);
    return listener.replies.back().config.transmit_antenna_delay_dtu;
  }

  int anchors;
  FreeSpace space;
  Network network{space, {}, 1};
  EmulatedNode* node = nullptr;
  std::uint64_t operations_of_boot = 0;
};

// Cuts the power in each flash operation of the change of configuration.
inline void cut_power_everywhere(const CutPlan& plan) {
  GROMA_NEEDS_SHIPPED_IMAGE();
  ReconfiguredNode whole(plan);
  whole.network.run_until(from_seconds(kBooted_s + 1.0));
  const std::uint64_t operations = whole.operations();
  ASSERT_GT(operations, 10U);
  const std::uint32_t old_delay = [&] {
    ReconfiguredNode untouched(plan);
    return untouched.delay_after_power_cut();
  }();
  EXPECT_TRUE(old_delay == kOldDelay || old_delay == kOldDelay + 1) << old_delay;
  ASSERT_EQ(whole.delay_after_power_cut(), kNewDelay);

  std::set<std::uint32_t> seen;
  bool new_in_force = false;
  int cuts = 0;
  for (std::uint64_t operation = 1; operation <= operations; ++operation) {
    for (const double after_us : plan.after_us) {
      ReconfiguredNode site(plan);
      site.run_to_operation(operation);
      ASSERT_EQ(site.operations(), operation);
      const bool erases = site.node->soc().nvmc().next_event() - site.network.now() > kUnitsPerMillisecond;
      if (after_us > 400.0 && !erases) continue;
      site.network.run_until(site.network.now() + from_seconds(after_us * 1e-6));
      const std::uint32_t delay = site.delay_after_power_cut();
      ++cuts;
      EXPECT_TRUE(delay == old_delay || delay == kNewDelay)
          << "operation " << operation << " after " << after_us << " us: " << delay;
      // Once the new one is in force it stays.
      if (delay == kNewDelay) new_in_force = true;
      EXPECT_TRUE(!new_in_force || delay == kNewDelay) << "operation " << operation;
      seen.insert(delay);
    }
  }
  std::cout << operations << " operations of the flash, " << cuts << " power cuts, "
            << (seen.contains(kNewDelay) ? "old and new" : "old") << " configuration seen\n";
  EXPECT_TRUE(seen.contains(old_delay));
  EXPECT_TRUE(seen.contains(kNewDelay));
}

}  // namespace groma::sim
