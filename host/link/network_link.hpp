// Nodes behind a network, on serial servers. Their paths, used in place of a device path:
//
//   tcp://HOST:PORT             the server's TCP port for the node's serial line
//   udp://HOST:PORT             datagrams to and from that port, which answers to the port that they came
//   from udp://HOST:PORT/LOCAL       the same, if the server sends to port LOCAL of this computer
//
// HOST is a name, an IPv4 address or an IPv6 address in brackets.
#pragma once

#include <sys/socket.h>

#include <cstddef>
#include <cstdint>
#include <future>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/link/byte_link.hpp"
#include "host/link/descriptor.hpp"

namespace groma::link {

struct NetworkPath {
  bool udp = false;
  std::string host;
  std::uint16_t port = 0;
  std::optional<std::uint16_t> local_port;  // of udp; none: any
};

// Whether the path starts with tcp:// or udp://, valid or not.
[[nodiscard]] bool is_network_path(std::string_view path) noexcept;
[[nodiscard]] std::optional<NetworkPath> parse_network_path(std::string_view path);
inline constexpr std::string_view kNetworkPathAdvice =
    "write it as tcp://HOST:PORT, udp://HOST:PORT or udp://HOST:PORT/LOCALPORT, the ports from 1 to 65535";

// Opens such a link step by step. Names are resolved in a thread of their own.
class NetworkOpener {
 public:
  explicit NetworkOpener(std::string path);

  // Never blocks. Returns the link, or why there is none yet; call it again then.
  [[nodiscard]] OpenedLink open();

 private:
  struct Address {
    sockaddr_storage value{};
    socklen_t size = 0;
  };
  struct Resolution {
    std::vector<Address> addresses;
    std::string error;
  };

  static Resolution resolve(const NetworkPath& path, bool numeric);
  // False while it is under way, or after it failed.
  bool have_addresses();
  // Begins a connection; true if it has been made at once.
  bool connect(const Address& address);
  [[nodiscard]] LinkError explain(int error_number) const;

  std::string name_;
  std::optional<NetworkPath> path_;
  std::future<Resolution> resolution_;
  std::vector<Address> addresses_;  // still to be tried
  Descriptor socket_;               // under way
  LinkError last_error_;
};

// Waits for at most kNetworkPatience_s. For gromad see NetworkOpener.
inline constexpr double kNetworkPatience_s = 5.0;
[[nodiscard]] OpenedLink open_network(const std::string& path);

}  // namespace groma::link
