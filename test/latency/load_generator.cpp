#include "test/latency/load_generator.hpp"

#include <fmt/format.h>
#include <pb_decode.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <span>
#include <stdexcept>
#include <utility>

#include "host/clock/time_mapper.hpp"
#include "test/host/link/node_frames.hpp"
#include "test/support/random.hpp"

namespace groma::latency {
namespace {

constexpr double kRadius_m = 5.0;
constexpr double kOmega_radps = 0.2;
constexpr double kTagHeight_m = 0.8;
constexpr double kRangeSigma_m = 0.05;
// Reports begin after the odometry, which gives the robot's time.
constexpr double kFirstReport_s = 0.5;
constexpr std::int64_t kNsPerS = 1'000'000'000;

// On the circle that the robot drives.
Eigen::Vector3d antenna_m(const model::Tag& tag, double time_s) {
  const double yaw_rad = kOmega_radps * time_s;
  const double c = std::cos(yaw_rad);
  const double s = std::sin(yaw_rad);
  const Eigen::Vector3d& arm_m = tag.lever_arm_m;
  return {kRadius_m * s + c * arm_m.x() - s * arm_m.y(),
          kRadius_m * (1.0 - c) + s * arm_m.x() + c * arm_m.y(), arm_m.z()};
}

std::vector<model::Tag> tags() {
  std::vector<model::Tag> out;
  for (std::size_t i = 0; i < LoadGenerator::kTags; ++i) {
    const double angle = 1.5708 * static_cast<double>(i);
    out.push_back(
        {static_cast<model::NodeId>(i + 1), {0.5 * std::cos(angle), 0.4 * std::sin(angle), kTagHeight_m}});
  }
  return out;
}

// Of a tag's counter.
double device_s(std::size_t port, double time_s) {
  return 50.0 + 1000.0 * static_cast<double>(port) + time_s;
}

std::int64_t ticks(double s) {
  return std::llround(s * clock::kDeviceTicksPerSecond);
}

}  // namespace

std::int64_t now_ns() noexcept {
  timespec now{};
  ::clock_gettime(CLOCK_MONOTONIC, &now);
  return kNsPerS * now.tv_sec + now.tv_nsec;
}

void sleep_until_ns(std::int64_t at_ns) noexcept {
  const timespec at{.tv_sec = at_ns / kNsPerS, .tv_nsec = at_ns % kNsPerS};
  while (::clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, nullptr) != 0) continue;
}

LoadGenerator::LoadGenerator(std::filesystem::path folder, double duration_s)
    : folder_(std::move(folder)),
      listener_(::socket(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0)) {
  for (std::size_t i = 0; i < kTags; ++i)
    std::filesystem::create_symlink(ports_.at(i).path(), folder_ / fmt::format("tag-{}", i + 1));
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  (folder_ / "robot.sock").string().copy(address.sun_path, sizeof(address.sun_path) - 1);
  if (::bind(listener_.get(), reinterpret_cast<const sockaddr*>(&address), sizeof(address)) != 0 ||
      ::listen(listener_.get(), 1) != 0) {
    throw std::runtime_error("robot.sock");
  }
  for (std::size_t i = 0; i < kAnchors; ++i) {
    const double angle = 2.0 * 3.14159265358979 * static_cast<double>(i) / kAnchors;
    anchors_.push_back(
        {static_cast<model::NodeId>(100 + i),
         {12.0 * std::cos(angle), 5.0 + 10.0 * std::sin(angle), 1.0 + 0.7 * static_cast<double>(i % 3)}});
  }
  prepare_odometry(duration_s);
  prepare_reports(duration_s);
  std::stable_sort(events_.begin(), events_.end(),
                   [](const Event& a, const Event& b) { return a.at_s < b.at_s; });
  write_delays_s_.reserve(events_.size());
}

std::string LoadGenerator::config() {
  std::string nodes;
  std::string arms;
  for (const model::Tag& tag : tags()) {
    nodes += fmt::format("  - {{path: tag-{}}}\n", tag.id);
    arms += fmt::format("  - {{id: {}, lever_arm_m: [{}, {}, {}]}}\n", tag.id, tag.lever_arm_m.x(),
                        tag.lever_arm_m.y(), tag.lever_arm_m.z());
  }
  return fmt::format(R"(schema: 1
nodes:
{}robot_socket: robot.sock
tags:
{}odometry: {{sigma_vx_mps: 0.02, sigma_vy_mps: 0.02, sigma_omega_radps: 0.005}}
range: {{sigma_m: {}, beta_m: [0, 0.05], gamma: [1, 0.002]}}
surface: {{type: plane, z_m: 0, normal: [0, 0, 1]}}
calibration: {{file: calibration.yaml}}
)",
                     nodes, arms, kRangeSigma_m);
}

model::Calibration LoadGenerator::calibration() const {
  model::RangePriors priors;
  priors.sigma_m = kRangeSigma_m;
  priors.beta_m = {0.0, 0.05};
  model::Calibration out = model::surveyed_calibration(anchors_, tags(), priors, 0.02);
  out.verdict = model::Verdict::kUsable;
  return out;
}

