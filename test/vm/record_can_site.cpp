// Records a simulated site for can_gromad_test: record_can_site SCENARIO FOLDER. The demo's nodes in the
// open, each tag's stream cut into CAN frames of one bus.
//
//   classic.log, fd.log  the bus as candump writes it, in the site's time
//   robot.jsonl          the robot's lines
//   truth.csv            t_s,x_m,y_m,yaw_rad
//   calibration.yaml     of the site as surveyed
//   site.yaml            what a configuration of gromad needs beside its links
#include <fmt/format.h>
#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <filesystem>
#include <fstream>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "firmware/sim/can_bus.hpp"
#include "firmware/sim/can_log.hpp"
#include "firmware/sim/time.hpp"
#include "firmware/sim/world/scenario_file.hpp"
#include "host/io/calibration_file.hpp"
#include "host/model/calibration.hpp"
#include "host/simulation/robot_feed.hpp"
#include "host/simulation/simulated_site.hpp"
#include "proto/can_segment.hpp"
#include "proto/compact_report.hpp"
#include "proto/frame_codec.hpp"

namespace groma {
namespace {

constexpr double kDuration_s = 6.0;
constexpr double kStep_s = 0.001;
constexpr double kTruthPeriod_s = 0.02;

// The bus that all tags share, and what is heard on it.
class RecordedBus {
 public:
  RecordedBus(wire::CanFormat format, std::size_t tags) : format_(format) {
    const sim::CanRates rates{.fd = format == wire::CanFormat::kFd};
    host_ = std::make_unique<sim::CanTap>(bus_, rates);
    for (std::size_t i = 0; i < tags; ++i) controllers_.push_back(std::make_unique<sim::CanTap>(bus_, rates));
  }

  void send(std::size_t tag, model::NodeId id, std::span<const std::uint8_t> stream, sim::SimTime t) {
    while (!stream.empty()) {
      wire::CanFrame frame;
      stream = stream.subspan(wire::cut_can_payload(stream, format_, frame));
      frame.id = wire::can_id({wire::CanDirection::kToHost, id});
      controllers_.at(tag)->send(t, frame);
    }
  }

  void write(const std::filesystem::path& path, sim::SimTime until) {
    bus_.advance(until);
    if (!bus_.fault().empty()) throw std::runtime_error(bus_.fault());
    std::ofstream file(path);
    sim::write_candump(file, host_->take(until));
    fmt::print("{}: {} frames, bus busy for {:.0f} %\n", path.string(), bus_.counters().frames,
               100.0 * sim::to_seconds(bus_.counters().busy) / sim::to_seconds(until));
  }

 private:
  wire::CanFormat format_;
  sim::CanBus bus_;
  std::unique_ptr<sim::CanTap> host_;
  std::vector<std::unique_ptr<sim::CanTap>> controllers_;
};

// A tag's stream by the frame of the protocol, as its UART carries it. On classic CAN a node sends its
// reports compact.
class TagStream {
 public:
  explicit TagStream(wire::CanFormat format) : compact_(format == wire::CanFormat::kClassic) {}

  // The frames that these bytes complete.
  std::vector<std::uint8_t> take(std::span<const std::uint8_t> bytes) {
    std::vector<std::uint8_t> frames;
    for (const std::uint8_t byte : bytes) {
      if (!decoder_.push(byte)) continue;
      const std::vector<std::uint8_t> payload =
          compact_ ? compacted(decoder_.payload()) : copy(decoder_.payload());
      std::vector<std::uint8_t> frame(wire::max_encoded_size(payload.size()));
      frame.resize(wire::encode_frame(payload, frame));
      frames.insert(frames.end(), frame.begin(), frame.end());
    }
    return frames;
  }

 private:
  static std::vector<std::uint8_t> copy(std::span<const std::uint8_t> payload) {
    return {payload.begin(), payload.end()};
  }

  static std::vector<std::uint8_t> compacted(std::span<const std::uint8_t> payload) {
    groma_NodeToHost message = groma_NodeToHost_init_zero;
    pb_istream_t in = pb_istream_from_buffer(payload.data(), payload.size());
    if (!pb_decode(&in, groma_NodeToHost_fields, &message))
      throw std::runtime_error("a tag sent what is no message");
    if (message.which_body != groma_NodeToHost_slot_report_tag) return copy(payload);
    groma_NodeToHost compact = groma_NodeToHost_init_zero;
    compact.which_body = groma_NodeToHost_compact_report_tag;
    wire::compact_report(message.body.slot_report, compact.body.compact_report);
    std::vector<std::uint8_t> out(groma_NodeToHost_size);
    pb_ostream_t stream = pb_ostream_from_buffer(out.data(), out.size());
    if (!pb_encode(&stream, groma_NodeToHost_fields, &compact))
      throw std::runtime_error("a report does not fit");
    out.resize(stream.bytes_written);
    return out;
  }

