// A second board in the emulator: firmware/board/nrf52832_dw1000, an nRF52832 and a DW1000 without a module.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <string>

#include "test/board/image_file.hpp"
#include "test/sim/emulator/emulated_site.hpp"
#include "test/sim/emulator/soc_bench.hpp"

namespace groma::sim {
namespace {

using testing::HasSubstr;

constexpr BoardWiring kBareBoard{
    .radio = {.spi = {.sck = 12, .mosi = 13, .miso = 15}, .select = 14, .interrupt = 16},
    .radio_reset = 11,
    .can = std::nullopt,
    .host = {.txd = 6, .rxd = 8},
    .lights = {25, 25, 26, 27},
    .lights_active_low = false,
    .slow_crystal = false};
constexpr unsigned kRadioWakeUp = 17;

EmulatorOptions on(const BoardWiring& board) {
  EmulatorOptions options;
  options.board = board;
  return options;
}

const FirmwareImage& bare_board_image() {
  static const FirmwareImage image = read_firmware_image(test::image_file(test::kBareBoardImage, ".hex"));
  return image;
}

// A site of which all nodes are such boards.
SiteSettings of_bare_boards(SiteSettings settings) {
  settings.make_node = [](const NodeSpec& spec, Medium& medium) {
    return make_emulated_node(spec, bare_board_image(), medium, on(kBareBoard));
  };
  return settings;
}

class BareBoard : public testing::Test {
 protected:
  void SetUp() override { GROMA_NEEDS_SHIPPED_IMAGE(); }
};

TEST_F(BareBoard, RangesToAnAnchorOfItsKind) {
  SiteBench site(of_bare_boards({.tags = 1, .anchors = 1}));
  site.run_until(2.0);
  for (const Listener& listener : site.listeners) {
    ASSERT_EQ(listener.hellos.size(), 1U);
    EXPECT_STREQ(listener.hellos[0].radio_error, "");
    EXPECT_EQ(listener.undecodable, 0);
  }
  const double true_m = site.space.distance_m(nth_tag(0), nth_anchor(0));
  double worst_m = 0.0;
  site.each_range(
      [&](const auto&, const groma_Range& range) {
        EXPECT_EQ(range.status, groma_RangeStatus_RANGE_OK);
        worst_m = std::max(worst_m, std::abs(static_cast<double>(range.range_m) - true_m));
      },
      1.0);
  EXPECT_LT(worst_m, 0.05);
  EXPECT_GT(site.good_ranges(1.0), 0.95 / seconds_of(site.superframe()));
}

TEST_F(BareBoard, DrivesItsLedsHighAndTheRadiosWakeUpLow) {
  SiteBench site(of_bare_boards({.tags = 1, .anchors = 1}));
  constexpr std::size_t kRed = 0;
  constexpr std::size_t kGreen = 2;
  constexpr std::size_t kBlue = 3;
  // Synchronized: green is lit for 50 ms of each second.
  int green = 0;
  for (int t_ms = 1'000; t_ms < 2'000; t_ms += 10) {
    site.run_until(1e-3 * t_ms);
    const Nrf52832& soc = emulated(site, 0).soc();
    green += soc.lit(kGreen) ? 1 : 0;
    EXPECT_FALSE(soc.lit(kRed) || soc.lit(kBlue));
    EXPECT_EQ(soc.gpio().drive(kRadioWakeUp), PinDrive::kLow);
  }
  EXPECT_NEAR(green, 5, 1);
}

TEST_F(BareBoard, RefusesACanLinkAndUsesItsUart) {
  SiteSettings settings = of_bare_boards({.tags = 1, .anchors = 1});
  settings.configure = [](groma_Config& config) { config.link = groma_Link_LINK_CAN_FD; };
  SiteBench site(settings);
  site.run_until(1.5);
  ASSERT_FALSE(site.listeners[0].hellos.empty());
  EXPECT_STREQ(site.listeners[0].hellos[0].link_error, "no CAN controller on this board");
  EXPECT_GT(site.good_ranges(), 0);
}

// The emulator holds an image to the wiring of its board.
TEST_F(BareBoard, FailsWithTheWiringOfAnother) {
  const auto error_on = [](const BoardWiring& board) {
    return SocBench::error_of([&] {
      FreeSpace space;
      space.put(1, {});
      Network network(space, {}, 1);
      NodeSpec spec;
      spec.chip.id = 1;
      network.add(make_emulated_node(spec, bare_board_image(), network.medium(), on(board)));
      network.run_until(from_seconds(0.2));  // the first boot erases a page of flash
    });
  };
  EXPECT_EQ(error_on(kBareBoard), "");
  EXPECT_THAT(error_on(kDwm1001), HasSubstr("TXD and RXD are not the pins that lead to the host"));
  BoardWiring other = kBareBoard;
  other.radio.spi.miso = kDwm1001.radio.spi.miso;
  EXPECT_THAT(error_on(other), HasSubstr("SPIM2: SCK, MOSI and MISO are not the pins that lead to its chip"));
  other = kBareBoard;
  other.radio.select = 3;  // a pin that this board leaves open
  EXPECT_THAT(error_on(other), HasSubstr("SPIM2: a transfer while no chip is selected"));
}

TEST_F(BareBoard, LacksTheCrystalThatTheDwm1001Starts) {
  BoardWiring without_crystal = kDwm1001;
  without_crystal.slow_crystal = false;
  SiteBench site(emulating({.tags = 1, .anchors = 1}, on(without_crystal)));
  EXPECT_THAT(SocBench::error_of([&] { site.run_until(0.1); }), HasSubstr("LFCLKSTART by the crystal"));
}

}  // namespace
}  // namespace groma::sim
