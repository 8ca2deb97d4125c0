// Tests that the virtual machine is as documented in test/vm/run.
#include <gtest/gtest.h>
#include <net/if.h>
#include <sys/stat.h>
#include <sys/utsname.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>

namespace groma {
namespace {

TEST(VirtualMachine, RunsDebiansKernel) {
  utsname name{};
  ASSERT_EQ(::uname(&name), 0);
  EXPECT_NE(std::string(name.version).find("Debian"), std::string::npos) << name.version;
}

TEST(VirtualMachine, HasACanInterfaceWithFdFrames) {
  ASSERT_NE(::if_nametoindex("vcan0"), 0U);
  std::ifstream file("/sys/class/net/vcan0/mtu");
  int mtu = 0;
  file >> mtu;
  EXPECT_EQ(mtu, 72);
}

TEST(VirtualMachine, AllowsWritesOnlyToTheTemporaryFolder) {
  const std::filesystem::path scratch = std::filesystem::temp_directory_path() / "scratch";
  std::ofstream(scratch) << "x";
  EXPECT_TRUE(std::filesystem::exists(scratch));
  const std::string here = std::filesystem::current_path() / "scratch";
  std::ofstream(here) << "x";
  EXPECT_FALSE(std::filesystem::exists(here));
}

TEST(VirtualMachine, HasAUsbSerialPort) {
  struct stat status {};
  for (int wait = 0; wait < 100 && ::stat("/dev/ttyUSB0", &status) != 0; ++wait) ::usleep(100'000);
  EXPECT_TRUE(S_ISCHR(status.st_mode));
  EXPECT_EQ(::access("/dev/groma-usb-far-end", R_OK | W_OK), 0);
  EXPECT_EQ(::access("/dev/groma-monitor", R_OK | W_OK), 0);
}

}  // namespace
}  // namespace groma
