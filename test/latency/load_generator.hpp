// A robot and its tags as gromad sees them, at a given load: serial ports with 2,280 ranges a second, and a
// socket with odometry at 100 Hz. All bytes are prepared, so that to write them takes little time.
#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "host/io/descriptor.hpp"
#include "host/model/calibration.hpp"
#include "host/model/types.hpp"
#include "host/simulation/pty_port.hpp"
#include "proto/frame_codec.hpp"

namespace groma::latency {

class LoadGenerator {
 public:
  static constexpr std::size_t kTags = 4;
  static constexpr std::size_t kAnchors = 12;
  static constexpr double kReports_hz = 47.5;  // of each tag, with a range to each anchor
  static constexpr double kOdometry_hz = 100.0;
  static constexpr double kRanges_hz = kTags * kAnchors * kReports_hz;
  static constexpr double kRobotOrigin_s = 5000.0;  // t_s of the first odometry sample

  // Prepares a drive of that duration. The ports are FOLDER/tag-1 and so on, the socket is FOLDER/robot.sock.
  LoadGenerator(std::filesystem::path folder, double duration_s);

  // gromad's configuration without pose_stream and log, and the calibration.yaml that it names.
  [[nodiscard]] static std::string config();
  [[nodiscard]] model::Calibration calibration() const;

  // Waits for gromad at each port and at the socket; false after patience_s.
  [[nodiscard]] bool await_reader(double patience_s);
  // Writes everything at its time, from now on, until stop() is called.
  void run();
  void stop() noexcept { ending_ = true; }

  // When the last byte of each odometry sample was written (CLOCK_MONOTONIC, ns); complete after run().
  [[nodiscard]] const std::vector<std::int64_t>& odometry_written_ns() const noexcept { return written_ns_; }
  // Of each write against its time, s.
  [[nodiscard]] const std::vector<double>& write_delays_s() const noexcept { return write_delays_s_; }
  [[nodiscard]] std::uint64_t reports() const noexcept { return reports_; }
  // Writes that a port or the socket had no room for.
  [[nodiscard]] std::uint64_t overflows() const noexcept { return overflows_; }

 private:
  struct Event {
    double at_s = 0.0;     // since the begin
    std::size_t port = 0;  // of ports_; kTags: the robot
    std::size_t begin = 0;
    std::size_t end = 0;  // of bytes_
  };

  void prepare_odometry(double duration_s);
  void prepare_reports(double duration_s);
  void add(double at_s, std::size_t port, const auto& bytes);
  void write(const Event& event);
  // Answers requests for a node's time, as nodes do.
  void answer(std::size_t port);

  std::filesystem::path folder_;
  std::array<simulation::PtyPort, kTags> ports_;
  std::array<wire::FrameDecoder, kTags> requests_;
  io::Descriptor listener_;
  io::Descriptor robot_;
  std::vector<model::Anchor> anchors_;
  std::vector<std::uint8_t> bytes_;
  std::vector<Event> events_;
  std::atomic<bool> ending_{false};
  std::int64_t begin_ns_ = 0;
  std::vector<std::int64_t> written_ns_;
  std::vector<double> write_delays_s_;
  std::uint64_t reports_ = 0;
  std::uint64_t overflows_ = 0;
};

// CLOCK_MONOTONIC.
[[nodiscard]] std::int64_t now_ns() noexcept;
void sleep_until_ns(std::int64_t at_ns) noexcept;

}  // namespace groma::latency
