// Power cuts at a few instants of each flash operation; the campaign (power_cut_campaign.cpp) has more.
#include "test/sim/emulator/power_cut.hpp"

namespace groma::sim {
namespace {

TEST(PowerCut, DuringAWriteLeavesOneConfiguration) {
  cut_power_everywhere({});
}

TEST(PowerCut, DuringAMoveToTheOtherPageLeavesOneConfiguration) {
  cut_power_everywhere({.page_full = true});
}

}  // namespace
}  // namespace groma::sim
