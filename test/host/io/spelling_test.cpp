#include "host/io/spelling.hpp"

#include <gtest/gtest.h>

#include <array>

namespace groma::io {
namespace {

constexpr std::array<std::string_view, 8> kWords{"calibrate", "evaluate", "replay",  "lever_arm_m",
                                                 "model",     "plan",     "sigma_m", "surface"};

TEST(Spelling, FindsTheWordAFewChangesAway) {
  EXPECT_EQ(closest("calibrat", kWords), "calibrate");
  EXPECT_EQ(closest("claibrate", kWords), "calibrate");
  EXPECT_EQ(closest("modle", kWords), "model") << "neighbours exchanged";
  EXPECT_EQ(closest("repaly", kWords), "replay");
  EXPECT_EQ(closest("surfaces", kWords), "surface");
  EXPECT_EQ(closest("simga_m", kWords), "sigma_m");
}

TEST(Spelling, FindsTheWordThatBeginsSo) {
  EXPECT_EQ(closest("lever", kWords), "lever_arm_m");
  EXPECT_EQ(closest("eval", kWords), "evaluate");
}

TEST(Spelling, FindsNothingThatIsFarAway) {
  for (const std::string_view word : {"", "x", "colour", "dance", "nonsense", "pl"})
    EXPECT_EQ(closest(word, kWords), std::nullopt) << word;
  EXPECT_EQ(closest("model", {}), std::nullopt);
}

TEST(Spelling, AsksWithTheWord) {
  EXPECT_EQ(did_you_mean("modle", kWords), "did you mean 'model'? ");
  EXPECT_EQ(did_you_mean("dance", kWords), "");
}

}  // namespace
}  // namespace groma::io
