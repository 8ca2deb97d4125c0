#include "host/io/estimate_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <utility>
#include <vector>

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

TEST(EstimateFileTest, TheHeaderIsThatOfTheContract) {
  EXPECT_EQ(format_estimate({}), "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt\n");
}

TEST(EstimateFileTest, FurtherColumnsFollowThoseOfTheContract) {
  model::PlanarEstimate row;
  row.t_s = 2.0;
  row.covariance = Eigen::Matrix3d::Identity();
  model::SpatialEstimate at;
  at.z_m = 1.5;
  at.roll_rad = -0.25;
  at.pitch_rad = 0.125;
  at.chart = 1;
  at.covariance.block<3, 3>(2, 2) << 4.0, 0.5, 0.25, 0.5, 9.0, 0.75, 0.25, 0.75, 16.0;
  const std::vector<RowWords> words{{"DEGRADED", "off-surface"}};
  const std::string plane = format_estimate(std::vector{row}, std::vector{at}, model::Surface(), words);
  EXPECT_EQ(plane,
            "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt,state,reason,z_m,roll_rad,pitch_rad,p_zz,p_zr,"
            "p_zp,p_rr,p_rp,p_pp\n2,0,0,0,1,0,0,1,0,1,DEGRADED,off-surface,1.5,-0.25,0.125,4,0.5,0.25,9,0.75,"
            "16\n");
  std::vector<model::Chart> charts(2);
  charts[0].name = "hall";
  charts[1].name = "gallery";
  const std::string floors =
      format_estimate(std::vector{row}, std::vector{at}, model::Surface(std::move(charts)), words);
  EXPECT_THAT(floors, testing::HasSubstr("p_pp,floor\n"));
  EXPECT_THAT(floors, testing::EndsWith(",16,gallery\n"));
  const test::ScratchFolder folder;
  folder.write("e.csv", floors);
  const std::vector<model::PlanarEstimate> read = read_estimate(folder / "e.csv");
  ASSERT_EQ(read.size(), 1U);
  EXPECT_EQ(read[0].t_s, row.t_s);
  EXPECT_EQ(read[0].covariance, row.covariance);
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
