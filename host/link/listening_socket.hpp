// A socket that listens at a port of this computer.
#pragma once

#include <cstdint>
#include <string>

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

}  // namespace groma::link
