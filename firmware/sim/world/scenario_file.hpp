// Scenarios as YAML files; docs/reference/files.md documents the keys.
#pragma once

#include <filesystem>
#include <string>

#include "firmware/sim/world/scenario.hpp"

namespace groma::sim {

// Throws io::ConfigError with line and column of an invalid entry. `path` only names the text in messages.
[[nodiscard]] Scenario parse_scenario(const std::filesystem::path& path, const std::string& text);

// As parse_scenario(). Also throws as io::read_configuration() does.
[[nodiscard]] Scenario read_scenario(const std::filesystem::path& path);

}  // namespace groma::sim
