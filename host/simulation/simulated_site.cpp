#include "host/simulation/simulated_site.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <thread>

#include "firmware/core/node/config.hpp"
#include "firmware/sim/keyed_random.hpp"
#include "groma.pb.h"
#include "host/provision/node_config.hpp"

namespace groma::simulation {

namespace {

enum Purpose : std::uint64_t { kWorld, kMedium, kNodes };
enum NodeDraw : std::uint64_t { kClockOffset, kFirstTick, kPowerOn };

constexpr std::uint16_t kNetworkId = 0x4752;
constexpr double kLatestPowerOn_s = 0.5;
constexpr std::uint64_t kCounterMask = (1ULL << 40) - 1;

provision::SiteSettings settings_of(const sim::Scenario& scenario) {
  provision::SiteSettings settings;
  settings.network_id = kNetworkId;
  settings.preamble_symbols = scenario.schedule.preamble;
  const sim::ChipSpec chip;
  settings.transmit_antenna_delay_dtu = chip.transmit_antenna_delay_ticks;
  settings.receive_antenna_delay_dtu = chip.receive_antenna_delay_ticks;
  settings.master_id = scenario.schedule.master_id;
  for (const model::Tag& tag : scenario.tags) settings.tag_ids.push_back(tag.id);
  for (const model::Anchor& anchor : scenario.anchors) settings.anchor_ids.push_back(anchor.id);
  settings.backup_ids = scenario.schedule.backup_ids.value_or(provision::first_backups(settings));
  settings.method = scenario.schedule.method == sim::ScheduleOptions::Method::kFinal
                        ? groma_RangingMethod_METHOD_DS_FINAL
                        : groma_RangingMethod_METHOD_DS_NEXT_POLL;
  settings.turn_round_us = scenario.schedule.turn_round_us;
  settings.response_gap_us = scenario.schedule.response_gap_us;
  settings.guard_us = scenario.schedule.guard_us;
  settings.arm_ahead = scenario.schedule.arm_ahead;
  return settings;
}

sim::NodeSpec spec_of(const sim::Scenario& scenario, const groma_Config& config,
                      const sim::KeyedRandom& random) {
  if (const char* fault = node::fault_of(config); *fault != '\0') {
    throw sim::SimulationError(fmt::format("node {} rejects its configuration: {}", config.id, fault));
  }
  sim::NodeSpec spec;
  spec.chip.id = static_cast<std::uint16_t>(config.id);
  spec.chip.clock.offset_ppm =
      random.of(kClockOffset).uniform(-scenario.radio.clock_ppm, scenario.radio.clock_ppm);
  spec.chip.quirks.delayed_transmit_gain_ppm = scenario.radio.delayed_transmit_gain_ppm;
  spec.chip.clock.first_tick = random.of(kFirstTick).bits() & kCounterMask;
  spec.power_on = sim::from_seconds(random.of(kPowerOn).uniform(0.0, kLatestPowerOn_s));
  spec.uart.bits_per_s = scenario.link.bit_per_s;
  std::array<std::uint8_t, node::kMaxConfigBytes> stored{};
  const std::size_t size = node::encode_config(config, stored);
  spec.stored_config.assign(stored.begin(), stored.begin() + static_cast<std::ptrdiff_t>(size));
  return spec;
}

sim::MediumSettings medium_settings(const sim::RadioOptions& radio) {
  sim::MediumSettings settings;
  settings.timestamp_noise_s = radio.timestamp_sigma_ns * 1e-9;
  settings.loss_probability = radio.loss;
  return settings;
}

}  // namespace

SimulatedSite::SimulatedSite(const sim::Scenario& scenario, const SiteOptions& options)
    : world_(scenario, sim::KeyedRandom(options.seed).of(kWorld).bits()),
      network_(world_, medium_settings(scenario.radio), sim::KeyedRandom(options.seed).of(kMedium).bits()) {
  const sim::KeyedRandom nodes = sim::KeyedRandom(options.seed).of(kNodes);
  const provision::SiteSettings settings = settings_of(scenario);
  if (options.image) network_.set_threads(std::max(1U, std::thread::hardware_concurrency()));
  const auto add = [&](groma_Role role, model::NodeId id) {
    sim::NodeSpec spec = spec_of(scenario, provision::config_of(settings, role, id), nodes.of(id));
    if (options.unconfigured) spec.stored_config.clear();
    if (options.make_node) return network_.add(options.make_node(spec, network_.medium()));
    if (!options.image) return network_.add_native(spec);
    return network_.add(sim::make_emulated_node(spec, *options.image, network_.medium(), options.emulator));
  };
  std::vector<Port> of_anchors;
  for (const model::Anchor& anchor : scenario.anchors) {
    of_anchors.push_back({fmt::format("anchor-{}", anchor.id), add(groma_Role_ROLE_ANCHOR, anchor.id)});
  }
  for (const model::Tag& tag : scenario.tags) {
    ports_.push_back({fmt::format("tag-{}", tag.id), add(groma_Role_ROLE_TAG, tag.id)});
  }
  if (options.unconfigured) ports_.insert(ports_.end(), of_anchors.begin(), of_anchors.end());
}

void SimulatedSite::run_until(double t_s) {
  network_.run_until(sim::from_seconds(t_s));
}

void SimulatedSite::take(std::size_t port, std::vector<std::uint8_t>& bytes) {
  taken_.clear();
  network_.take(ports_.at(port).node, taken_);
  for (const sim::TimedByte& byte : taken_) bytes.push_back(byte.value);
}

bool SimulatedSite::send(std::size_t port, std::span<const std::uint8_t> bytes) {
  return network_.send(ports_.at(port).node, bytes);
}

}  // namespace groma::simulation