void LoadGenerator::add(double at_s, std::size_t port, const auto& bytes) {
  const std::size_t begin = bytes_.size();
  bytes_.insert(bytes_.end(), bytes.begin(), bytes.end());
  events_.push_back({at_s, port, begin, bytes_.size()});
}

void LoadGenerator::prepare_odometry(double duration_s) {
  groma::test::Random random(20);
  const auto samples = static_cast<int>(duration_s * kOdometry_hz);
  for (int i = 0; i < samples; ++i) {
    const double at_s = i / kOdometry_hz;
    std::string lines = fmt::format(
        "{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{:.4f},\"vy_mps\":{:.4f},\"omega_radps\":{:.5f}}}\n",
        kRobotOrigin_s + at_s, kRadius_m * kOmega_radps + 0.02 * random.gaussian(), 0.02 * random.gaussian(),
        kOmega_radps + 0.005 * random.gaussian());
    if (i == 0) {
      lines +=
          fmt::format("{{\"class\":\"POSE_PRIOR\",\"t_s\":{},\"x_m\":0,\"y_m\":0,\"z_m\":0,\"yaw_rad\":0}}\n",
                      kRobotOrigin_s);
    }
    add(at_s, kTags, lines);
  }
  written_ns_.reserve(static_cast<std::size_t>(samples));
}

void LoadGenerator::prepare_reports(double duration_s) {
  groma::test::Random random(21);
  const std::vector<model::Tag> all = tags();
  const auto numbers = static_cast<std::uint32_t>((duration_s - kFirstReport_s) * kReports_hz);
  std::vector<groma_Range> ranges(kAnchors);
  for (std::uint32_t number = 0; number < numbers; ++number) {
    for (std::size_t port = 0; port < kTags; ++port) {
      const double at_s = kFirstReport_s + (number + static_cast<double>(port) / kTags) / kReports_hz;
      for (std::size_t i = 0; i < kAnchors; ++i) {
        const double age_s = 0.018 - 0.001 * static_cast<double>(i);
        const double range_m = (antenna_m(all[port], at_s - age_s) - anchors_[i].position_m).norm();
        ranges[i] = link::test::make_range(anchors_[i].id, range_m + kRangeSigma_m * random.gaussian(),
                                           ticks(-age_s));
      }
      const auto device_time = static_cast<std::uint64_t>(ticks(device_s(port, at_s)));
      add(at_s, port,
          link::test::frame_of(link::test::make_report(number, all[port].id, device_time, ranges)));
      ++reports_;
    }
  }
}

bool LoadGenerator::await_reader(double patience_s) {
  const std::int64_t end_ns = now_ns() + std::llround(patience_s * 1e9);
  const auto is_read = [](const simulation::PtyPort& port) { return port.listened(); };
  while (now_ns() < end_ns) {
    if (!robot_.valid())
      robot_ = io::Descriptor(::accept4(listener_.get(), nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC));
    if (robot_.valid() && std::all_of(ports_.begin(), ports_.end(), is_read)) return true;
    sleep_until_ns(now_ns() + 1'000'000);
  }
  return false;
}

void LoadGenerator::run() {
  begin_ns_ = now_ns() + 10'000'000;
  for (const Event& event : events_) {
    if (ending_) return;
    const std::int64_t at_ns = begin_ns_ + std::llround(1e9 * event.at_s);
    sleep_until_ns(at_ns);
    const std::int64_t written_ns = now_ns();
    write_delays_s_.push_back(1e-9 * static_cast<double>(written_ns - at_ns));
    if (event.port == kTags) written_ns_.push_back(written_ns);
    write(event);
    if (event.port < kTags) answer(event.port);
  }
}

void LoadGenerator::write(const Event& event) {
  const std::span bytes = std::span(bytes_).subspan(event.begin, event.end - event.begin);
  const std::size_t written = event.port < kTags
                                  ? ports_.at(event.port).write(bytes)
                                  : static_cast<std::size_t>(std::max<ssize_t>(
                                        0, ::send(robot_.get(), bytes.data(), bytes.size(), MSG_NOSIGNAL)));
  if (written < bytes.size()) ++overflows_;
}

void LoadGenerator::answer(std::size_t port) {
  std::array<std::uint8_t, 512> buffer{};
  const std::size_t size = ports_.at(port).read(buffer);
  wire::FrameDecoder& frames = requests_.at(port);
  for (const std::uint8_t byte : std::span(buffer).first(size)) {
    if (!frames.push(byte)) continue;
    const auto payload = frames.payload();
    groma_HostToNode request = groma_HostToNode_init_zero;
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    if (!pb_decode(&stream, groma_HostToNode_fields, &request) ||
        request.which_body != groma_HostToNode_time_request_tag) {
      continue;
    }
    const auto now =
        static_cast<std::uint64_t>(ticks(device_s(port, 1e-9 * static_cast<double>(now_ns() - begin_ns_))));
    groma_NodeToHost reply = groma_NodeToHost_init_zero;
    reply.which_body = groma_NodeToHost_time_reply_tag;
    reply.body.time_reply = {request.body.time_request.host_time_ns, now, now};
    const std::vector<std::uint8_t> frame = link::test::frame_of(reply);
    if (ports_.at(port).write(frame) < frame.size()) ++overflows_;
  }
}

}  // namespace groma::latency
