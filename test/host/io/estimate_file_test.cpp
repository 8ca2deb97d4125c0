#include "host/io/estimate_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>

#include "host/io/error.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::io {
namespace {

TEST(EstimateFileTest, EveryNumberSurvivesExactly) {
  std::vector<model::PlanarEstimate> rows(3);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    const double k = static_cast<double>(i);
    rows[i].t_s = 1763705000.0 + 0.1 * k;
    rows[i].x_m = std::sin(k) * 1e-12;
    rows[i].y_m = -1.0 / 3.0 * k;
    rows[i].yaw_rad = std::acos(-1.0) * std::cos(k);
    rows[i].covariance << 0.1, 0.2 / 3.0, 0.3, 0.2 / 3.0, 0.5, -1e-300, 0.3, -1e-300, k / 7.0;
  }
  const test::ScratchFolder folder;
  folder.write("e.csv", format_estimate(rows));
  const std::vector<model::PlanarEstimate> read = read_estimate(folder / "e.csv");
  ASSERT_EQ(read.size(), rows.size());
  for (std::size_t i = 0; i < rows.size(); ++i) {
    EXPECT_EQ(read[i].t_s, rows[i].t_s);
    EXPECT_EQ(read[i].x_m, rows[i].x_m);
    EXPECT_EQ(read[i].y_m, rows[i].y_m);
    EXPECT_EQ(read[i].yaw_rad, rows[i].yaw_rad);
    EXPECT_EQ(read[i].covariance, rows[i].covariance);
  }
}

TEST(EstimateFileTest, HeaderIsTheContracts) {
  EXPECT_EQ(format_estimate({}), "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt\n");
}

TEST(EstimateFileTest, TimesHaveToIncrease) {
  const test::ScratchFolder folder;
  const std::string header = format_estimate({});
  folder.write("e.csv", header + "1,0,0,0,1,0,0,1,0,1\n1,0,0,0,1,0,0,1,0,1\n");
  try {
    static_cast<void>(read_estimate(folder / "e.csv"));
    FAIL() << "no error";
  } catch (const DataError& error) {
    EXPECT_THAT(error.what(), testing::HasSubstr("e.csv:3:1: the times do not increase"));
  }
  folder.write("e.csv", header);
  EXPECT_THROW(static_cast<void>(read_estimate(folder / "e.csv")), DataError);
}

}  // namespace
}  // namespace groma::io
