// Records a simulated site for can_gromad_test: record_can_site SCENARIO IMAGE FOLDER. The scenario's tags
// run the shipped image, each with an MCP2518FD on one bus; its anchors run natively; the site has no walls.
//
// - classic.log, fd.log: the bus in candump's format, in the site's time
// - bus_off.log: the same with CAN FD; for a while each frame is destroyed, until the controllers go bus-off
// - robot.jsonl: the robot's lines
// - truth.csv: t_s,x_m,y_m,yaw_rad
// - calibration.yaml: the surveyed positions
// - site.yaml: a configuration of gromad without its links
#include <fmt/format.h>

#include <algorithm>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "firmware/core/node/config.hpp"
#include "firmware/sim/can_bus.hpp"
#include "firmware/sim/can_log.hpp"
#include "firmware/sim/emulator/emulated_node.hpp"
#include "firmware/sim/mcp2518fd_chip.hpp"
#include "firmware/sim/native_node.hpp"
#include "firmware/sim/time.hpp"
#include "firmware/sim/world/scenario_file.hpp"
#include "host/io/calibration_file.hpp"
#include "host/model/calibration.hpp"
#include "host/simulation/robot_feed.hpp"
#include "host/simulation/simulated_site.hpp"
#include "proto/can_segment.hpp"
#include "test/sim/site_bench.hpp"

namespace groma {
namespace {

constexpr double kDuration_s = 6.0;
constexpr double kDamageBegin_s = 3.0;
constexpr double kDamageEnd_s = 3.4;
constexpr double kTruthPeriod_s = 0.02;
constexpr double kBetaSigma_m = 0.02;
constexpr double kGammaSigma = 0.001;

sim::Scenario in_the_open(sim::Scenario scenario) {
  scenario.walls.clear();
  scenario.ground = model::Surface(model::Plane(0.0, {0.0, 0.0, 1.0}));
  scenario.biases = {};
  return scenario;
}

// The scenario's tags on one bus, and a host's controller that listens.
class SiteOnCan {
 public:
  SiteOnCan(const sim::Scenario& scenario, const sim::FirmwareImage& image, groma_Link link)
      : tap_(bus_, {}), tags_(scenario.tags.size()) {
    simulation::SiteOptions options;
    options.make_node = [&, link](const sim::NodeSpec& spec,
                                  sim::Medium& medium) -> std::unique_ptr<sim::NodeHost> {
      const bool is_tag = std::any_of(scenario.tags.begin(), scenario.tags.end(),
                                      [&](const model::Tag& tag) { return tag.id == spec.chip.id; });
      if (!is_tag) return sim::make_native_node(spec, medium);
      controllers_.push_back(std::make_unique<sim::Mcp2518fdChip>(bus_, sim::Mcp2518fdSpec{}));
      controllers_.back()->set_power(true, 0);
      return sim::make_emulated_node(on_link(spec, link), image, medium, {.can = controllers_.back().get()});
    };
    site_ = std::make_unique<simulation::SimulatedSite>(scenario, options);
  }

  void damage() { bus_.damage(sim::from_seconds(kDamageBegin_s), sim::from_seconds(kDamageEnd_s)); }

  // Throws if the recording is unusable: a faulty controller, or a tag with too few ranges.
  void write_log(const std::filesystem::path& path) {
    site_->run_until(kDuration_s);
    const sim::SimTime end = sim::from_seconds(kDuration_s);
    bus_.advance(end);
    std::string fault = bus_.fault();
    for (const auto& controller : controllers_) fault += controller->fault();
    if (!fault.empty()) throw std::runtime_error(fault);
    const std::vector<sim::TimedCanFrame> frames = tap_.take(end);
    expect_ranges(frames);
    std::ofstream file(path);
    sim::write_candump(file, frames);
    if (!file.flush()) throw std::runtime_error(path.string() + ": not written");
    fmt::print("{}: {} frames and {} damaged, bus busy for {:.0f} % of the time\n", path.string(),
               bus_.counters().frames, bus_.counters().errors,
               100.0 * sim::to_seconds(bus_.counters().busy) / kDuration_s);
  }

  [[nodiscard]] const sim::Robot& robot() const { return site_->world().robot(); }

 private:
  void expect_ranges(std::span<const sim::TimedCanFrame> frames) const {
    constexpr int kLeast = static_cast<int>(kDuration_s * 250.0);  // of some 570 a second
    std::map<std::uint16_t, sim::Listener> heard;
    for (const sim::TimedCanFrame& timed : frames) {
      const auto address = wire::can_address(timed.frame.id);
      if (!address) throw std::runtime_error("a frame of another protocol");
      std::vector<sim::TimedByte> bytes;
      for (const std::uint8_t byte : timed.frame.payload()) bytes.push_back({timed.t, byte});
      heard[address->node].take(bytes);
    }
    if (heard.size() != tags_) throw std::runtime_error(fmt::format("{} tags reported", heard.size()));
    for (const auto& [tag, listener] : heard) {
      int good = 0;
      for (const sim::Listener::Report& report : listener.reports) {
        const std::span ranges = std::span(report.body.ranges).first(report.body.ranges_count);
        good += static_cast<int>(std::count_if(ranges.begin(), ranges.end(), [](const groma_Range& range) {
          return range.status == groma_RangeStatus_RANGE_OK;
        }));
      }
      if (good < kLeast)
        throw std::runtime_error(fmt::format("tag {}: {} ranges, not {}", tag, good, kLeast));
    }
  }

