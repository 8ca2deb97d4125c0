#include "host/link/usb_port.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <string>

#include "test/host/daemon/temporary_folder.hpp"

namespace groma::link {
namespace {

using ::testing::HasSubstr;

// Devices as Linux shows them under /sys.
class Sysfs : public ::testing::Test {
 protected:
  // A port of a USB device, with its interface and perhaps a device of the driver between them.
  void add(const std::string& port, const std::string& device, const std::string& serial,
           const std::string& below_device) {
    const std::filesystem::path usb = folder_ / "devices/pci0000:00/usb1" / device;
    const std::filesystem::path owner = usb / below_device;
    std::filesystem::create_directories(owner / "tty" / port);
    std::ofstream(usb / "idVendor") << "1366\n";
    if (!serial.empty()) std::ofstream(usb / "serial") << serial << "\n";
    std::filesystem::create_directory_symlink(owner, owner / "tty" / port / "device");
    std::filesystem::create_directories(folder_ / "class/tty");
    std::filesystem::create_directory_symlink(owner / "tty" / port, folder_ / "class/tty" / port);
  }
  [[nodiscard]] std::string port_of(const std::string& serial) const {
    const auto port = find_usb_port(list_usb_ports(folder_.path()), serial);
    return port ? port->name : "none";
  }

  groma::test::TemporaryFolder folder_;
};

TEST_F(Sysfs, FindsThePortsOfADevice) {
  EXPECT_TRUE(list_usb_ports(folder_.path()).empty());
  // The host controller has a serial number too.
  std::filesystem::create_directories(folder_ / "devices/pci0000:00/usb1");
  std::ofstream(folder_ / "devices/pci0000:00/usb1/idVendor") << "1d6b\n";
  std::ofstream(folder_ / "devices/pci0000:00/usb1/serial") << "0000:00:14.0\n";
  add("ttyACM10", "1-2", "000760123456", "1-2:1.2");
  add("ttyACM9", "1-2", "000760123456", "1-2:1.0");
  add("ttyACM0", "1-3", "000760999999", "1-3:1.0");
  add("ttyUSB0", "1-4.1", "A10K4Z", "1-4.1:1.0/ttyUSB0");
  add("ttyACM1", "1-5", "", "1-5:1.0");
  std::filesystem::create_directories(folder_ / "class/tty/console");
  std::filesystem::create_directories(folder_ / "devices/platform/serial8250");
  std::filesystem::create_directories(folder_ / "class/tty/ttyS0");
  std::filesystem::create_directory_symlink(folder_ / "devices/platform/serial8250",
                                            folder_ / "class/tty/ttyS0/device");

  const std::vector<UsbPort> ports = list_usb_ports(folder_.path());
  ASSERT_EQ(ports.size(), 4U);
  EXPECT_EQ(ports[0].name, "ttyACM0");
  EXPECT_EQ(ports[0].serial, "000760999999");
  EXPECT_EQ(port_of("000760123456"), "ttyACM9");
  EXPECT_EQ(port_of("760123456"), "ttyACM9");
  EXPECT_EQ(port_of("a10k4z"), "ttyUSB0");
  EXPECT_EQ(port_of("76012345"), "none");
  EXPECT_EQ(port_of(""), "none");
}

TEST_F(Sysfs, FollowsADeviceThatIsPluggedInElsewhere) {
  add("ttyACM0", "1-2", "000760123456", "1-2:1.0");
  add("ttyACM1", "1-3", "000760999999", "1-3:1.0");
  EXPECT_EQ(port_of("760123456"), "ttyACM0");
  std::filesystem::remove_all(folder_ / "devices");
  std::filesystem::remove_all(folder_ / "class");
  EXPECT_EQ(port_of("760123456"), "none");
  add("ttyACM0", "1-2", "000760999999", "1-2:1.0");
  add("ttyACM1", "1-3", "000760123456", "1-3:1.0");
  EXPECT_EQ(port_of("760123456"), "ttyACM1");
}

TEST(OpenUsbPort, NamesAMissingDevice) {
  const OpenedLink opened = open_link("serial:no-such-number", 1'000'000);
  EXPECT_FALSE(opened.link);
  EXPECT_EQ(opened.error.fault, LinkFault::kNoDevice);
  EXPECT_THAT(opened.error.message,
              HasSubstr("serial:no-such-number: no USB device with this serial number"));
}

}  // namespace
}  // namespace groma::link
