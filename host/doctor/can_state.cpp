#include "host/doctor/can_state.hpp"

#include <linux/can/netlink.h>
#include <linux/if_link.h>
#include <linux/rtnetlink.h>
#include <net/if.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cstring>

#include "host/io/descriptor.hpp"

namespace groma::doctor {
namespace {

using Bytes = std::span<const std::uint8_t>;

// In the order of enum can_state.
constexpr std::array<const char*, 6> kStates{"error-active", "error-warning", "error-passive",
                                             "bus-off",      "stopped",       "sleeping"};

template <typename Value>
std::optional<Value> value_at(Bytes bytes) {
  if (bytes.size() < sizeof(Value)) return std::nullopt;
  Value value{};
  std::memcpy(&value, bytes.data(), sizeof(value));
  return value;
}

// The content of the first attribute of that type; nothing if there is none.
std::optional<Bytes> find_attribute(Bytes attributes, unsigned type) {
  while (const auto head = value_at<rtattr>(attributes)) {
    if (head->rta_len < sizeof(rtattr) || head->rta_len > attributes.size()) return std::nullopt;
    if ((head->rta_type & ~static_cast<unsigned>(NLA_F_NESTED)) == type) {
      return attributes.first(head->rta_len).subspan(RTA_LENGTH(0));
    }
    attributes = attributes.subspan(std::min<std::size_t>(RTA_ALIGN(head->rta_len), attributes.size()));
  }
  return std::nullopt;
}

std::optional<std::uint32_t> number_of(Bytes attributes, unsigned type) {
  const auto found = find_attribute(attributes, type);
  return found ? value_at<std::uint32_t>(*found) : std::nullopt;
}

struct Request {
  nlmsghdr head{};
  ifinfomsg link{};
};

}  // namespace

std::optional<CanState> parse_can_state(Bytes message) {
  const auto head = value_at<nlmsghdr>(message);
  if (!head || head->nlmsg_type != RTM_NEWLINK || head->nlmsg_len > message.size() ||
      head->nlmsg_len < NLMSG_LENGTH(sizeof(ifinfomsg))) {
    return std::nullopt;
  }
  const Bytes body = message.first(head->nlmsg_len).subspan(NLMSG_HDRLEN);
  CanState state;
  state.is_up = (value_at<ifinfomsg>(body)->ifi_flags & static_cast<unsigned>(IFF_UP)) != 0;
  const Bytes attributes = body.subspan(std::min<std::size_t>(NLMSG_ALIGN(sizeof(ifinfomsg)), body.size()));
  const auto information = find_attribute(attributes, IFLA_LINKINFO);
  const auto can = information ? find_attribute(*information, IFLA_INFO_DATA) : std::nullopt;
  if (!can) return state;
  if (const auto number = number_of(*can, IFLA_CAN_STATE); number && *number < kStates.size()) {
    state.controller = kStates.at(*number);
  }
  if (const auto timing = find_attribute(*can, IFLA_CAN_BITTIMING)) {
    state.bit_per_s = value_at<std::uint32_t>(*timing).value_or(0);  // the first member of can_bittiming
  }
  state.restart_ms = number_of(*can, IFLA_CAN_RESTART_MS).value_or(0);
  return state;
}

std::optional<CanState> read_can_state(const std::string& interface) {
  Request request;
  request.head.nlmsg_len = sizeof(request);
  request.head.nlmsg_type = RTM_GETLINK;
  request.head.nlmsg_flags = NLM_F_REQUEST;
  request.link.ifi_family = AF_UNSPEC;
  request.link.ifi_index = static_cast<int>(::if_nametoindex(interface.c_str()));
  if (request.link.ifi_index == 0) return std::nullopt;
  const io::Descriptor socket(::socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC, NETLINK_ROUTE));
  const timeval patience{1, 0};
  std::array<std::uint8_t, 32768> answer{};
  if (!socket.valid() ||
      ::setsockopt(socket.get(), SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof(patience)) != 0 ||
      ::send(socket.get(), &request, sizeof(request), 0) != static_cast<ssize_t>(sizeof(request))) {
    return std::nullopt;
  }
  const ssize_t size = ::recv(socket.get(), answer.data(), answer.size(), 0);
  if (size <= 0) return std::nullopt;
  return parse_can_state(Bytes(answer).first(static_cast<std::size_t>(size)));
}

}  // namespace groma::doctor
