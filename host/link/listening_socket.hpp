// A socket that listens at a port of this computer.
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "host/link/byte_link.hpp"
#include "host/link/descriptor.hpp"

namespace groma::link {

struct ListeningSocket {
  Descriptor fd;  // non-blocking; not valid on failure
  int error = 0;  // errno of the failure
};

// address: numeric, IPv4 or IPv6. port: 0 means any free one. type: SOCK_STREAM, which also listens, with
// that backlog, or SOCK_DGRAM.
[[nodiscard]] ListeningSocket listen_at(const std::string& address, std::uint16_t port, int type,
                                        int backlog);

// Explains that error, or that of a Unix socket. where: the address, port or file. key: its key in the
// configuration.
[[nodiscard]] LinkError explain_listen_error(const std::string& where, int error_number,
                                             std::string_view key);

}  // namespace groma::link
