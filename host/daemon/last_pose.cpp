#include "host/daemon/last_pose.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <ctime>
#include <fstream>
#include <system_error>
#include <utility>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/io/output_file.hpp"
#include "host/model/plausible.hpp"
#include "host/model/pose.hpp"

namespace groma::daemon {
namespace {

using Json = nlohmann::ordered_json;

// How far a robot gets while the daemon is off, at most: slowly pushed or driven by hand, within
// linearization of the ranges. By hand; LastPose.*.
constexpr double kDrift_mps = 0.5;
constexpr double kMaxDrift_m = 3.0;
constexpr double kDrift_radps = 0.1;
constexpr double kMaxDrift_rad = 0.5;
// A smaller change is no motion. By hand: well below the sigmas of a start.
constexpr double kMoved_m = 0.02;
constexpr double kMoved_rad = 0.01;

bool is_moved(const LastPose& from, const PoseEstimate& to) {
  return std::hypot(to.x_m - from.x_m, to.y_m - from.y_m) > kMoved_m ||
         std::abs(model::wrap_angle(to.yaw_rad - from.yaw_rad)) > kMoved_rad || from.floor != to.floor;
}

}  // namespace

HostTime host_time() {
  static const std::string boot = [] {
    std::string id;
    std::ifstream file("/proc/sys/kernel/random/boot_id");
    std::getline(file, id);
    return id;
  }();
  HostTime time{.boot = boot};
  update(time);
  return time;
}

void update(HostTime& time) {
  timespec since_boot{};
  static_cast<void>(::clock_gettime(CLOCK_BOOTTIME, &since_boot));
  const std::chrono::duration<double> since_1970 = std::chrono::system_clock::now().time_since_epoch();
  time.unix_s = since_1970.count();
  time.since_boot_s = static_cast<double>(since_boot.tv_sec) + 1e-9 * static_cast<double>(since_boot.tv_nsec);
}

std::string digest_of(const model::Calibration& calibration) {
  return io::sha256(io::format_calibration(calibration));
}

std::string format_last_pose(const LastPose& pose) {
  const Eigen::Matrix3d& p = pose.covariance;
  const Json object{{"schema", 1},
                    {"unix_s", pose.time.unix_s},
                    {"since_boot_s", pose.time.since_boot_s},
                    {"boot", pose.time.boot},
                    {"calibration_sha256", pose.calibration},
                    {"floor", pose.floor},
                    {"x_m", pose.x_m},
                    {"y_m", pose.y_m},
                    {"yaw_rad", pose.yaw_rad},
                    {"covariance", Json::array({p(0, 0), p(0, 1), p(0, 2), p(1, 1), p(1, 2), p(2, 2)})}};
  return object.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::optional<LastPose> parse_last_pose(std::string_view text) {
  const Json object = Json::parse(text, nullptr, /*allow_exceptions=*/false);
  if (!object.is_object()) return std::nullopt;
  LastPose pose;
  model::PoseCovariance covariance{};
  try {
    if (object.at("schema") != 1) return std::nullopt;
    object.at("unix_s").get_to(pose.time.unix_s);
    object.at("since_boot_s").get_to(pose.time.since_boot_s);
    object.at("boot").get_to(pose.time.boot);
    object.at("calibration_sha256").get_to(pose.calibration);
    object.at("floor").get_to(pose.floor);
    object.at("x_m").get_to(pose.x_m);
    object.at("y_m").get_to(pose.y_m);
    object.at("yaw_rad").get_to(pose.yaw_rad);
    object.at("covariance").get_to(covariance);
  } catch (const Json::exception&) {
    return std::nullopt;
  }
  pose.covariance = model::to_matrix(covariance);
  const bool good = std::isfinite(pose.time.unix_s) && std::isfinite(pose.time.since_boot_s) &&
                    model::is_plausible(model::PoseSample{
                        .x_m = pose.x_m, .y_m = pose.y_m, .yaw_rad = pose.yaw_rad, .covariance = covariance});
  return good ? std::optional(pose) : std::nullopt;
}

std::optional<double> age_s(const LastPose& pose, const HostTime& now) {
  const bool same_boot = !now.boot.empty() && pose.time.boot == now.boot;
  const double age_s = same_boot ? now.since_boot_s - pose.time.since_boot_s : now.unix_s - pose.time.unix_s;
  return age_s >= 0.0 ? std::optional(age_s) : std::nullopt;
}

std::optional<filter::Start> start_from(const LastPose& pose, std::optional<double> age_s,
                                        const model::Surface& surface) {
  int chart = 0;
  if (surface.chart_count() > 1) {
    const auto& charts = surface.charts();
    const auto found =
        std::find_if(charts.begin(), charts.end(), [&](const auto& one) { return one.name == pose.floor; });
    if (found == charts.end()) return std::nullopt;
    chart = static_cast<int>(found - charts.begin());
  }
  const Eigen::Matrix3d& p = pose.covariance;
  // Along the axis of the largest variance.
  const double variance_m2 = 0.5 * (p(0, 0) + p(1, 1)) + std::hypot(0.5 * (p(0, 0) - p(1, 1)), p(0, 1));
  const double drift_m = age_s ? std::min(kDrift_mps * *age_s, kMaxDrift_m) : kMaxDrift_m;
  const double drift_rad = age_s ? std::min(kDrift_radps * *age_s, kMaxDrift_rad) : kMaxDrift_rad;
  return filter::Start{.pose = {pose.x_m, pose.y_m, pose.yaw_rad, chart},
                       .position_sigma_m = std::hypot(std::sqrt(variance_m2), drift_m),
                       .heading_sigma_rad = std::hypot(std::sqrt(p(2, 2)), drift_rad)};
}

std::optional<filter::Start> LastPoseFile::read(const model::Calibration& calibration,
                                                const model::Surface& surface) {
  use(calibration);
  std::error_code ignored;
  if (!std::filesystem::exists(path_, ignored)) return std::nullopt;
  std::optional<LastPose> pose;
  try {
    pose = parse_last_pose(io::read_file(path_));
  } catch (const io::Error& error) {
    log_(error.what());
    return std::nullopt;
  }
  const auto refuse = [&](std::string_view reason) {
    log_(fmt::format("{}: the last pose is not used: {}", path_.string(), reason));
    return std::nullopt;
  };
  if (!pose) return refuse("the file is damaged");
  if (pose->calibration != calibration_) return refuse("the calibration has changed since");
  const std::optional<double> age = age_s(*pose, host_time());
  const std::optional<filter::Start> start = start_from(*pose, age, surface);
  if (!start) return refuse("the surface has changed since");
  log_(fmt::format("starts from the last pose, {} ago: x {:.2f} m, y {:.2f} m, yaw {:.2f} rad",
                   age ? fmt::format("{:.0f} s", *age) : "an unknown time", pose->x_m, pose->y_m,
                   pose->yaw_rad));
  return start;
}

void LastPoseFile::take(const PoseEstimate& pose, double now_s) {
  newest_ = pose;
  update(taken_);
  if (!is_due(now_s)) return;
  written_s_ = now_s;
  write();
}

bool LastPoseFile::is_due(double now_s) const {
  if (writer_.busy()) return false;
  if (!written_) return true;
  const double since_s = now_s - written_s_;
  const bool changed = is_moved(*written_, *newest_) || written_->calibration != calibration_;
  return since_s >= (changed ? kPeriod_s : kStationaryPeriod_s);
}

void LastPoseFile::write() {
  finish_writing();
  written_ = LastPose{taken_,       calibration_,     std::string(newest_->floor), newest_->x_m,
                      newest_->y_m, newest_->yaw_rad, newest_->planar_covariance};
  writer_.start(path_, format_last_pose(*written_));
}

void LastPoseFile::finish_writing() {
  const std::optional<std::string> error = writer_.finish();
  if (!error) return;
  if (!error->empty() && *error != reported_error_) log_(*error);
  reported_error_ = *error;
}

void LastPoseFile::finish() {
  if (!newest_) return;
  write();
  finish_writing();
}

}  // namespace groma::daemon
