// A recorded drive as an MCAP file, for Foxglove and ROS 2.
#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "host/filter/replay.hpp"
#include "host/filter/tracker.hpp"
#include "host/io/dataset.hpp"
#include "host/model/calibration.hpp"
#include "host/model/odom_frame.hpp"
#include "host/model/pose.hpp"
#include "host/model/types.hpp"

namespace groma::convert {

// An estimate, at the time of an odometry sample.
struct Estimate {
  double t_s = 0.0;
  model::QuaternionPose pose;
  double roll_rad = 0.0;
  double pitch_rad = 0.0;
  double yaw_rad = 0.0;                                                          // the heading on the surface
  Eigen::Matrix<double, 6, 6> covariance = Eigen::Matrix<double, 6, 6>::Zero();  // x, y, z, roll, pitch, yaw
  filter::State state = filter::State::kUninitialized;
  filter::Reason reason = filter::Reason::kNone;
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();  // vx, vy and yaw rate; NaN: unknown
  Eigen::Matrix3d velocity_covariance = Eigen::Matrix3d::Zero();
  std::optional<model::OdomPose> odom;  // none: no transforms of ROS 2
};

struct Recording {
  const io::Dataset* dataset = nullptr;
  // The filter's result for the drive, and the calibration that it used; null: no estimates.
  const model::Calibration* calibration = nullptr;
  const filter::ReplayResult* result = nullptr;
  // Instead: what gromad sent during the drive, and the calibrations that it used.
  std::vector<Estimate> sent = {};
  std::vector<model::Calibration> used = {};
  // Odometry and samples of other sensors outside are left out.
  double from_s = -std::numeric_limits<double>::infinity();
  double to_s = std::numeric_limits<double>::infinity();
};

enum class Format { kFoxglove, kRos2 };

struct Converted {
  std::string bytes;  // of the file
  std::uint64_t messages = 0;
  std::size_t topics = 0;
  std::size_t without_timestamp = 0;  // samples left out: before 0 or after 2^31 s
};

// docs/reference/files.md, "MCAP file", lists the topics.
[[nodiscard]] Converted to_mcap(const Recording& recording, Format format);

}  // namespace groma::convert
