// Scenarios as YAML files: docs/reference/files.md tells the keys.
#pragma once

#include <filesystem>
#include <string>

#include "firmware/sim/world/scenario.hpp"

namespace groma::sim {

// Throws io::ConfigError with line and column of what is not as it has to be. `path` only names the text.
[[nodiscard]] Scenario parse_scenario(const std::filesystem::path& path, const std::string& text);

// Throws also io::DataError (missing) and io::PermissionError.
[[nodiscard]] Scenario read_scenario(const std::filesystem::path& path);

}  // namespace groma::sim
