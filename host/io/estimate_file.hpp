// The estimate of a replay as a table: t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt and perhaps more.
#pragma once

#include <filesystem>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "host/model/types.hpp"

namespace groma::io {

// Numbers as short as they read back exactly.
[[nodiscard]] std::string format_estimate(std::span<const model::PlanarEstimate> rows);

// With the columns state and reason, of each row its two words.
struct RowWords {
  std::string_view state;
  std::string_view reason;
};
[[nodiscard]] std::string format_estimate(std::span<const model::PlanarEstimate> rows,
                                          std::span<const RowWords> words);

// Throws DataError (cannot be read as numbers, no rows, times that do not increase) or PermissionError.
[[nodiscard]] std::vector<model::PlanarEstimate> read_estimate(const std::filesystem::path& path);

}  // namespace groma::io
