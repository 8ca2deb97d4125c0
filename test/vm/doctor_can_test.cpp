// groma doctor on a CAN interface that is down, then up.
#include <gtest/gtest.h>

#include "host/doctor/doctor.hpp"
#include "test/support/virtual_can.hpp"

namespace groma::doctor {
namespace {

TEST(DoctorOnCan, NamesAnInterfaceThatIsDown) {
  test::VirtualCan can("doctor0");
  daemon::Config config;
  config.nodes = {{"can:doctor0/1"}};
  const Subject subject{.config = config};
  EXPECT_EQ(check_can_buses(config).at(0).verdict, Verdict::kGood);
  can.down();
  EXPECT_EQ(check_can_buses(config).at(0).fault, "can-down");
  EXPECT_EQ(check_links(subject).at(0).fault, "can-down");
  can.up();
  EXPECT_EQ(check_can_buses(config).at(0).verdict, Verdict::kGood);
  EXPECT_EQ(check_links(subject).at(1).fault, "silent-node");
}

}  // namespace
}  // namespace groma::doctor
