#include "host/provision/debug_probe.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>

#include "host/provision/flash.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::provision {
namespace {

using groma::test::ScratchFolder;
using ::testing::HasSubstr;

class DebugProbeTest : public ::testing::Test {
 protected:
  // Creates the sysfs files of a USB device.
  void add(const std::string& port, const std::string& vendor, const std::string& product_id,
           const std::string& serial, const std::string& product, const std::string& interface = "",
           const std::string& tty = "") {
    const std::string folder = "sys/" + port + "/";
    scratch_.write(folder + "idVendor", vendor + "\n");
    scratch_.write(folder + "idProduct", product_id + "\n");
    if (!serial.empty()) scratch_.write(folder + "serial", serial + "\n");
    scratch_.write(folder + "product", product + "\n");
    scratch_.write(folder + "busnum", "1\n");
    scratch_.write(folder + "devnum", port.substr(2) + "\n");
    scratch_.write(folder + port + ":1.0/bInterfaceNumber", "00\n");
    if (!interface.empty()) scratch_.write(folder + port + ":1.0/interface", interface + "\n");
    if (!tty.empty()) scratch_.write(folder + port + ":1.0/tty/" + tty + "/dev", "166:0\n");
  }
  std::vector<DebugProbe> find() { return find_debug_probes(scratch_ / "sys", scratch_ / "dev"); }

  ScratchFolder scratch_;
};

TEST_F(DebugProbeTest, ProbesAreFoundAmongOtherDevices) {
  add("1-2", "1366", "1015", "000760012345", "J-Link", "", "ttyACM0");
  add("1-3", "046d", "c52b", "", "USB Receiver");
  add("1-4", "0d28", "0204", "0227000012345678", "DAPLink CMSIS-DAP");
  add("1-5", "2e8a", "000c", "E6614", "Debug Probe (by its interface)", "CMSIS-DAP v2 Interface");
  const std::vector<DebugProbe> probes = find();
  ASSERT_EQ(probes.size(), 3U);
  EXPECT_EQ(probes[0].adapter, Adapter::kJlink);
  EXPECT_EQ(probes[0].usb_id, "1366:1015");
  EXPECT_EQ(probes[0].serial, "000760012345");
  EXPECT_EQ(probes[0].device, scratch_ / "dev/bus/usb/001/002");
  EXPECT_THAT(probes[0].serial_ports, ::testing::ElementsAre(scratch_ / "dev/ttyACM0"));
  EXPECT_EQ(probes[1].adapter, Adapter::kCmsisDap);
  EXPECT_EQ(probes[2].adapter, Adapter::kCmsisDap);
  EXPECT_TRUE(probes[2].serial_ports.empty());
}

TEST_F(DebugProbeTest, WithoutUsbThereAreNone) {
  EXPECT_TRUE(find().empty());
}

TEST_F(DebugProbeTest, TheOnlyProbeIsChosen) {
  add("1-2", "1366", "1015", "000760012345", "J-Link");
  const auto probes = find();
  EXPECT_EQ(choose_probe(probes, std::nullopt, "").probe, &probes[0]);
  EXPECT_EQ(choose_probe(probes, Adapter::kJlink, "").probe, &probes[0]);
  EXPECT_EQ(choose_probe(probes, std::nullopt, "760012345").probe, &probes[0]);  // leading zeros
}

TEST_F(DebugProbeTest, AFailedChoiceIsExplained) {
  const ChosenProbe none = choose_probe({}, std::nullopt, "");
  EXPECT_EQ(none.fault, FlashFault::kNoProbe);
  EXPECT_THAT(none.message, HasSubstr("no debug probe (J-Link or CMSIS-DAP) on USB; plug it in"));

  add("1-2", "1366", "1015", "000760012345", "J-Link");
  add("1-4", "0d28", "0204", "0227", "DAPLink CMSIS-DAP");
  const auto probes = find();
  const ChosenProbe many = choose_probe(probes, std::nullopt, "");
  EXPECT_EQ(many.fault, FlashFault::kManyProbes);
  EXPECT_THAT(many.message,
              HasSubstr("choose one by --probe: jlink 000760012345 (J-Link), cmsis-dap 0227 (DAPLink"));
  EXPECT_EQ(choose_probe(probes, Adapter::kCmsisDap, "").probe, &probes[1]);

  const ChosenProbe other = choose_probe(probes, std::nullopt, "4711");
  EXPECT_EQ(other.fault, FlashFault::kOtherSerial);
  EXPECT_THAT(other.message,
              HasSubstr("no debug probe has the serial number 4711; there are: jlink 000760012345"));
  EXPECT_EQ(choose_probe(probes, Adapter::kJlink, "0227").fault, FlashFault::kOtherSerial);
}

TEST_F(DebugProbeTest, AMissingPermissionIsExplained) {
  add("1-2", "1366", "1015", "000760012345", "J-Link");
  auto probes = find();
  EXPECT_TRUE(probes[0].accessible);  // its device node does not exist: OpenOCD will report that
  probes[0].accessible = false;
  const ChosenProbe chosen = choose_probe(probes, std::nullopt, "");
  EXPECT_EQ(chosen.fault, FlashFault::kPermission);
  EXPECT_THAT(chosen.message, HasSubstr("bus/usb/001/002: this user may not use the probe 000760012345"));
  EXPECT_THAT(chosen.message, HasSubstr(".rules"));
}

TEST(UdevRules, CoverTheProbesAndThePorts) {
  for (const char* id :
       {"\"1366\"", "\"0d28\"", "\"0204\"", "CMSIS-DAP", "\"0403\"", "\"10c4\"", "plugdev", "dialout"}) {
    EXPECT_THAT(std::string(udev_rules()), HasSubstr(id));
  }
}

}  // namespace
}  // namespace groma::provision
