// The estimate of a replay as a table: t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt, optionally followed
// by state,reason and the rest of the pose in space: z_m,roll_rad,pitch_rad,p_zz,p_zr,p_zp,p_rr,p_rp,p_pp.
#pragma once

#include <filesystem>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// Numbers have the shortest form that reads back exactly.
[[nodiscard]] std::string format_estimate(std::span<const model::PlanarEstimate> rows);
struct RowWords {
  std::string_view state;
  std::string_view reason;
};
// Also writes `state` and `reason`, the pose's remaining columns in space and, if the surface has several
// charts, the chart's name as `floor`. `spatial` and `words` have as many elements as `rows`.
[[nodiscard]] std::string format_estimate(std::span<const model::PlanarEstimate> rows,
                                          std::span<const model::SpatialEstimate> spatial,
                                          const model::Surface& surface, std::span<const RowWords> words);

// Throws DataError (missing, not readable as numbers, no rows, times that do not increase) or
// PermissionError.
[[nodiscard]] std::vector<model::PlanarEstimate> read_estimate(const std::filesystem::path& path);

// A row's columns `state` and `reason`.
struct StateRow {
  double t_s = 0.0;
  std::string state;
  std::string reason;
};
// By time; empty if the table lacks the column `state`. Throws as read_estimate().
[[nodiscard]] std::vector<StateRow> read_states(const std::filesystem::path& path);

}  // namespace groma::io
