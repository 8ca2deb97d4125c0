// The real OpenOCD flashes an emulated part; tests of its failures, and of its messages for failures of USB.
#include "host/provision/flash.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "host/provision/process.hpp"
#include "test/host/provision/emulated_part.hpp"
#include "test/host/provision/emulated_probe.hpp"
#include "test/host/provision/small_image.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::provision {
namespace {

using groma::test::ScratchFolder;
using test::EmulatedPart;
using test::EmulatedProbe;
using ::testing::HasSubstr;

class FlashTest : public ::testing::Test {
 protected:
  static constexpr std::size_t kImageBytes = 2 * 4096 + 100;

  void SetUp() override {
    scratch_.write("node.hex", test::hex_of(image_) + test::kHexEnd);
    scratch_.write("probe.cfg", test::probe_configuration(scratch_.path()));
    const auto openocd = find_program("openocd");
    ASSERT_TRUE(openocd) << "scripts/setup test installs it";
    request_.openocd = *openocd;
    request_.image = read_node_image(scratch_ / "node.hex");
    request_.interface = scratch_ / "probe.cfg";
    request_.own_interface = true;
    request_.serial = "a";
  }
  // nullptr: nothing is wired to the probe.
  void plug_in(EmulatedPart* part) { probe_ = std::make_unique<EmulatedProbe>(scratch_ / "a.sock", part); }
  void unplug() {
    probe_.reset();
    std::filesystem::remove(scratch_ / "a.sock");
  }
  FlashOutcome run() {
    std::vector<std::string> phases;
    FlashOutcome outcome = flash(request_, [&](const char* phase) { phases.emplace_back(phase); });
    phases_ = phases;
    return outcome;
  }
  [[nodiscard]] bool holds_image() const {
    return std::equal(image_.begin(), image_.end(), part_.flash().begin());
  }

