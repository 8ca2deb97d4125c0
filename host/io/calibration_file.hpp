// The calibration file: YAML 1.2, schema 1; users may read and edit it.
#pragma once

#include <filesystem>
#include <string>
#include <string_view>

#include "host/model/calibration.hpp"

namespace groma::io {

// Names of the verdicts in files and JSON: ok, weak-z, weak, never-in-sight, moved, no-data; and usable,
// warnings, unusable.
[[nodiscard]] std::string_view word(model::AnchorVerdict verdict);
[[nodiscard]] std::string_view word(model::Verdict verdict);

// Numbers have the shortest form that reads back exactly. If an anchor's position or covariance is not
// finite, its entry has `null` for both and no pairs.
[[nodiscard]] std::string format_calibration(const model::Calibration& calibration);

// Strict inverse of format_calibration(). `path` is used in error messages. Throws ConfigError.
[[nodiscard]] model::Calibration parse_calibration(const std::filesystem::path& path,
                                                   const std::string& text);

// Throws ConfigError, DataError (no such file) or PermissionError.
[[nodiscard]] model::Calibration read_calibration(const std::filesystem::path& path);

}  // namespace groma::io
