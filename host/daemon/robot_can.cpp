#include "host/daemon/robot_can.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <iterator>
#include <utility>
#include <vector>

namespace groma::daemon {
namespace {

// The value is within the bounds of the DBC file, up to half a step.
bool is_within_bounds(const io::DbcSignal& signal, double value) noexcept {
  const double slack = 0.5 * std::abs(signal.factor);
  return !signal.has_bounds() || (value >= signal.min - slack && value <= signal.max + slack);
}

// One for each message that has a signal.
std::vector<can_filter> filters_of(const CanSignals& signals) {
  std::vector<can_filter> filters;
  for (const auto& of : signals.used) {
    if (!of) continue;
    const canid_t mask = (of->id & CAN_EFF_FLAG) != 0 ? CAN_EFF_MASK : CAN_SFF_MASK;
    filters.push_back({.can_id = of->id, .can_mask = mask | CAN_EFF_FLAG | CAN_RTR_FLAG});
  }
  return filters;
}

}  // namespace

void CanSignalDecoder::take(std::uint32_t id, std::span<const std::uint8_t> payload, double t_s,
                            std::string& lines) {
  for (std::size_t i = 0; i < kCanQuantities; ++i) {
    const auto& of = signals_.used.at(i);
    if (of && of->id == id) take(i, *of, payload);
  }
  if (odometry_is_complete()) {
    ++counters_.samples;
    fmt::format_to(std::back_inserter(lines),
                   "{{\"class\":\"ODOMETRY\",\"t_s\":{},\"vx_mps\":{},\"vy_mps\":{},\"omega_radps\":{}}}\n",
                   t_s, values_[0], values_[1], values_[2]);
    std::fill_n(has_.begin(), kCanImu, false);
  }
  if (std::exchange(has_[kCanImu], false)) {
    ++counters_.samples;
    fmt::format_to(std::back_inserter(lines), "{{\"class\":\"IMU\",\"t_s\":{},\"omega_radps\":{}}}\n", t_s,
                   values_[kCanImu]);
  }
}

void CanSignalDecoder::take(std::size_t quantity, const CanSignal& of,
                            std::span<const std::uint8_t> payload) {
  const bool is_long_enough =
      io::fits(of.signal, payload.size()) && (!of.multiplexor || io::fits(*of.multiplexor, payload.size()));
  if (is_long_enough && of.multiplexor && io::raw_value(*of.multiplexor, payload) != of.signal.multiplexed)
    return;
  const double value = is_long_enough ? io::physical_value(of.signal, payload) : 0.0;
  has_.at(quantity) = is_long_enough && std::isfinite(value) && is_within_bounds(of.signal, value);
  values_.at(quantity) = of.scale * value;
  if (has_.at(quantity)) return;
  ++counters_.bad_value;
  last_problem_ = is_long_enough ? fmt::format("{} is {}, beyond its bounds", of.name, value)
                                 : fmt::format("a frame of {} has {} bytes only", of.name, payload.size());
}

bool CanSignalDecoder::odometry_is_complete() const noexcept {
  for (std::size_t i = 0; i < kCanImu; ++i) {
    if (signals_.used[i] && !has_[i]) return false;
  }
  return true;
}

RobotCanLink::RobotCanLink(std::unique_ptr<link::CanSocket> socket, CanSignals signals)
    : socket_(std::move(socket)), interface_(signals.interface), decoder_(std::move(signals)) {}

link::ReadResult RobotCanLink::read(std::span<std::uint8_t> out) {
  canfd_frame frame{};
  while (read_ == lines_.size() && socket_->receive(frame)) {
    lines_.clear();
    read_ = 0;
    decoder_.take(frame.can_id, std::span(frame.data).first(frame.len), socket_->received_s(), lines_);
  }
  const std::size_t bytes = std::min(out.size(), lines_.size() - read_);
  std::memcpy(out.data(), lines_.data() + read_, bytes);
  read_ += bytes;
  return {bytes, socket_->gone() && bytes == 0};
}

std::string RobotCanLink::take_news() {
  std::string news = socket_->take_news();
  const std::uint64_t bad = decoder_.counters().bad_value;
  if (reported_bad_values_.is_due(bad)) {
    news += fmt::format("{}can:{}: {} values not used so far; the last: {}", news.empty() ? "" : "; ",
                        interface_, bad, decoder_.last_problem());
  }
  return news;
}

std::string robot_can_name(const CanSignals& signals) {
  return "can:" + signals.interface;
}

link::OpenedLink open_robot_can(const CanSignals& signals) {
  link::CanSocket::Opened opened =
      link::CanSocket::open(robot_can_name(signals), signals.interface, filters_of(signals),
                            wire::CanFormat::kClassic, /*receives_fd=*/true);
  if (!opened.socket) return {nullptr, std::move(opened.error)};
  return {std::make_unique<RobotCanLink>(std::move(opened.socket), signals), {}};
}

link::ReconnectingLink::Opener robot_can_opener(const CanSignals& signals) {
  return [signals] { return open_robot_can(signals); };
}

}  // namespace groma::daemon
