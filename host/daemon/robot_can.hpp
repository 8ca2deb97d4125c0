// The robot's CAN bus as a source of odometry: frames in, JSON lines as of robot_input.hpp out.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <utility>

#include "host/daemon/can_signals.hpp"
#include "host/daemon/log_doubling.hpp"
#include "host/link/byte_link.hpp"
#include "host/link/can_socket.hpp"
#include "host/link/reconnecting_link.hpp"

namespace groma::daemon {

// An odometry sample is complete when each of its signals has come since the previous sample: it has their
// newest values and the time of the last one. So signals of different messages give samples at the rate of
// the slowest.
class CanSignalDecoder {
 public:
  struct Counters {
    std::uint64_t samples = 0;  // of odometry and IMU
    std::uint64_t bad_value =
        0;  // values beyond the bounds of the DBC file, not finite, or in frames too short
  };

  explicit CanSignalDecoder(CanSignals signals) : signals_(std::move(signals)) {}

  // A frame with this can_id of Linux that arrived at t_s (robot time). Appends the lines that it completes.
  void take(std::uint32_t id, std::span<const std::uint8_t> payload, double t_s, std::string& lines);

  [[nodiscard]] const Counters& counters() const noexcept { return counters_; }
  // What was wrong with the last bad value; empty if there was none.
  [[nodiscard]] const std::string& last_problem() const noexcept { return last_problem_; }

 private:
  void take(std::size_t quantity, const CanSignal& of, std::span<const std::uint8_t> payload);
  [[nodiscard]] bool odometry_is_complete() const noexcept;

  CanSignals signals_;
  std::array<double, kCanQuantities> values_{};  // in SI units
  std::array<bool, kCanQuantities> has_{};       // since the last sample
  Counters counters_;
  std::string last_problem_;
};

// Only for reading: what is written to it is discarded. t_s is the time of this computer's clock at which the
// kernel received a frame, in s since 1970.
class RobotCanLink : public link::ByteLink {
 public:
  RobotCanLink(std::unique_ptr<link::CanSocket> socket, CanSignals signals);

  [[nodiscard]] int poll_fd() const noexcept override { return socket_->fd(); }
  [[nodiscard]] link::ReadResult read(std::span<std::uint8_t> out) override;
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override { return bytes.size(); }
  [[nodiscard]] std::string take_news() override;
  [[nodiscard]] const link::CanCounters* can_counters() const noexcept override {
    return &socket_->counters();
  }

 private:
  std::unique_ptr<link::CanSocket> socket_;
  std::string interface_;
  CanSignalDecoder decoder_;
  std::string lines_;     // not yet read completely
  std::size_t read_ = 0;  // of lines_
  LogDoubling reported_bad_values_;
};

// "can:INTERFACE", the link's name in messages.
[[nodiscard]] std::string robot_can_name(const CanSignals& signals);
[[nodiscard]] link::OpenedLink open_robot_can(const CanSignals& signals);
[[nodiscard]] link::ReconnectingLink::Opener robot_can_opener(const CanSignals& signals);

}  // namespace groma::daemon
