// Parts of YAML files shared by data sets and the daemon's configuration: the description of a site and a
// robot.
#pragma once

#include <filesystem>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/io/yaml_type.hpp"
#include "host/model/anchor_parameters.hpp"
#include "host/model/steering.hpp"
#include "host/model/surface.hpp"
#include "host/model/surface_fit.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// The types of these parts. Each parse function accepts what its type allows, within further rules.
[[nodiscard]] YamlType surface_type();
[[nodiscard]] YamlType odometry_noise_type();
[[nodiscard]] YamlType steering_type();
[[nodiscard]] YamlType imu_type();
[[nodiscard]] YamlType gnss_type();
[[nodiscard]] YamlType range_priors_type();

// Accepts
//   {type: plane, z_m: ..., normal: [x, y, z]};
//   {type: bspline, file: ...}: the file, relative to `folder`, has a line x0_m,y0_m,dx_m,dy_m,nx,ny, then nx
//   rows of ny control heights;
//   {type: points, file: ...} or {type: grid, file: ...}: heights, to which this function fits a spline;
//   {type: floors, floors: [...]} of these.
// Each but the last may have a mismatch. Throws ConfigError, DataError or PermissionError.
[[nodiscard]] model::Surface parse_surface(const YamlValue& yaml, const std::filesystem::path& folder,
                                           InputFiles& files);

// {sigma_vx_mps: ..., sigma_vy_mps: ..., sigma_omega_radps: ...}. Throws ConfigError.
[[nodiscard]] model::OdometryNoise parse_odometry_noise(const YamlValue& yaml);

// {wheelbase_m: ...}, and optionally rear_axle_x_m and the sigmas of model::Steering. Throws ConfigError.
[[nodiscard]] model::Steering parse_steering(const YamlValue& yaml);

// Throws ConfigError unless the map has either `odometry` or `steering`.
void expect_odometry(const YamlValue& yaml);

// {sigma_omega_radps: ..., bias_sigma_radps: ...}, each optional. Throws ConfigError.
void parse_imu(const YamlValue& yaml, model::SensorDescription& out);

// {lever_arm_m: [x, y, z]}. Throws ConfigError.
void parse_gnss(const YamlValue& yaml, model::SensorDescription& out);

// The optional keys imu and gnss of a map. Throws ConfigError.
[[nodiscard]] model::SensorDescription parse_sensors(const YamlValue& yaml);

// {sigma_m: ...} with optional terms of the range model, each [mean, sigma]. Throws ConfigError.
[[nodiscard]] model::RangePriors parse_range_priors(const YamlValue& yaml);

// Points (x, y, z) from a table with the columns x_m, y_m and z_m, or from a grid in the format of a spline's
// file whose heights are those of the ground; unknown heights are empty or nan. Throws DataError.
[[nodiscard]] std::vector<Eigen::Vector3d> parse_heights(const std::filesystem::path& path,
                                                         std::string_view text);
// Fits a surface to these points. Throws DataError.
[[nodiscard]] model::SurfaceFit fit_heights(const std::filesystem::path& path, std::string_view text,
                                            const model::SurfaceFitOptions& options);

}  // namespace groma::io
