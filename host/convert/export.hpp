// Estimates and calibrations in the formats of other programs.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/model/calibration.hpp"
#include "host/model/geographic.hpp"
#include "host/model/types.hpp"

namespace groma::convert {

// A pose in space, from an estimate or another table of poses.
struct ExportPose {
  double t_s = 0.0;
  Eigen::Vector3d position_m = Eigen::Vector3d::Zero();
  Eigen::Vector4d quaternion{0.0, 0.0, 0.0, 1.0};  // x, y, z, w
};

// The poses of a table with t_s,x_m,y_m,yaw_rad and perhaps z_m,roll_rad,pitch_rad: an estimate, where yaw is
// the heading on the surface, if it has p_xx; otherwise yaw is that of ZYX. Throws io::DataError or
// io::PermissionError.
[[nodiscard]] std::vector<ExportPose> read_export_poses(const std::filesystem::path& path);

// Texts of files: lines "t_s x y z qx qy qz qw"; a table; GeoJSON (RFC 7946), whose coordinates are the map's
// metres without a datum.
[[nodiscard]] std::string to_tum(const std::vector<ExportPose>& poses);
[[nodiscard]] std::string to_csv(const std::vector<ExportPose>& poses);
[[nodiscard]] std::string to_csv(const model::Calibration& calibration);
[[nodiscard]] std::string to_geojson(const std::vector<ExportPose>& poses,
                                     const std::optional<model::Datum>& datum);
[[nodiscard]] std::string to_geojson(const model::Calibration& calibration,
                                     const std::optional<model::Datum>& datum);

}  // namespace groma::convert