  ScratchFolder scratch_;
  std::vector<std::uint8_t> image_ = test::small_image(kImageBytes);
  EmulatedPart part_;
  std::unique_ptr<EmulatedProbe> probe_;
  FlashRequest request_;
  std::vector<std::string> phases_;
};

TEST_F(FlashTest, AnEmptyPartGetsTheImageAndRuns) {
  plug_in(&part_);
  const FlashOutcome outcome = run();
  EXPECT_EQ(outcome.fault, FlashFault::kNone) << outcome.output;
  EXPECT_TRUE(outcome.changed);
  EXPECT_TRUE(holds_image());
  EXPECT_FALSE(part_.halted());
  EXPECT_EQ(part_.pages_erased(), 3);
  EXPECT_EQ(part_.mass_erases(), 0);
  EXPECT_THAT(phases_, ::testing::ElementsAre("connecting", "verifying", "writing", "verifying"));
}

TEST_F(FlashTest, APartWithTheImageIsNotWrittenAgain) {
  plug_in(&part_);
  ASSERT_EQ(run().fault, FlashFault::kNone);
  const int words = part_.words_written();
  const FlashOutcome again = run();
  EXPECT_EQ(again.fault, FlashFault::kNone) << again.output;
  EXPECT_FALSE(again.changed);
  EXPECT_EQ(part_.words_written(), words);
  EXPECT_EQ(part_.pages_erased(), 3);
  EXPECT_FALSE(part_.halted());
}

TEST_F(FlashTest, ALockedPartIsReportedAndNotChanged) {
  part_.lock();
  plug_in(&part_);
  const FlashOutcome outcome = run();
  EXPECT_EQ(outcome.fault, FlashFault::kLocked) << outcome.output;
  EXPECT_THAT(outcome.message, HasSubstr("the part is locked (APPROTECT)"));
  EXPECT_THAT(outcome.message, HasSubstr("--recover unlocks it, and erases all"));
  EXPECT_FALSE(outcome.changed);
  EXPECT_EQ(part_.mass_erases(), 0);
}

TEST_F(FlashTest, RecoverErasesOnlyALockedPart) {
  part_.lock();
  plug_in(&part_);
  request_.recover = true;
  const FlashOutcome outcome = run();
  EXPECT_EQ(outcome.fault, FlashFault::kNone) << outcome.output;
  EXPECT_TRUE(outcome.recovered);
  EXPECT_TRUE(holds_image());
  EXPECT_FALSE(part_.locked());
  EXPECT_EQ(part_.mass_erases(), 1);

  const FlashOutcome again = run();  // it is unlocked now: its content stays
  EXPECT_EQ(again.fault, FlashFault::kNone) << again.output;
  EXPECT_FALSE(again.recovered);
  EXPECT_FALSE(again.changed);
  EXPECT_EQ(part_.mass_erases(), 1);
}

TEST_F(FlashTest, VerificationReportsDefectiveFlash) {
  part_.break_flash_at(0x400);
  plug_in(&part_);
  const FlashOutcome outcome = run();
  EXPECT_EQ(outcome.fault, FlashFault::kVerify) << outcome.output;
  EXPECT_THAT(outcome.message, HasSubstr("what is in flash is not the image"));
}

TEST_F(FlashTest, AMissingTargetIsReported) {
  plug_in(nullptr);
  const FlashOutcome outcome = run();
  EXPECT_EQ(outcome.fault, FlashFault::kNoTarget) << outcome.output;
  EXPECT_THAT(outcome.message, HasSubstr("check that the module has power, and SWDIO, SWCLK and GND"));
}

TEST_F(FlashTest, AnUnknownFailureIsReportedInOpenOcdsWords) {
  const FlashOutcome outcome = run();  // no socket
  EXPECT_EQ(outcome.fault, FlashFault::kOther);
  EXPECT_THAT(outcome.message, HasSubstr("OpenOCD failed (Error on socket 'connect'"));
}

class UnpluggedAt : public FlashTest, public ::testing::WithParamInterface<int> {};

// Parameter: the number of words written when the probe is unplugged; 0 is before the first erase.
TEST_P(UnpluggedAt, ItIsReportedAndARepetitionSucceeds) {
  plug_in(&part_);
  const int word = GetParam();
  probe_->set_unplug([&] { return word == 0 ? part_.halted() : part_.words_written() >= word; });
  const FlashOutcome cut = run();
  EXPECT_EQ(cut.fault, FlashFault::kProbeLost) << cut.output;
  EXPECT_THAT(cut.message, HasSubstr("the probe went away in the middle"));
  EXPECT_FALSE(holds_image());

  unplug();
  plug_in(&part_);
  const FlashOutcome resumed = run();
  EXPECT_EQ(resumed.fault, FlashFault::kNone) << resumed.output;
  EXPECT_TRUE(resumed.changed);
  EXPECT_TRUE(holds_image());
}

INSTANTIATE_TEST_SUITE_P(FlashTest, UnpluggedAt, ::testing::Values(0, 1, 1024, 2000));

// ---- failures of USB: messages of OpenOCD 0.12.0 and libjaylink 0.3.1 -----------------------------------

FlashFault fault_of(const std::string& output) {
  return read_openocd(1, output, {}).fault;
}

TEST(ReadOpenOcd, EachCauseIsFoundFromTheOutput) {
  EXPECT_EQ(fault_of("swd\nError: No J-Link device found\n** OpenOCD init failed **\n"),
            FlashFault::kNoProbe);
  EXPECT_EQ(fault_of("Error: unable to find a matching CMSIS-DAP device\n** OpenOCD init failed **\n"),
            FlashFault::kNoProbe);
  EXPECT_EQ(fault_of("Error: Multiple devices found, specify the desired device\n"), FlashFault::kManyProbes);
  EXPECT_EQ(fault_of("Error: Failed to open device: LIBUSB_ERROR_ACCESS\nError: No J-Link device found\n"),
            FlashFault::kPermission);
  EXPECT_EQ(fault_of("Error: could not open device 0x0d28:0x0204: Access denied (insufficient permissions)\n"
                     "Error: unable to find a matching CMSIS-DAP device\n"),
            FlashFault::kPermission);
  EXPECT_EQ(fault_of("Error: Failed to claim interface: LIBUSB_ERROR_BUSY\nError: No J-Link device found\n"),
            FlashFault::kBusy);
  EXPECT_EQ(fault_of("Warn : could not claim interface: Resource busy\n"
                     "Error: unable to find a matching CMSIS-DAP device\n"),
            FlashFault::kBusy);
  EXPECT_EQ(fault_of("Error: Error connecting DP: cannot read IDR\n** OpenOCD init failed **\n"),
            FlashFault::kNoTarget);
  EXPECT_EQ(fault_of("** Programming Started **\nError: Failed to erase reg: 0x4001e508 val: 0x00000000\n"
                     "** Programming Failed **\n"),
            FlashFault::kWriting);
  EXPECT_EQ(fault_of("Error: never heard of\n"), FlashFault::kOther);
  EXPECT_THAT(read_openocd(1, "Error: Failed to open device: LIBUSB_ERROR_ACCESS\n", {}).message,
              HasSubstr("udev"));
  // Success requires both the exit code and the message.
  EXPECT_EQ(fault_of("** Verified OK **\n"), FlashFault::kOther);
  EXPECT_EQ(read_openocd(0, "nothing\n", {}).fault, FlashFault::kOther);
}

TEST(OpenOcdArguments, AKnownAdapterUsesSwdAndTheSerialNumber) {
  FlashRequest request;
  request.openocd = "/usr/bin/openocd";
  request.image.path = "/a b/node.hex";
  request.interface = "interface/jlink.cfg";
  request.serial = "760012345";
  EXPECT_THAT(
      openocd_arguments(request),
      ::testing::ElementsAre("/usr/bin/openocd", "-f", "interface/jlink.cfg", "-c", "transport select swd",
                             "-c", "adapter serial {760012345}", "-f", "target/nrf52.cfg", "-c",
                             "gdb_port disabled", "-c", "telnet_port disabled", "-c", "tcl_port disabled",
                             "-c", "program {/a b/node.hex} preverify verify reset exit"));
}

// OpenOCD accepts the adapters' files and commands: it gets as far as looking for the probe.
TEST(OpenOcdArguments, OpenOcdAcceptsThemForEachAdapter) {
  const auto openocd = find_program("openocd");
  ASSERT_TRUE(openocd) << "scripts/setup test installs it";
  for (const Adapter adapter : {Adapter::kJlink, Adapter::kCmsisDap}) {
    FlashRequest request;
    request.openocd = *openocd;
    request.image.path = "/none.hex";
    request.interface = std::string("interface/") + word(adapter) + ".cfg";
    request.serial = "4294967295";
    for (const bool recover : {false, true}) {
      request.recover = recover;
      const FlashOutcome outcome = flash(request);
      EXPECT_EQ(outcome.fault, FlashFault::kNoProbe) << outcome.output;
    }
  }
}

TEST(Flash, APathWithBracesIsRefused) {
  FlashRequest request;
  request.image.path = "/a}b.hex";
  const FlashOutcome outcome = flash(request);
  EXPECT_EQ(outcome.fault, FlashFault::kOther);
  EXPECT_THAT(outcome.message, HasSubstr("/a}b.hex: OpenOCD accepts no braces"));
}

}  // namespace
}  // namespace groma::provision
