// A recorded drive as an MCAP file, for Foxglove and ROS 2.
#pragma once

#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "host/filter/replay.hpp"
#include "host/io/dataset.hpp"
#include "host/model/calibration.hpp"
#include "host/ros2/messages.hpp"

namespace groma::convert {

// An estimate, at the time of an odometry sample.
struct Estimate {
  ros2::Localization at;
  double roll_rad = 0.0;
  double pitch_rad = 0.0;
  double yaw_rad = 0.0;  // the heading on the surface
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
