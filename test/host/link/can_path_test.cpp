#include "host/link/can_path.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

#include "host/link/socket_can_link.hpp"

namespace groma::link {
namespace {

using ::testing::AnyOf;
using ::testing::HasSubstr;

TEST(CanPath, NamesFormatInterfaceAndNode) {
  const auto classic = parse_can_path("can:can0/3");
  ASSERT_TRUE(classic);
  EXPECT_EQ(classic->format, wire::CanFormat::kClassic);
  EXPECT_EQ(classic->interface, "can0");
  EXPECT_EQ(classic->node, 3);
  const auto fd = parse_can_path("canfd:a-name.of_15_ch/65535");
  ASSERT_TRUE(fd);
  EXPECT_EQ(fd->format, wire::CanFormat::kFd);
  EXPECT_EQ(fd->interface, "a-name.of_15_ch");
  EXPECT_EQ(fd->node, 65535);
}

TEST(CanPath, RefusesInvalidPaths) {
  for (const char* path :
       {"can:", "can:can0", "can:can0/", "can:/3", "can:can0/x", "can:can0/-1", "can:can0/65536",
        "can:can0/3 ", "can:can0/0x3", "can:can 0/3", "can:can0/1/3", "can:../3", "can:a-name.of_16_chr/3",
        "canfd:can0", "/dev/can0/3", "vcan:can0/3"}) {
    EXPECT_FALSE(parse_can_path(path)) << path;
  }
  EXPECT_TRUE(is_can_path("can:"));
  EXPECT_TRUE(is_can_path("canfd:nonsense"));
  EXPECT_FALSE(is_can_path("can0"));
  EXPECT_FALSE(is_can_path("./can:can0/3"));
}

TEST(CanPath, ALogPathContainsTheFilesPath) {
  const auto path = parse_can_log_path("can-log:/var/log/drive 1.log/12");
  ASSERT_TRUE(path);
  EXPECT_EQ(path->file, "/var/log/drive 1.log");
  EXPECT_EQ(path->node, 12);
  EXPECT_FALSE(parse_can_log_path("can-log:drive.log"));
  EXPECT_FALSE(parse_can_log_path("can-log:drive.log/x"));
  EXPECT_FALSE(parse_can_log_path("drive.log/1"));
}

TEST(OpenSocketCan, ExplainsTheFormOfAPath) {
  const OpenedLink opened = open_link("can:can0", 0);
  EXPECT_FALSE(opened.link);
  EXPECT_EQ(opened.error.fault, LinkFault::kUnsuitable);
  EXPECT_THAT(opened.error.message, HasSubstr("can:can0: "));
  EXPECT_THAT(opened.error.message, HasSubstr("can:can0/3"));
}

TEST(OpenSocketCan, ExplainsAMissingKernelModuleOrInterface) {
  // The kernel may support CAN or not; this interface does not exist.
  const OpenedLink opened = open_link("can:no-such-can/3", 0);
  EXPECT_FALSE(opened.link);
  EXPECT_THAT(opened.error.fault,
              AnyOf(LinkFault::kUnsuitable, LinkFault::kNoDevice, LinkFault::kPermission));
  EXPECT_THAT(opened.error.message, HasSubstr("can:no-such-can/3: "));
  EXPECT_THAT(opened.error.message, AnyOf(HasSubstr("modprobe can-raw"), HasSubstr("there is no interface"),
                                          HasSubstr("may not open CAN sockets")));
}

TEST(OpenSocketCan, ExplainsEachErrorWithItsRemedy) {
  const auto explain = [](int error_number) { return explain_can_error("can:can0/3", "can0", error_number); };
  EXPECT_EQ(explain(EAFNOSUPPORT).fault, LinkFault::kUnsuitable);
  EXPECT_THAT(explain(EAFNOSUPPORT).message, HasSubstr("modprobe can-raw"));
  EXPECT_THAT(explain(EPROTONOSUPPORT).message, HasSubstr("modprobe can-raw"));
  EXPECT_EQ(explain(EPERM).fault, LinkFault::kPermission);
  EXPECT_EQ(explain(ENODEV).fault, LinkFault::kNoDevice);
  EXPECT_EQ(explain(ENETDOWN).fault, LinkFault::kNoDevice);
  EXPECT_THAT(explain(ENETDOWN).message, HasSubstr("ip link set can0 up"));
  EXPECT_EQ(explain(EINVAL).fault, LinkFault::kUnsuitable);
  EXPECT_THAT(explain(EINVAL).message, HasSubstr("Invalid argument"));
}

}  // namespace
}  // namespace groma::link
