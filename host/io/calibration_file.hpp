// The calibration file: YAML 1.2, schema 1, which people may read and mend.
#pragma once

#include <filesystem>
#include <string>
#include <string_view>

#include "host/model/calibration.hpp"

namespace groma::io {

// Words of the verdicts, as files and JSON have them: ok, weak-z, weak, never-in-sight, moved, no-data; and
// usable, warnings, unusable.
[[nodiscard]] std::string_view word(model::AnchorVerdict verdict);
[[nodiscard]] std::string_view word(model::Verdict verdict);

// Numbers are as short as they read back exactly. What is not finite cannot stand in the file: the anchor's
// entry then says `null` for its position and covariance.
[[nodiscard]] std::string format_calibration(const model::Calibration& calibration);

// The reverse, strict. `path` is for the messages. Throws ConfigError.
[[nodiscard]] model::Calibration parse_calibration(const std::filesystem::path& path,
                                                   const std::string& text);

// Throws ConfigError, DataError (no such file) or PermissionError.
[[nodiscard]] model::Calibration read_calibration(const std::filesystem::path& path);

}  // namespace groma::io