  bool compact_;
  wire::FrameDecoder decoder_;
};

sim::Scenario in_the_open(sim::Scenario scenario) {
  scenario.walls.clear();
  scenario.ground = model::Surface(model::Plane(0.0, {0.0, 0.0, 1.0}));
  scenario.biases = {};
  return scenario;
}

std::string site_yaml(const sim::Scenario& scenario, const std::filesystem::path& folder) {
  std::string text = "tags:\n";
  for (const model::Tag& tag : scenario.tags) {
    text += fmt::format("  - {{id: {}, lever_arm_m: [{}, {}, {}]}}\n", tag.id, tag.lever_arm_m.x(),
                        tag.lever_arm_m.y(), tag.lever_arm_m.z());
  }
  const model::OdometryNoise& noise = scenario.odometry.noise;
  text += fmt::format("odometry: {{sigma_vx_mps: {}, sigma_vy_mps: {}, sigma_omega_radps: {}}}\n",
                      noise.sigma_vx_mps, noise.sigma_vy_mps, noise.sigma_omega_radps);
  text +=
      fmt::format("range: {{sigma_m: {}, beta_m: [0, 0.02], gamma: [1, 0.001]}}\n", scenario.range_sigma_m);
  text += "surface: {type: plane, z_m: 0, normal: [0, 0, 1]}\n";
  text += fmt::format("calibration: {{file: {}}}\n", (folder / "calibration.yaml").string());
  return text;
}

std::string surveyed(const sim::Scenario& scenario) {
  model::RangePriors priors;
  priors.sigma_m = scenario.range_sigma_m;
  priors.beta_m = {0.0, 0.02};
  priors.gamma = {1.0, 0.001};
  model::Calibration calibration = model::surveyed_calibration(scenario.anchors, scenario.tags, priors, 0.02);
  calibration.verdict = model::Verdict::kUsable;
  return io::format_calibration(calibration);
}

void record(const std::filesystem::path& scenario_file, const std::filesystem::path& folder) {
  const sim::Scenario scenario = in_the_open(sim::read_scenario(scenario_file));
  std::filesystem::create_directories(folder);
  std::ofstream(folder / "site.yaml") << site_yaml(scenario, std::filesystem::absolute(folder));
  std::ofstream(folder / "calibration.yaml") << surveyed(scenario);

  simulation::SimulatedSite site(scenario, {.seed = 1});
  simulation::RobotFeed feed(site.world().robot());
  RecordedBus classic(wire::CanFormat::kClassic, site.tag_count());
  RecordedBus fd(wire::CanFormat::kFd, site.tag_count());
  std::vector<TagStream> classic_streams(site.tag_count(), TagStream(wire::CanFormat::kClassic));
  std::vector<TagStream> fd_streams(site.tag_count(), TagStream(wire::CanFormat::kFd));
  std::string lines;
  std::vector<std::uint8_t> bytes;
  for (int step = 1; step * kStep_s <= kDuration_s; ++step) {
    const double now_s = step * kStep_s;
    site.run_until(now_s);
    feed.lines_until(now_s, lines);
    for (std::size_t i = 0; i < site.tag_count(); ++i) {
      bytes.clear();
      site.take(i, bytes);
      const sim::SimTime now = sim::from_seconds(now_s);
      classic.send(i, site.tag_id(i), classic_streams[i].take(bytes), now);
      fd.send(i, site.tag_id(i), fd_streams[i].take(bytes), now);
    }
  }
  classic.write(folder / "classic.log", sim::from_seconds(kDuration_s));
  fd.write(folder / "fd.log", sim::from_seconds(kDuration_s));
  std::ofstream(folder / "robot.jsonl") << lines;
  std::ofstream truth(folder / "truth.csv");
  truth << "t_s,x_m,y_m,yaw_rad\n";
  for (int row = 0; row * kTruthPeriod_s <= kDuration_s; ++row) {
    const model::PoseSample pose = site.world().robot().truth(row * kTruthPeriod_s);
    truth << fmt::format("{},{},{},{}\n", pose.t_s, pose.x_m, pose.y_m, pose.yaw_rad);
  }
}

}  // namespace
}  // namespace groma

int main(int argc, char** argv) {
  if (argc != 3) {
    fmt::print(stderr, "usage: record_can_site SCENARIO FOLDER\n");
    return 2;
  }
  try {
    groma::record(argv[1], argv[2]);
  } catch (const std::exception& error) {
    fmt::print(stderr, "record_can_site: {}\n", error.what());
    return EXIT_FAILURE;
  }
  return EXIT_SUCCESS;
}
