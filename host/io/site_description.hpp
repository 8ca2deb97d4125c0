// Parts of YAML files that data sets and the daemon's configuration have in common: what is known of a site
// and a robot beforehand.
#pragma once

#include <filesystem>

#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// {type: plane, z_m: ..., normal: [x, y, z]} or {type: bspline, file: ...}, the file relative to `folder`: a
// line x0_m,y0_m,dx_m,dy_m,nx,ny, then nx rows of ny control heights. Throws ConfigError, DataError or
// PermissionError.
[[nodiscard]] model::Surface parse_surface(const YamlValue& yaml, const std::filesystem::path& folder,
                                           InputFiles& files);

// {sigma_vx_mps: ..., sigma_vy_mps: ..., sigma_omega_radps: ...}. Throws ConfigError.
[[nodiscard]] model::OdometryNoise parse_odometry_noise(const YamlValue& yaml);

// imu: {sigma_omega_radps: ..., bias_sigma_radps: ...} and gnss: {lever_arm_m: [x, y, z]} of a map, where
// they are there. Throws ConfigError.
[[nodiscard]] model::SensorDescription parse_sensors(const YamlValue& yaml);

// {sigma_m: ...}, and perhaps beta_m and gamma, each [mean, sigma]. Throws ConfigError.
[[nodiscard]] model::RangePriors parse_range_priors(const YamlValue& yaml);

}  // namespace groma::io
