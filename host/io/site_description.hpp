// Parts of YAML files that data sets and the daemon's configuration have in common: what is known of a site
// and a robot beforehand.
#pragma once

#include <filesystem>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/model/surface.hpp"
#include "host/model/surface_fit.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// {type: plane, z_m: ..., normal: [x, y, z]}; {type: bspline, file: ...}, the file relative to `folder`: a
// line x0_m,y0_m,dx_m,dy_m,nx,ny, then nx rows of ny control heights; {type: points, file: ...} or {type:
// grid, file: ...}, heights that a spline is fitted to here; each perhaps with its mismatch; or {type:
// floors, floors: [...]} of these. Throws ConfigError, DataError or PermissionError.
[[nodiscard]] model::Surface parse_surface(const YamlValue& yaml, const std::filesystem::path& folder,
                                           InputFiles& files);

// {sigma_vx_mps: ..., sigma_vy_mps: ..., sigma_omega_radps: ...}. Throws ConfigError.
[[nodiscard]] model::OdometryNoise parse_odometry_noise(const YamlValue& yaml);

// imu: {sigma_omega_radps: ..., bias_sigma_radps: ...} and gnss: {lever_arm_m: [x, y, z]} of a map, where
// they are there. Throws ConfigError.
[[nodiscard]] model::SensorDescription parse_sensors(const YamlValue& yaml);

// {sigma_m: ...}, and perhaps beta_m and gamma, each [mean, sigma]. Throws ConfigError.
[[nodiscard]] model::RangePriors parse_range_priors(const YamlValue& yaml);

// Points (x, y, z) of a table with the columns x_m, y_m and z_m, or of a grid as a spline's file has it, its
// heights those of the ground itself, empty or nan where they are not known. Throws DataError.
[[nodiscard]] std::vector<Eigen::Vector3d> parse_heights(const std::filesystem::path& path,
                                                         std::string_view text);
// A surface through them. Throws DataError.
[[nodiscard]] model::SurfaceFit fit_heights(const std::filesystem::path& path, std::string_view text,
                                            const model::SurfaceFitOptions& options);

}  // namespace groma::io
