// The state of a CAN interface in the kernel's answer, by bytes that the test writes.
#include "host/doctor/can_state.hpp"

#include <gtest/gtest.h>
#include <linux/can/netlink.h>
#include <linux/if_link.h>
#include <linux/rtnetlink.h>
#include <net/if.h>

#include <cstring>

namespace groma::doctor {
namespace {

using Bytes = std::vector<std::uint8_t>;

template <typename Value>
Bytes bytes_of(const Value& value) {
  Bytes out(sizeof(value));
  std::memcpy(out.data(), &value, sizeof(value));
  return out;
}

Bytes attribute(unsigned short type, const Bytes& content) {
  Bytes out = bytes_of(rtattr{static_cast<unsigned short>(RTA_LENGTH(content.size())), type});
  out.insert(out.end(), content.begin(), content.end());
  out.resize(RTA_ALIGN(out.size()));
  return out;
}

Bytes joined(std::initializer_list<Bytes> all) {
  Bytes out;
  for (const Bytes& each : all) out.insert(out.end(), each.begin(), each.end());
  return out;
}

// The answer for an interface of kind `kind` with that data.
Bytes answer(unsigned flags, const std::string& kind, const Bytes& data) {
  ifinfomsg link{};
  link.ifi_flags = flags;
  const Bytes name{'c', 'a', 'n', '0', 0};
  const Bytes body = joined({bytes_of(link), attribute(IFLA_IFNAME, name),
                             attribute(IFLA_LINKINFO | NLA_F_NESTED,
                                       joined({attribute(IFLA_INFO_KIND, Bytes(kind.begin(), kind.end())),
                                               attribute(IFLA_INFO_DATA | NLA_F_NESTED, data)}))});
  nlmsghdr head{};
  head.nlmsg_len = static_cast<std::uint32_t>(NLMSG_LENGTH(body.size()));
  head.nlmsg_type = RTM_NEWLINK;
  return joined({bytes_of(head), body});
}

Bytes controller(std::uint32_t state) {
  can_bittiming timing{};
  timing.bitrate = 500'000;
  return joined({attribute(IFLA_CAN_BITTIMING, bytes_of(timing)), attribute(IFLA_CAN_STATE, bytes_of(state)),
                 attribute(IFLA_CAN_RESTART_MS, bytes_of(std::uint32_t{100}))});
}

TEST(CanState, IsReadFromTheKernelsAnswer) {
  const auto active = parse_can_state(answer(IFF_UP, "can", controller(CAN_STATE_ERROR_ACTIVE)));
  ASSERT_TRUE(active);
  EXPECT_TRUE(active->is_up);
  EXPECT_EQ(active->controller, "error-active");
  EXPECT_EQ(active->bit_per_s, 500'000U);
  EXPECT_EQ(active->restart_ms, 100U);
  EXPECT_EQ(parse_can_state(answer(IFF_UP, "can", controller(CAN_STATE_BUS_OFF)))->controller, "bus-off");
  const auto down = parse_can_state(answer(0, "can", controller(CAN_STATE_STOPPED)));
  EXPECT_FALSE(down->is_up);
  EXPECT_EQ(down->controller, "stopped");
  EXPECT_EQ(parse_can_state(answer(IFF_UP, "can", controller(77)))->controller, "");
  EXPECT_EQ(parse_can_state(answer(IFF_UP, "vcan", {}))->controller, "");
}

TEST(CanState, OfATornAnswerIsNothingOrIncomplete) {
  const Bytes whole = answer(IFF_UP, "can", controller(CAN_STATE_BUS_OFF));
  for (std::size_t size = 0; size < whole.size(); ++size) {
    EXPECT_FALSE(parse_can_state(std::span(whole).first(size))) << size;
  }
  // Lengths of attributes that contradict the message.
  for (std::size_t at = sizeof(nlmsghdr); at < whole.size(); ++at) {
    for (const int value : {0, 1, 255}) {
      Bytes damaged = whole;
      damaged[at] = static_cast<std::uint8_t>(value);
      static_cast<void>(parse_can_state(damaged));
    }
  }
}

TEST(CanState, OfAnInterfaceThatDoesNotExist) {
  EXPECT_FALSE(read_can_state("nocan7"));
  const auto loopback = read_can_state("lo");
  ASSERT_TRUE(loopback);
  EXPECT_EQ(loopback->controller, "");
}

}  // namespace
}  // namespace groma::doctor
