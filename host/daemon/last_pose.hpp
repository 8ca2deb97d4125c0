// The last pose, kept in a file so that the daemon continues from it after a restart.
//
// The pose is a hypothesis: the robot may have been moved meanwhile. Its uncertainty grows with the time that
// has passed, and the filter starts CONVERGING: the ranges have to agree with it before it is TRACKING, and
// the search for another pose runs as after any start.
#pragma once

#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <string_view>

#include <Eigen/Core>

#include "host/daemon/file_writer.hpp"
#include "host/daemon/localizer.hpp"
#include "host/filter/filter.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"

namespace groma::daemon {

// This computer's clocks. Those since the boot are comparable within one boot only.
struct HostTime {
  double unix_s = 0.0;
  double since_boot_s = 0.0;  // with suspended time
  std::string boot;           // identifies the boot
};
[[nodiscard]] HostTime host_time();
// Reads the clocks again; the boot stays.
void update(HostTime& time);

struct LastPose {
  HostTime time;
  std::string calibration;  // digest_of() the one by which it was estimated
  std::string floor;
  double x_m = 0.0;
  double y_m = 0.0;
  double yaw_rad = 0.0;
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // of x_m, y_m, yaw_rad
};

[[nodiscard]] std::string digest_of(const model::Calibration& calibration);
// JSON, one line. parse: nothing if the text is no such pose.
[[nodiscard]] std::string format_last_pose(const LastPose& pose);
[[nodiscard]] std::optional<LastPose> parse_last_pose(std::string_view text);
// Nothing if it is unknown: the clock was set back, or is not set yet after a boot.
[[nodiscard]] std::optional<double> age_s(const LastPose& pose, const HostTime& now);
// A start at the pose; its time is not set. Nothing if the surface has no such floor.
[[nodiscard]] std::optional<filter::Start> start_from(const LastPose& pose, std::optional<double> age_s,
                                                      const model::Surface& surface);

class LastPoseFile {
 public:
  using Log = std::function<void(std::string_view)>;

  static constexpr double kPeriod_s = 1.0;             // least time between two writes
  static constexpr double kStationaryPeriod_s = 60.0;  // of a robot that does not move

  LastPoseFile(std::filesystem::path path, Log log) : path_(std::move(path)), log_(std::move(log)) {}

  // Reads the file; logs whether its pose is used, and why not. Never throws for its content.
  [[nodiscard]] std::optional<filter::Start> read(const model::Calibration& calibration,
                                                  const model::Surface& surface);
  // The calibration of the poses from now on.
  void use(const model::Calibration& calibration) { calibration_ = digest_of(calibration); }
  // Takes a pose that is valid, at now_s (host time). Writes when it is due, in a thread that may wait for
  // the disk.
  void take(const PoseEstimate& pose, double now_s);
  // Writes the newest pose, and waits until it is written.
  void finish();

 private:
  [[nodiscard]] bool is_due(double now_s) const;
  void write();
  void finish_writing();

  std::filesystem::path path_;
  Log log_;
  std::string calibration_;
  // No copies of texts for each pose.
  std::optional<PoseEstimate> newest_;
  HostTime taken_ = host_time();  // when newest_ was taken
  std::optional<LastPose> written_;
  double written_s_ = 0.0;  // host time of the pose
  FileWriter writer_;
  std::string reported_error_;
};

}  // namespace groma::daemon
