// Values that several keys of the configuration have.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "host/daemon/tcp_listener.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/io/yaml_type.hpp"

namespace groma::daemon {

// A path relative to the folder. Throws io::ConfigError if the text is empty.
[[nodiscard]] std::filesystem::path parse_path(const io::YamlValue& yaml,
                                               const std::filesystem::path& folder);

// The keys `address` and `port`.
[[nodiscard]] std::vector<io::YamlKey> endpoint_keys();
// Keys that are absent keep their values. Throws io::ConfigError if the address is not numeric.
void parse_endpoint(const io::YamlValue& yaml, Endpoint& endpoint);

}  // namespace groma::daemon
