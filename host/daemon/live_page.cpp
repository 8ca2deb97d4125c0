#include "host/daemon/live_page.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <memory>
#include <utility>
#include <variant>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/model/surface.hpp"

namespace groma::daemon {
namespace {

using Json = nlohmann::ordered_json;

// In the history.
constexpr double kPosesBetween_s = 0.25;
constexpr double kStatusesBetween_s = 1.9;      // every second STATUS and CALIBRATION
constexpr std::size_t kHistoryAtOnce = 65'536;  // bytes of it that wait for one client
constexpr std::size_t kPoseReserve = 4096;      // as PoseWriter

web::Socket::Message message_of(std::string_view line) {
  if (!line.empty() && line.back() == '\n') line.remove_suffix(1);
  return std::make_shared<const std::string>(line);
}

std::string text_of(const Json& json) {
  return json.dump(-1, ' ', false, Json::error_handler_t::replace);
}

Json array_of(const Eigen::Vector3d& of) {
  return {of.x(), of.y(), of.z()};
}

Json outline_of(const model::Chart& chart) {
  std::vector<Eigen::Vector2d> corners = chart.domain_m;
  if (const auto* spline = std::get_if<model::BSpline>(&chart.shape); spline != nullptr && corners.empty()) {
    const model::BSpline::Grid& grid = spline->grid();
    const double x1_m = grid.x0_m + grid.dx_m * (grid.nx - 3);
    const double y1_m = grid.y0_m + grid.dy_m * (grid.ny - 3);
    corners = {{grid.x0_m, grid.y0_m}, {x1_m, grid.y0_m}, {x1_m, y1_m}, {grid.x0_m, y1_m}};
  }
  if (corners.empty()) return nullptr;
  Json out = Json::array();
  for (const Eigen::Vector2d& corner : corners) out.push_back({corner.x(), corner.y()});
  return out;
}

Json anchor_of(const model::AnchorCalibration& anchor) {
  Json out{{"id", anchor.id},
           {"position_m", nullptr},
           {"covariance_m2", nullptr},
           {"verdict", io::word(anchor.verdict)},
           {"advice", anchor.advice}};
  if (!model::has_position(anchor)) return out;
  out["position_m"] = array_of(anchor.position_m);
  Json& covariance = out["covariance_m2"] = Json::array();
  for (Eigen::Index row = 0; row < 3; ++row) {
    for (Eigen::Index column = 0; column < 3; ++column) covariance.push_back(anchor.covariance(row, column));
  }
  return out;
}

Json json_of_time(const std::optional<double>& t_s) {
  return t_s ? Json(*t_s) : Json(nullptr);
}

}  // namespace

LivePage::LivePage(EventLoop& loop, const Config& config, std::string greeting, RobotTime robot_time)
    : loop_(loop),
      config_(config),
      greeting_(std::move(greeting)),
      robot_time_(std::move(robot_time)),
      timer_(loop, kPeriod_s, [this] { on_tick(); }) {
  pose_.reserve(kPoseReserve);
}

void LivePage::on_pose(const PoseEstimate& pose, std::string_view line) {
  pose_ = line;
  has_new_pose_ = true;
  state_ = pose.state;
  reason_ = pose.reason;
}

void LivePage::on_tick() {
  if (!std::exchange(has_new_pose_, false)) return;
  const std::pair now(state_, reason_);
  const bool is_kept = loop_.now_s() >= next_pose_s_ || now != kept_;
  if (is_kept) {
    next_pose_s_ = loop_.now_s() + kPosesBetween_s;
    kept_ = now;
    keep(pose_);
  }
  send(pose_, is_kept ? Kept::kYes : Kept::kNo);
}

void LivePage::on_line(std::string_view line) {
  double& next_s = line.starts_with(R"({"class":"STATUS")") ? next_status_s_ : next_calibration_s_;
  const bool is_kept = loop_.now_s() >= next_s;
  if (is_kept) {
    next_s = loop_.now_s() + kStatusesBetween_s;
    keep(line);
  }
  send(line, is_kept ? Kept::kYes : Kept::kNo);
}

void LivePage::on_calibration(const model::Calibration& calibration) {
  frame_ = calibration.frame;
  Json json{{"class", "ANCHORS"},
            {"t_s", json_of_time(robot_time_())},
            {"verdict", io::word(calibration.verdict)},
            {"anchors", Json::array()}};
  for (const model::AnchorCalibration& anchor : calibration.anchors)
    json["anchors"].push_back(anchor_of(anchor));
  anchors_ = text_of(json);
  keep(anchors_);
  send(anchors_, Kept::kYes);
}

void LivePage::on_log(std::string_view text) {
  const std::string line = text_of({{"class", "LOG"}, {"t_s", json_of_time(robot_time_())}, {"text", text}});
  keep(line);
  send(line, Kept::kYes);
}

std::string LivePage::site_line() const {
  Json json{{"class", "SITE"},
            {"frame", frame_},
            {"model", filter::model_name(config_.model)},
            {"simulated", config_.web->is_simulated},
            {"learns", config_.calibration.learn},
            {"tags", Json::array()},
            {"nodes", Json::array()},
            {"walls", Json::array()},
            {"floors", Json::array()}};
  for (const model::Tag& tag : config_.tags)
    json["tags"].push_back({{"id", tag.id}, {"lever_arm_m", array_of(tag.lever_arm_m)}});
  for (const NodeLink& node : config_.nodes) json["nodes"].push_back(node.path.string());
  for (const WebSettings::Wall& wall : config_.web->walls)
    json["walls"].push_back({wall.from_m.x(), wall.from_m.y(), wall.to_m.x(), wall.to_m.y()});
  for (const model::Chart& chart : config_.surface.charts()) {
    json["floors"].push_back(
        {{"name", chart.name.empty() ? Json(nullptr) : Json(chart.name)}, {"outline_m", outline_of(chart)}});
  }
  return text_of(json);
}

void LivePage::on_open(web::Socket& socket) {
  using Kind = web::Socket::Kind;
  socket.send(message_of(greeting_), Kind::kText);
  socket.send(message_of(site_line()), Kind::kText);
  // It may be older than the history.
  if (!anchors_.empty()) socket.send(message_of(anchors_), Kind::kText);
  const Json begin{{"class", "HISTORY"}, {"state", "begin"}, {"messages", history_.end() - history_.begin()}};
  socket.send(message_of(text_of(begin)), Kind::kText);
  clients_[&socket] = history_.begin();
}

void LivePage::on_close(web::Socket& socket) {
  clients_.erase(&socket);
}

void LivePage::on_drained(web::Socket& socket) {
  const auto client = clients_.find(&socket);
  if (client != clients_.end() && client->second) send_history(socket, client->second);
}

void LivePage::send_history(web::Socket& socket, std::optional<std::uint64_t>& next) {
  *next = std::max(*next, history_.begin());
  while (*next < history_.end() && socket.waiting_bytes() < kHistoryAtOnce)
    socket.send(message_of(history_.at((*next)++)), web::Socket::Kind::kText);
  if (*next < history_.end()) return;
  next.reset();
  socket.send(message_of(R"({"class":"HISTORY","state":"end"})"), web::Socket::Kind::kText);
}

void LivePage::send(std::string_view line, Kept kept) {
  web::Socket::Message message;
  for (auto& [socket, next] : clients_) {
    if (next) continue;
    if (!message) message = message_of(line);
    if (!socket->send(message, web::Socket::Kind::kText))
      next = history_.end() - (kept == Kept::kYes ? 1 : 0);
  }
}

}  // namespace groma::daemon
