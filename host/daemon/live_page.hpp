// What the live page shows, as messages of docs/reference/live.md, and the last ten minutes of it.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <string_view>

#include "host/daemon/config.hpp"
#include "host/daemon/event_loop.hpp"
#include "host/daemon/output.hpp"
#include "host/web/line_history.hpp"
#include "host/web/server.hpp"

namespace groma::daemon {

class LivePage : public Output, public web::SocketService {
 public:
  static constexpr double kPeriod_s = 0.05;    // of POSE
  static constexpr double kHistory_s = 600.0;  // what a new client gets
  static constexpr std::size_t kHistoryBytes = 12U << 20U;
  static constexpr std::size_t kHistoryLines = 16'384;

  // The robot's time now; none: not known.
  using RobotTime = std::function<std::optional<double>()>;
  // greeting: the first message to each client. `config` and `loop` have to outlive this.
  LivePage(EventLoop& loop, const Config& config, std::string greeting, RobotTime robot_time);

  // Without the heap: on_tick() sends the last one.
  void on_pose(const PoseEstimate& pose, std::string_view line) override;
  void on_line(std::string_view line) override;
  void on_calibration(const model::Calibration& calibration) override;
  // A line of gromad's log.
  void on_log(std::string_view text);

  void on_open(web::Socket& socket) override;
  void on_close(web::Socket& socket) override;
  void on_drained(web::Socket& socket) override;

 private:
  // The next line of the history for a client; none: it has had all of it.
  using Clients = std::map<web::Socket*, std::optional<std::uint64_t>>;
  enum class Kept { kYes, kNo };  // whether a line is in the history

  void on_tick();
  void send_history(web::Socket& socket, std::optional<std::uint64_t>& next);
  // To the clients that have had the history. One that is too slow for it continues from the history.
  void send(std::string_view line, Kept kept);
  void keep(std::string_view line) { history_.push(line, loop_.now_s()); }
  [[nodiscard]] std::string site_line() const;

  EventLoop& loop_;
  const Config& config_;
  std::string greeting_;
  RobotTime robot_time_;
  std::string frame_ = "map";
  std::string anchors_;  // the last ANCHORS line; empty: no calibration yet
  std::string pose_;     // the last POSE line; its capacity is reserved
  bool has_new_pose_ = false;
  filter::State state_ = filter::State::kUninitialized;  // of pose_
  filter::Reason reason_ = filter::Reason::kNone;
  // What the history has.
  std::optional<std::pair<filter::State, filter::Reason>> kept_;
  double next_pose_s_ = 0.0;
  double next_status_s_ = 0.0;
  double next_calibration_s_ = 0.0;
  web::LineHistory history_{kHistoryBytes, kHistoryLines, kHistory_s};
  Clients clients_;
  EventLoop::Timer timer_;
};

}  // namespace groma::daemon
