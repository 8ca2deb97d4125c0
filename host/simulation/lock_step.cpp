#include "host/simulation/lock_step.hpp"

#include <fmt/format.h>
#include <poll.h>

#include <array>
#include <span>
#include <utility>

#include "host/io/error.hpp"

namespace groma::simulation {

namespace {

constexpr int kReadTimeout_ms = 5000;

std::span<const std::uint8_t> bytes_of(const std::string& text) {
  return {reinterpret_cast<const std::uint8_t*>(text.data()), text.size()};
}

}  // namespace

LockStep::LockStep(const sim::Scenario& scenario, const SiteOptions& options)
    : site_(scenario, options),
      robot_(site_.world().robot()),
      session_(
          {.vehicle = scenario.odometry.car ? std::optional(scenario.odometry.car->vehicle) : std::nullopt}) {
  for (std::size_t i = 0; i < site_.port_count(); ++i) {
    Tag tag;
    link::OpenedLink opened = link::open_link(tag.port.path(), scenario.link.bit_per_s);
    if (!opened.link) throw io::DeviceError({tag.port.path()}, opened.error.message, "start again");
    tag.link = std::move(opened.link);
    tag.node = session_.add_node(site_.port_name(i), scenario.link.bit_per_s);
    tags_.push_back(std::move(tag));
  }
}

void LockStep::run_until(double t_s) {
  for (;;) {
    const double now_s = static_cast<double>(steps_ + 1) * kStep_s;
    if (now_s > t_s) return;
    ++steps_;
    site_.run_until(now_s);
    lines_.clear();
    robot_.lines_until(now_s, lines_);
    if (!lines_.empty()) session_.robot_bytes(bytes_of(lines_), now_s);
    for (std::size_t i = 0; i < tags_.size(); ++i) {
      bytes_.clear();
      site_.take(i, bytes_);
      if (!bytes_.empty()) pass_through(tags_[i], now_s);
    }
    session_.advance(now_s);
  }
}

void LockStep::pass_through(Tag& tag, double now_s) {
  if (tag.port.write(bytes_) != bytes_.size()) {
    throw io::DeviceError({tag.port.path()}, "does not accept all bytes",
                          "end what else has this terminal open");
  }
  std::array<std::uint8_t, 512> chunk{};
  for (std::size_t left = bytes_.size(); left > 0;) {
    pollfd waiting{tag.link->poll_fd(), POLLIN, 0};
    if (::poll(&waiting, 1, kReadTimeout_ms) == 0) {
      throw io::DeviceError({tag.port.path()}, "did not return all bytes",
                            "end what else reads this terminal");
    }
    const link::ReadResult read = tag.link->read(chunk);
    if (read.gone) throw io::DeviceError({tag.port.path()}, "was hung up", "start again");
    session_.node_bytes(tag.node, std::span(chunk).first(read.bytes), now_s);
    left -= read.bytes;
  }
}

}  // namespace groma::simulation