  static sim::NodeSpec on_link(sim::NodeSpec spec, groma_Link link) {
    auto config = node::decode_config(spec.stored_config);
    if (!config) throw std::runtime_error("a tag has no configuration");
    config->link = link;
    spec.stored_config.resize(node::kMaxConfigBytes);
    spec.stored_config.resize(node::encode_config(*config, spec.stored_config));
    return spec;
  }

  sim::CanBus bus_;
  sim::CanTap tap_;
  std::size_t tags_;
  std::vector<std::unique_ptr<sim::Mcp2518fdChip>> controllers_;
  std::unique_ptr<simulation::SimulatedSite> site_;
};

std::string site_yaml(const sim::Scenario& scenario, const std::filesystem::path& folder) {
  std::string text = "tags:\n";
  for (const model::Tag& tag : scenario.tags) {
    text += fmt::format("  - {{id: {}, lever_arm_m: [{}, {}, {}]}}\n", tag.id, tag.lever_arm_m.x(),
                        tag.lever_arm_m.y(), tag.lever_arm_m.z());
  }
  const model::OdometryNoise& noise = scenario.odometry.noise;
  text += fmt::format("odometry: {{sigma_vx_mps: {}, sigma_vy_mps: {}, sigma_omega_radps: {}}}\n",
                      noise.sigma_vx_mps, noise.sigma_vy_mps, noise.sigma_omega_radps);
  text += fmt::format("range: {{sigma_m: {}, beta_m: [0, {}], gamma: [1, {}]}}\n", scenario.range_sigma_m,
                      kBetaSigma_m, kGammaSigma);
  text += "surface: {type: plane, z_m: 0, normal: [0, 0, 1]}\n";
  text += fmt::format("calibration: {{file: {}}}\n", (folder / "calibration.yaml").string());
  return text;
}

std::string surveyed(const sim::Scenario& scenario) {
  const model::RangePriors priors{scenario.range_sigma_m, {0.0, kBetaSigma_m}, {1.0, kGammaSigma}};
  model::Calibration calibration = model::surveyed_calibration(scenario.anchors, scenario.tags, priors, 0.02);
  calibration.verdict = model::Verdict::kUsable;
  return io::format_calibration(calibration);
}

void write_robot(const sim::Robot& robot, const std::filesystem::path& folder) {
  std::string lines;
  simulation::RobotFeed(robot).lines_until(kDuration_s, lines);
  std::ofstream(folder / "robot.jsonl") << lines;
  std::ofstream truth(folder / "truth.csv");
  truth << "t_s,x_m,y_m,yaw_rad\n";
  for (int row = 0; row * kTruthPeriod_s <= kDuration_s; ++row) {
    const model::PoseSample pose = robot.truth(row * kTruthPeriod_s);
    truth << fmt::format("{},{},{},{}\n", pose.t_s, pose.x_m, pose.y_m, pose.yaw_rad);
  }
}

void record(const std::filesystem::path& scenario_file, const std::filesystem::path& image_file,
            const std::filesystem::path& folder) {
  const sim::Scenario scenario = in_the_open(sim::read_scenario(scenario_file));
  const sim::FirmwareImage image = sim::read_firmware_image(image_file);
  std::filesystem::create_directories(folder);
  std::ofstream(folder / "site.yaml") << site_yaml(scenario, std::filesystem::absolute(folder));
  std::ofstream(folder / "calibration.yaml") << surveyed(scenario);
  SiteOnCan classic(scenario, image, groma_Link_LINK_CAN);
  classic.write_log(folder / "classic.log");
  write_robot(classic.robot(), folder);
  SiteOnCan(scenario, image, groma_Link_LINK_CAN_FD).write_log(folder / "fd.log");
  SiteOnCan damaged(scenario, image, groma_Link_LINK_CAN_FD);
  damaged.damage();
  damaged.write_log(folder / "bus_off.log");
}

}  // namespace
}  // namespace groma

int main(int argc, char** argv) {
  if (argc != 4) {
    fmt::print(stderr, "usage: record_can_site SCENARIO IMAGE.hex FOLDER\n");
    return 2;
  }
  constexpr int kSkipped = 77;
  if (!std::filesystem::exists(argv[2]) && std::getenv("GROMA_REQUIRE_IMAGE") == nullptr) {
    fmt::print(stderr,
               "no {}: run scripts/setup firmware, cmake --preset dwm1001, cmake --build --preset dwm1001\n",
               argv[2]);
    return kSkipped;
  }
  try {
    groma::record(argv[1], argv[2], argv[3]);
  } catch (const std::exception& error) {
    fmt::print(stderr, "record_can_site: {}\n", error.what());
    return EXIT_FAILURE;
  }
  return EXIT_SUCCESS;
}
