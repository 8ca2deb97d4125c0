// The key `web` of the configuration.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

#include "host/daemon/tcp_listener.hpp"
#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/io/yaml_type.hpp"
#include "host/web/access.hpp"
#include "host/web/server.hpp"

namespace groma::daemon {

struct WebSettings {
  struct Tls {
    std::filesystem::path certificate;  // PEM: the chain, the server's first
    std::filesystem::path key;          // PEM
  };
  // A wall on the page's map, from one point to another; map frame, m.
  struct Wall {
    Eigen::Vector2d from_m;
    Eigen::Vector2d to_m;
  };

  Endpoint endpoint{.address = "127.0.0.1", .port = 4722};
  std::vector<std::string> hosts;    // as web::AccessRules
  std::vector<std::string> origins;  // likewise
  std::optional<std::filesystem::path> token_file;
  std::optional<Tls> tls;
  std::vector<Wall> walls;
  bool is_simulated = false;  // the page says so
};

[[nodiscard]] io::YamlType web_type();
// Throws io::ConfigError or io::DataError. It does not read the files of token and TLS.
[[nodiscard]] WebSettings parse_web(const io::YamlValue& yaml, const std::filesystem::path& folder,
                                    io::InputFiles& files);

// The content of the files that only gromad may read: they are in no log or report.
struct WebSecrets {
  web::AccessRules access;
  std::optional<web::TlsTexts> tls;
};

// Throws io::DataError, io::PermissionError or io::ConfigError, with the file, the cause and the remedy, if a
// file cannot be read, others may read it, or it is no token, certificate or key.
[[nodiscard]] WebSecrets read_secrets(const WebSettings& settings);

}  // namespace groma::daemon
