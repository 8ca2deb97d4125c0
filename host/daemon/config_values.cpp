#include "host/daemon/config_values.hpp"

#include <cstdint>
#include <limits>

#include "host/web/access.hpp"

namespace groma::daemon {
namespace {

constexpr auto kMaxPort = std::numeric_limits<std::uint16_t>::max();

}  // namespace

std::filesystem::path parse_path(const io::YamlValue& yaml, const std::filesystem::path& folder) {
  const std::string text = yaml.text();
  if (text.empty()) yaml.fail("is empty", "name a path");
  return folder / text;
}

std::vector<io::YamlKey> endpoint_keys() {
  return {{"address", io::YamlType::text(), "Numeric address of an interface; 0.0.0.0: all.", false},
          {"port", io::YamlType::integer(0, kMaxPort), "TCP port; 0: any free one.", false}};
}

void parse_endpoint(const io::YamlValue& yaml, Endpoint& endpoint) {
  if (const auto address = yaml.find("address")) {
    endpoint.address = address->text();
    if (!web::is_numeric_address(endpoint.address)) {
      address->fail("is not a numeric address",
                    "write 127.0.0.1 for this computer only, 0.0.0.0 for the network");
    }
  }
  if (const auto port = yaml.find("port")) {
    endpoint.port = static_cast<std::uint16_t>(port->integer(0, kMaxPort));
  }
}

}  // namespace groma::daemon
