// Power cuts with the longest configuration, at many instants of each flash operation.
#include "test/sim/emulator/power_cut.hpp"

namespace groma::sim {
namespace {

std::vector<double> many_instants() {
  std::vector<double> after_us;
  for (int i = 0; i <= 11; ++i) after_us.push_back(33.0 * i);
  for (int i = 1; i <= 8; ++i) after_us.push_back(10'000.0 * i);
  return after_us;
}

constexpr int kMostAnchors = 12;

TEST(PowerCutCampaign, AtAnyWriteLeavesOneConfiguration) {
  cut_power_everywhere({.anchors = kMostAnchors, .after_us = many_instants()});
}

TEST(PowerCutCampaign, AtAnyWriteOfAMoveToTheOtherPageLeavesOneConfiguration) {
  cut_power_everywhere({.page_full = true, .anchors = kMostAnchors, .after_us = many_instants()});
}

}  // namespace
}  // namespace groma::sim
