#include "host/io/dataset.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <string>
#include <variant>
#include <vector>

#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "test/host/io/small_dataset.hpp"
#include "test/support/shared_data.hpp"

namespace groma::io {
namespace {

using test::ScratchFolder;
using testing::ElementsAre;
using testing::HasSubstr;

// The message of the ExpectedError that reading the folder throws.
template <typename ExpectedError>
std::string failure(const ScratchFolder& folder, const ReadOptions& options = {}) {
  try {
    static_cast<void>(read_dataset(folder.path(), options));
  } catch (const ExpectedError& error) {
    return error.what();
  } catch (const std::exception& error) {
    ADD_FAILURE() << "another kind of error: " << error.what();
    return {};
  }
  ADD_FAILURE() << "no error";
  return {};
}

class DatasetTest : public testing::Test {
 protected:
  DatasetTest() { test::write_small_dataset(folder_); }

  [[nodiscard]] Dataset read(const ReadOptions& options = {}) const {
    return read_dataset(folder_.path(), options);
  }

  ScratchFolder folder_;
};

TEST_F(DatasetTest, ReadsOtherSensorsIfPresent) {
  EXPECT_TRUE(model::samples_of<model::YawRateSample>(read({.sensors = true}).sensor_samples).empty());
  folder_.write("imu.csv", "t_s,omega_radps\n0.2,0.5\n0.1,0.25\n");
  folder_.write("gnss.csv", "t_s,x_m,y_m,p_xx,p_xy,p_yy\n0.1,1,2,0.04,0.01,0.09\n");
  folder_.write("absolute_pose.csv",
                "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt\n0.1,1,2,3,0.04,0.01,0,0.09,0,0.001\n");
  folder_.write("zero_velocity.csv", "t_s\n0.1\n0.2\n");
  EXPECT_TRUE(model::samples_of<model::YawRateSample>(read().sensor_samples).empty());
  const Dataset data = read({.sensors = true});
  ASSERT_EQ(model::samples_of<model::YawRateSample>(data.sensor_samples).size(), 2U);
  EXPECT_EQ(model::samples_of<model::YawRateSample>(data.sensor_samples)[0].omega_radps, 0.25);
  ASSERT_EQ(model::samples_of<model::PositionSample>(data.sensor_samples).size(), 1U);
  EXPECT_THAT(model::samples_of<model::PositionSample>(data.sensor_samples)[0].covariance_m2,
              ElementsAre(0.04, 0.01, 0.09));
  ASSERT_EQ(model::samples_of<model::PoseSample>(data.sensor_samples).size(), 1U);
  EXPECT_EQ(model::samples_of<model::PoseSample>(data.sensor_samples)[0].yaw_rad, 3.0);
  EXPECT_TRUE(std::isnan(model::samples_of<model::PoseSample>(data.sensor_samples)[0].roll_rad));
  EXPECT_THAT(*model::samples_of<model::PoseSample>(data.sensor_samples)[0].covariance,
              ElementsAre(0.04, 0.01, 0.0, 0.09, 0.0, 0.001));
  EXPECT_EQ(model::samples_of<model::ZeroVelocitySample>(data.sensor_samples).size(), 2U);

  folder_.write("gnss.csv", "t_s,x_m,y_m,p_xx,p_xy,p_yy\n0.1,1,2,0.04,0.06,0.09\n");
  EXPECT_THAT(failure<DataError>(folder_, {.sensors = true}), HasSubstr("gnss.csv:2"));
  folder_.write("gnss.csv", "t_s,x_m,y_m,p_xx,p_xy,p_yy\n");
  folder_.write("imu.csv", "t_s,omega_radps\n0.1,fast\n");
  EXPECT_THAT(failure<DataError>(folder_, {.sensors = true}), HasSubstr("imu.csv:2:5"));
}

TEST_F(DatasetTest, ReadsTheSteeringOfACarInPlaceOfOdometry) {
  const std::string rest =
      "schema: 1\nname: car\norigin: simulated\nrange: {sigma_m: 0.1}\n"
      "surface: {type: plane, z_m: 0, normal: [0, 0, 1]}\n";
  folder_.write("dataset.yaml", rest + "steering: {wheelbase_m: 2, sigma_speed_mps: 0.03}\n");
  EXPECT_THAT(failure<DataError>(folder_), HasSubstr("steering.csv"));
  std::filesystem::remove(folder_ / "odometry.csv");
  folder_.write("steering.csv", "t_s,steering_rad,speed_mps\n0,0.5,-1\n0.1,0,0.5\n0.1,0,0.5\n");
  const Dataset data = read();
  ASSERT_EQ(data.odometry.size(), 2U);
  EXPECT_EQ(data.odometry[0].vx_mps, -1.0);
  EXPECT_DOUBLE_EQ(data.odometry[0].omega_radps, -0.5 * std::tan(0.5));
  EXPECT_EQ(data.odometry[1].omega_radps, 0.0);
  EXPECT_EQ(data.dropped.repeated, 1U);
  EXPECT_EQ(data.odometry_noise.sigma_vx_mps, 0.03);
  EXPECT_EQ(data.odometry_noise.sigma_curve, model::Steering{}.sigma_curve);
  EXPECT_EQ(odometry_file(folder_.path()), folder_ / "steering.csv");

  folder_.write("steering.csv", "t_s,speed_mps,steering_rad\n0,1,0.5\n0.1,1,28.6\n");
  EXPECT_THAT(failure<DataError>(folder_), HasSubstr("steering.csv:3: 28.6 rad is no steering angle"));
  folder_.write("dataset.yaml", rest);
  EXPECT_THAT(failure<ConfigError>(folder_), HasSubstr("has neither 'odometry' nor 'steering'"));
}

TEST_F(DatasetTest, ReadsEveryColumnIntoItsPlace) {
  const Dataset data = read();
  EXPECT_EQ(data.name, "small");
  EXPECT_EQ(data.origin, "simulated");
  EXPECT_EQ(data.odometry_noise.sigma_vx_mps, 0.02);
  EXPECT_EQ(data.odometry_noise.sigma_vy_mps, 0.03);
  EXPECT_EQ(data.odometry_noise.sigma_omega_radps, 0.006);
  EXPECT_EQ(data.range_priors.sigma_m, 0.08);
  EXPECT_EQ(data.range_priors.beta_m.mean, 0.2);
  EXPECT_EQ(data.range_priors.beta_m.sigma, 0.3);
  EXPECT_EQ(data.range_priors.gamma.mean, 1.0);
  EXPECT_EQ(data.range_priors.gamma.sigma, 0.005);
  ASSERT_EQ(data.tags.size(), 2U);
  EXPECT_EQ(data.tags[0].id, 1);
  EXPECT_EQ(data.tags[0].lever_arm_m, Eigen::Vector3d(0.75, 0.45, 1.9));
  ASSERT_EQ(data.surveyed_anchors.size(), 2U);
  EXPECT_EQ(data.surveyed_anchors[0].id, 4) << "anchors are sorted by id";
  EXPECT_EQ(data.surveyed_anchors[1].position_m, Eigen::Vector3d(3.5, 12.25, 3.1));
  ASSERT_EQ(data.ranges.size(), 3U);
  EXPECT_EQ(data.ranges[2].t_s, 0.3);
  EXPECT_EQ(data.ranges[2].tag_id, 1);
  EXPECT_EQ(data.ranges[2].anchor_id, 5);
  EXPECT_EQ(data.ranges[2].range_m, 8.125);
  EXPECT_TRUE(std::isnan(data.ranges[2].first_path_power_dbm));
  ASSERT_EQ(data.odometry.size(), 2U);
  EXPECT_EQ(data.odometry[1].vx_mps, 0.5);
  EXPECT_EQ(data.odometry[1].vy_mps, 0.01);
  EXPECT_EQ(data.odometry[0].omega_radps, 0.01);
  ASSERT_EQ(data.ground_truth.size(), 2U);
  EXPECT_EQ(data.ground_truth[1].x_m, 1.05);
  EXPECT_TRUE(std::isnan(data.ground_truth[1].roll_rad));
  ASSERT_EQ(data.pose_prior.size(), 1U);
  EXPECT_EQ(data.pose_prior[0].yaw_rad, 0.51);
  EXPECT_EQ(data.pose_prior[0].roll_rad, 0.02);
  EXPECT_TRUE(std::isnan(data.pose_prior[0].pitch_rad));
  EXPECT_EQ(data.dropped.total(), 0U);

  const auto& spline = std::get<model::BSpline>(data.surface.shape());
  EXPECT_EQ(spline.grid().x0_m, -3.0);
  EXPECT_EQ(spline.grid().dy_m, 2.0);
  EXPECT_EQ(spline.grid().nx, 4);
  EXPECT_EQ(spline.grid().ny, 5);
  EXPECT_EQ(spline.heights_m()[8], 0.3) << "row by row";
  EXPECT_EQ(spline.heights_m().back(), 1.5);
}

TEST_F(DatasetTest, ColumnsMayBeInAnyOrderWithOthersBetween) {
  folder_.write("ranges.csv",
                "\xef\xbb\xbf# made by a script\r\n"
                "\r\n"
                "range_m, first_path_power_dbm ,anchor_id,note,t_s,tag_id,receive_power_dbm\r\n"
                " 5.25 ,-81.5,4,hello,+0.1,1,nan\r\n"
                "# a word between\r\n"
                "4.5e0,,4,,.2,2,-79\r\n");
  const Dataset data = read();
  ASSERT_EQ(data.ranges.size(), 2U);
  EXPECT_EQ(data.ranges[0].t_s, 0.1);
  EXPECT_EQ(data.ranges[0].range_m, 5.25);
  EXPECT_EQ(data.ranges[0].first_path_power_dbm, -81.5F);
  EXPECT_TRUE(std::isnan(data.ranges[0].receive_power_dbm));
  EXPECT_TRUE(std::isnan(data.ranges[1].first_path_power_dbm));
  EXPECT_EQ(data.ranges[1].receive_power_dbm, -79.0F);
  EXPECT_EQ(data.ranges[1].t_s, 0.2);
}

TEST_F(DatasetTest, LastLineNeedsNoEnd) {
  folder_.write("odometry.csv", "t_s,vx_mps,vy_mps,omega_radps\n0,0.5,0,0.01\n0.1,1,2,3");
  EXPECT_EQ(read().odometry.back().omega_radps, 3.0);
}

TEST_F(DatasetTest, PriorsOfThePairsHaveDefaults) {
  folder_.write("dataset.yaml",
                "schema: 1\nname: small\norigin: recorded\n"
                "odometry: {sigma_vx_mps: 0.02, sigma_vy_mps: 0.03, sigma_omega_radps: 0.006}\n"
                "range: {sigma_m: 0.08}\n"
                "surface: {type: plane, z_m: 1.5, normal: [0, -0.1, 2]}\n");
  const Dataset data = read();
  EXPECT_EQ(data.range_priors.beta_m.mean, 0.0);
  EXPECT_EQ(data.range_priors.beta_m.sigma, 0.5);
  EXPECT_EQ(data.range_priors.gamma.mean, 1.0);
  EXPECT_EQ(data.range_priors.gamma.sigma, 0.005);
  EXPECT_DOUBLE_EQ(data.surface.at(3.0, 4.0).z_m, 1.5 + 4.0 * 0.05);
}

TEST_F(DatasetTest, GroundTruthReplacesAMissingPosePrior) {
  std::filesystem::remove(folder_ / "pose_prior.csv");
  const Dataset data = read();
  ASSERT_EQ(data.pose_prior.size(), 2U);
  EXPECT_EQ(data.pose_prior[1].x_m, 1.05);
  ReadOptions options;
  options.ground_truth = false;
  EXPECT_EQ(read(options).pose_prior.size(), 2U);
  EXPECT_TRUE(read(options).ground_truth.empty());
  std::filesystem::remove(folder_ / "groundtruth.csv");
  EXPECT_THAT(failure<DataError>(folder_), HasSubstr("nor does groundtruth.csv"));
  options.pose_prior = false;
  EXPECT_TRUE(read(options).pose_prior.empty());
}

// The diagnosis names their unit; a single row is wrong.
TEST_F(DatasetTest, TiltsOfMostRowsThatAreRightInDegreesAreKept) {
  const std::string head = "t_s,x_m,y_m,z_m,yaw_rad,roll_rad,pitch_rad\n";
  folder_.write("pose_prior.csv",
                head + "0,1,2,0,0.1,3.5,-2.5\n0.1,1,2,0,0.1,1.2,0.4\n0.2,1,2,0,0.1,2.5,0.1\n");
  Dataset data = read();
  ASSERT_EQ(data.pose_prior.size(), 3U);
  EXPECT_EQ(data.pose_prior[1].roll_rad, 1.2);
  EXPECT_EQ(data.pose_prior[2].roll_rad, 2.5);
  EXPECT_EQ(data.dropped.implausible, 0U);
  folder_.write("pose_prior.csv",
                head + "0,1,2,0,0.1,3.5,-2.5\n0.1,1,2,0,0.1,0.02,0\n0.2,1,2,0,0.1,0.03,0.1\n");
  data = read();
  EXPECT_EQ(data.pose_prior.size(), 2U);
  EXPECT_EQ(data.dropped.implausible, 1U);
}

TEST_F(DatasetTest, OtherPosesReplaceThePrior) {
  folder_.write("other/slam.csv", "t_s,x_m,y_m,z_m,yaw_rad\n7,8,9,10,1.1\n");
  ReadOptions options;
  options.pose_file = folder_ / "other/slam.csv";
  EXPECT_EQ(read(options).pose_prior.at(0).t_s, 7.0);
  options.pose_file = folder_ / "other/none.csv";
  EXPECT_THAT(failure<DataError>(folder_, options), HasSubstr("none.csv: does not exist"));
}

TEST_F(DatasetTest, ReadsNoFileThatTheOptionsExclude) {
  folder_.write("anchors.csv", "nonsense");
  folder_.write("odometry.csv", "nonsense");
  folder_.write("groundtruth.csv", "nonsense");
  ReadOptions options;
  options.surveyed_anchors = false;
  options.odometry = false;
  options.ground_truth = false;
  const Dataset data = read(options);
  EXPECT_EQ(data.ranges.size(), 3U);
  EXPECT_TRUE(data.odometry.empty());
  EXPECT_TRUE(data.surveyed_anchors.empty());
}

TEST_F(DatasetTest, WrongRowsAreDroppedAndCounted) {
  folder_.write("ranges.csv",
                "t_s,tag_id,anchor_id,range_m\n"
                "10.0,1,4,5\n"
                "10.1,1,4,0\n"       // no reply
                "10.1,1,4,-1\n"      //
                "10.1,1,4,300000\n"  // a wrapped timestamp
                "10.2,9,4,5\n"       // unknown tag
                "10.2,70000,4,5\n"   //
                "10.2,1,9,5\n"       // unknown anchor
                "10.2,1,-4,5\n"      //
                "10.3,1,5,5.5\n"     //
                "10.0,2,5,5.1\n"     // out of order by 0.3 s: sorted
                "9.7,2,4,5.2\n"      // late by 0.6 s
                "10.3,1,5,5.5\n"     // repeated
                "10.3,1,5,5.6\n"     // another measurement with the same time
                "10.4,1,4,1000\n");  // the bound itself
  const Dataset data = read();
  EXPECT_EQ(data.dropped.range_out_of_bounds, 3U);
  EXPECT_EQ(data.dropped.unknown_tag, 2U);
  EXPECT_EQ(data.dropped.unknown_anchor, 2U);
  EXPECT_EQ(data.dropped.late, 1U);
  EXPECT_EQ(data.dropped.repeated, 1U);
  EXPECT_EQ(data.dropped.total(), 9U);
  std::vector<double> ranges_m;
  for (const model::RangeSample& range : data.ranges) ranges_m.push_back(range.range_m);
  EXPECT_THAT(ranges_m, ElementsAre(5.0, 5.1, 5.5, 5.6, 1000.0));
}

TEST_F(DatasetTest, UnknownAnchorsAreKeptIfNoSurveyIsRead) {
  folder_.write("ranges.csv", "t_s,tag_id,anchor_id,range_m\n10.0,1,77,5\n");
  ReadOptions options;
  options.surveyed_anchors = false;
  EXPECT_EQ(read(options).ranges.size(), 1U);
  EXPECT_EQ(read().ranges.size(), 0U);
}

TEST_F(DatasetTest, ARowFromTheFutureDoesNotMakeAllOthersLate) {
  std::string text = "t_s,vx_mps,vy_mps,omega_radps\n";
  for (int i = 0; i < 50; ++i) text += std::to_string(i == 10 ? 1e6 : 0.1 * i) + ",1,0,0\n";
  folder_.write("odometry.csv", text);
  const Dataset data = read();
  EXPECT_EQ(data.odometry.size(), 49U);
  EXPECT_EQ(data.dropped.late, 1U);
  EXPECT_NEAR(data.odometry.back().t_s, 4.9, 1e-9);
}

// 50 Hz, and sample 20 with a shifted time: it is sorted if shifted by up to four samples, otherwise dropped.
TEST_F(DatasetTest, AnOdometrySampleWithAWrongTimestampIsDropped) {
  for (const int shift : {-12, -5, -4, -1, 1, 4, 5, 12, 25}) {
    std::string text = "t_s,vx_mps,vy_mps,omega_radps\n";
    for (int i = 0; i < 50; ++i) {
      const double t_s = 0.02 * i + (i == 20 ? 0.02 * shift + 0.01 : 0.0);
      text += std::to_string(t_s) + "," + (i == 20 ? "2" : "1") + ",0,0\n";
    }
    folder_.write("odometry.csv", text);
    const Dataset data = read();
    // Half a period later: -5 is behind four samples, 5 is ahead of five.
    const bool kept = shift >= -5 && shift <= 4;
    EXPECT_EQ(data.odometry.size(), kept ? 50U : 49U) << shift;
    EXPECT_EQ(data.dropped.late, kept ? 0U : 1U) << shift;
    EXPECT_TRUE(std::is_sorted(data.odometry.begin(), data.odometry.end(),
                               [](const auto& a, const auto& b) { return a.t_s < b.t_s; }));
    EXPECT_EQ(std::count_if(data.odometry.begin(), data.odometry.end(),
                            [](const auto& o) { return o.vx_mps > 1.5; }),
              kept ? 1 : 0)
        << shift;
  }
}

TEST_F(DatasetTest, AGapIsNotAnError) {
  folder_.write("odometry.csv",
                "t_s,vx_mps,vy_mps,omega_radps\n0,1,0,0\n0.1,1,0,0\n1000,1,0,0\n1000.1,1,0,0\n");
  EXPECT_EQ(read().odometry.size(), 4U);
}

TEST_F(DatasetTest, DigestIsWhatSha256sumPrints) {
  // printf 'abc' | sha256sum
  EXPECT_EQ(sha256("abc"), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  const std::string before = read().sha256;
  EXPECT_EQ(before.size(), 64U);
  EXPECT_EQ(read().sha256, before);
  folder_.write("tags.csv", "tag_id,x_m,y_m,z_m\n1,0.75,0.45,1.9\n2,-0.7,-0.42,1.26\n");
  EXPECT_NE(read().sha256, before);
}

// A corrupted file, and the place that the message has to name.
struct RowFault {
  std::string name;
  std::string file;
  std::string text;
  std::string place;    // after the folder
  std::string problem;  // part of the message
};

std::ostream& operator<<(std::ostream& out, const RowFault& fault) {
  return out << fault.name;
}

class DataFaultTest : public testing::TestWithParam<RowFault> {};

TEST_P(DataFaultTest, IsADataErrorWithItsPlace) {
  const RowFault& fault = GetParam();
  const ScratchFolder folder;
  test::write_small_dataset(folder);
  folder.write(fault.file, fault.text);
  const std::string message = failure<DataError>(folder);
  EXPECT_THAT(message, HasSubstr((folder / fault.place).string() + ": "));
  EXPECT_THAT(message, HasSubstr(fault.problem));
  EXPECT_THAT(message, HasSubstr("; ")) << "the message says what to do";
}

const std::string kPoses = "t_s,x_m,y_m,z_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt\n0,1,2,3,0.1,,,,,,\n";

const std::string kRanges = "t_s,tag_id,anchor_id,range_m\n0.1,1,4,5.25\n";

INSTANTIATE_TEST_SUITE_P(
    Csv, DataFaultTest,
    testing::Values(
        RowFault{"Empty", "ranges.csv", "", "ranges.csv:1", "the file is empty"},
        RowFault{"OnlyComments", "ranges.csv", "# nothing\n\n", "ranges.csv:1", "the file is empty"},
        RowFault{"MissingColumn", "ranges.csv", "t_s,tag_id,range_m\n0.1,1,4\n", "ranges.csv:1:1",
                 "column anchor_id is missing"},
        RowFault{"NoHeader", "ranges.csv", "0.1,1,4,5.25\n", "ranges.csv:1:1", "column t_s is missing"},
        RowFault{"ColumnTwice", "ranges.csv", "t_s,tag_id,anchor_id,range_m,t_s\n", "ranges.csv:1:30",
                 "column t_s occurs twice"},
        RowFault{"NaN", "ranges.csv", kRanges + "0.2,1,4,nan\n", "ranges.csv:3:9",
                 "'nan' is not a finite number"},
        RowFault{"Infinity", "ranges.csv", kRanges + "0.2,1,4,-inf\n", "ranges.csv:3:9",
                 "not a finite number"},
        RowFault{"NaNTime", "odometry.csv", "t_s,vx_mps,vy_mps,omega_radps\nNaN,0,0,0\n", "odometry.csv:2:1",
                 "not a finite"},
        RowFault{"Text", "ranges.csv", kRanges + "0.2,1,4,five\n", "ranges.csv:3:9",
                 "'five' is not a number"},
        RowFault{"NumberAndText", "ranges.csv", kRanges + "0.2,1,4,5.2m\n", "ranges.csv:3:9",
                 "'5.2m' is not a number"},
        RowFault{"TwoPoints", "ranges.csv", kRanges + "0.2,1,4, 5.2.1\n", "ranges.csv:3:10",
                 "'5.2.1' is not a number"},
        RowFault{"DecimalComma", "ranges.csv", kRanges + "0.2,1,4,5,2\n", "ranges.csv:3:12",
                 "5 fields, the header 4"},
        RowFault{"EmptyField", "ranges.csv", kRanges + "0.2,1,,5\n", "ranges.csv:3:7", "the field is empty"},
        RowFault{"FractionalId", "ranges.csv", kRanges + "0.2,1.5,4,5\n", "ranges.csv:3:5",
                 "'1.5' is not a whole number"},
        RowFault{"ShortRow", "ranges.csv", kRanges + "0.2,1\n", "ranges.csv:3:6", "2 fields, the header 4"},
        RowFault{"TooLarge", "ranges.csv", kRanges + "0.2,1,4,1e999\n", "ranges.csv:3:9", "out of range"},
        RowFault{"Binary", "ranges.csv", kRanges + std::string("0.2,1,4,\x01\0\xff", 11) + "\n",
                 "ranges.csv:3:9", "'\\x01\\x00\\xff'"},
        RowFault{"PowerText", "ranges.csv",
                 "t_s,tag_id,anchor_id,range_m,receive_power_dbm\n0.1,1,4,5,loud\n", "ranges.csv:2:11",
                 "'loud' is not a number"},
        RowFault{"RollText", "groundtruth.csv", "t_s,x_m,y_m,z_m,yaw_rad,roll_rad\n0,1,2,3,0.1,flat\n",
                 "groundtruth.csv:2:13", "'flat' is not a number"},
        RowFault{"CovarianceNaN", "pose_prior.csv", kPoses + "1,1,2,3,0.1,0.01,nan,0,0.01,0,0.01\n",
                 "pose_prior.csv:3:18", "'nan' is not a finite number"},
        RowFault{"CovarianceHalf", "pose_prior.csv", kPoses + "1,1,2,3,0.1,0.01,,,0.01,,0.01\n",
                 "pose_prior.csv:3", "is incomplete"},
        RowFault{"CovarianceColumnMissing", "pose_prior.csv",
                 "t_s,x_m,y_m,z_m,yaw_rad,p_xx,p_yy\n0,1,2,3,0.1,0.01,0.01\n", "pose_prior.csv:2",
                 "is incomplete"},
        RowFault{"CovarianceIndefinite", "groundtruth.csv", kPoses + "1,1,2,3,0.1,0.01,0.011,0,0.01,0,0.01\n",
                 "groundtruth.csv:3", "not a covariance"},
        RowFault{"CovarianceZero", "pose_prior.csv", kPoses + "1,1,2,3,0.1,0.01,0,0,0.01,0,0\n",
                 "pose_prior.csv:3", "not a covariance"},
        RowFault{"NoTags", "tags.csv", "tag_id,x_m,y_m,z_m\n", "tags.csv", "there are no tags"},
        RowFault{"TagTwice", "tags.csv", "tag_id,x_m,y_m,z_m\n1,0,0,0\n1,1,0,0\n", "tags.csv:3:1",
                 "id 1 occurs twice"},
        RowFault{"TagIdTooLarge", "tags.csv", "tag_id,x_m,y_m,z_m\n65536,0,0,0\n", "tags.csv:2:1",
                 "out of range"},
        RowFault{"AnchorTwice", "anchors.csv", "anchor_id,x_m,y_m,z_m\n4,0,0,0\n4,1,0,0\n", "anchors.csv:3:1",
                 "id 4 occurs twice"}),
    [](const auto& fault) { return fault.param.name; });

INSTANTIATE_TEST_SUITE_P(
    Surface, DataFaultTest,
    testing::Values(
        RowFault{"Empty", "surface.csv", "", "surface.csv:1", "the file is empty"},
        RowFault{"ShortGrid", "surface.csv", "0,0,1,1,4\n", "surface.csv:1", "the row has 5 numbers"},
        RowFault{"Step", "surface.csv", "0,0,0,1,4,4\n", "surface.csv:1", "above 0"},
        RowFault{"TooFew", "surface.csv", "0,0,1,1,3,4\n", "surface.csv:1", "nx is 3"},
        RowFault{"Fraction", "surface.csv", "0,0,1,1,4,4.5\n", "surface.csv:1", "ny is 4.5"},
        RowFault{"Huge", "surface.csv", "0,0,1,1,4,1e300\n", "surface.csv:1", "ny is 1e+300"},
        RowFault{"RowsMissing", "surface.csv", "0,0,1,1,4,4\n0,0,0,0\n0,0,0,0\n", "surface.csv:3",
                 "there are 2 rows"},
        RowFault{"RowsTooMany", "surface.csv", "0,0,1,1,4,4\n0,0,0,0\n0,0,0,0\n0,0,0,0\n0,0,0,0\n0,0,0,0\n",
                 "surface.csv:6", "more than nx = 4"},
        RowFault{"RowShort", "surface.csv", "0,0,1,1,4,4\n0,0,0\n", "surface.csv:2", "the row has 3 numbers"},
        RowFault{"RowLong", "surface.csv", "0,0,1,1,4,4\n0,0,0,0,0\n", "surface.csv:2",
                 "the row has 5 numbers"},
        RowFault{"NaN", "surface.csv", "0,0,1,1,4,4\n0,0,nan,0\n", "surface.csv:2:5",
                 "'nan' is not a finite"}),
    [](const auto& fault) { return fault.param.name; });

TEST_F(DatasetTest, EachMissingFileIsNamed) {
  for (const std::string file : {"dataset.yaml", "tags.csv", "ranges.csv", "odometry.csv", "surface.csv"}) {
    test::write_small_dataset(folder_);
    std::filesystem::remove(folder_ / file);
    EXPECT_THAT(failure<DataError>(folder_), HasSubstr((folder_ / file).string() + ": does not exist"));
  }
}

TEST_F(DatasetTest, AnInvalidFolderIsADataError) {
  EXPECT_THROW(static_cast<void>(read_dataset(folder_ / "none")), DataError);
  EXPECT_THROW(static_cast<void>(read_dataset(folder_ / "tags.csv")), DataError);
  std::filesystem::remove(folder_ / "tags.csv");
  std::filesystem::create_directory(folder_ / "tags.csv");
  EXPECT_THAT(failure<DataError>(folder_), HasSubstr("tags.csv: cannot be read"));
}

class ConfigFaultTest : public testing::TestWithParam<RowFault> {};

TEST_P(ConfigFaultTest, IsAConfigErrorWithItsPlace) {
  const RowFault& fault = GetParam();
  const ScratchFolder folder;
  test::write_small_dataset(folder);
  folder.write("dataset.yaml", fault.text);
  const std::string message = failure<ConfigError>(folder);
  EXPECT_THAT(message, HasSubstr((folder / "dataset.yaml").string() + ":" + fault.place + ": "));
  EXPECT_THAT(message, HasSubstr(fault.problem));
  EXPECT_THAT(message, HasSubstr("; "));
}

// The description with the line of `key` replaced by `line`.
std::string with(const std::string& key, const std::string& line) {
  std::string text;
  for (const std::string& given :
       {std::string("schema: 1"), std::string("name: x"), std::string("origin: recorded"),
        std::string("odometry: {sigma_vx_mps: 0.1, sigma_vy_mps: 0.1, sigma_omega_radps: 0.1}"),
        std::string("range: {sigma_m: 0.1}"),
        std::string("surface: {type: plane, z_m: 0, normal: [0, 0, 1]}")}) {
    const std::string& chosen = given.starts_with(key + ":") ? line : given;
    if (!chosen.empty()) text += chosen + '\n';
  }
  return text;
}

INSTANTIATE_TEST_SUITE_P(
    Yaml, ConfigFaultTest,
    testing::Values(
        RowFault{"Empty", "", "", "1:1", "the file is empty"},
        RowFault{"NoMap", "", "- 1\n", "1:1", "not a map"},
        RowFault{"Syntax", "", with("range", "range: {sigma_m: 0.1"), "6:8", "invalid YAML"},
        RowFault{"UnknownKey", "", with("schema", "schema: 1\nshema: 2"), "2:1", "unknown key 'shema'"},
        RowFault{"UnknownDeepKey", "", with("range", "range: {sigma_m: 0.1, alpha: 2}"), "5:23",
                 "unknown key 'alpha'"},
        RowFault{"KeyTwice", "", with("name", "name: x\nname: y"), "3:1", "key name occurs twice"},
        RowFault{"MissingKey", "", with("origin", ""), "1:1", "key origin is missing"},
        RowFault{"MissingDeepKey", "", with("odometry", "odometry: {sigma_vx_mps: 0.1, sigma_vy_mps: 0.1}"),
                 "4:11", "odometry lacks the key sigma_omega_radps"},
        RowFault{"Schema", "", with("schema", "schema: 2"), "1:9", "schema is not 1"},
        RowFault{"SchemaText", "", with("schema", "schema: one"), "1:9",
                 "schema is not a whole number: 'one'"},
        RowFault{"Origin", "", with("origin", "origin: dreamt"), "3:9", "origin is 'dreamt'"},
        RowFault{"SigmaZero", "", with("range", "range: {sigma_m: 0}"), "5:18", "range.sigma_m is 0"},
        RowFault{"SigmaNegative", "", with("range", "range: {sigma_m: -0.1}"), "5:18",
                 "range.sigma_m is -0.1"},
        RowFault{"SigmaText", "", with("range", "range: {sigma_m: small}"), "5:18",
                 "range.sigma_m is not a number: 'small'"},
        RowFault{"SigmaQuoted", "", with("range", "range: {sigma_m: \"0.1\"}"), "5:18",
                 "range.sigma_m is not a number"},
        RowFault{"SigmaNaN", "", with("range", "range: {sigma_m: nan}"), "5:18",
                 "range.sigma_m is not finite"},
        RowFault{"SigmaDotNaN", "", with("range", "range: {sigma_m: .nan}"), "5:18",
                 "range.sigma_m is not a number"},
        RowFault{"SigmaList", "", with("range", "range: {sigma_m: [0.1]}"), "5:18",
                 "range.sigma_m is not a number"},
        RowFault{"RangeScalar", "", with("range", "range: 0.1"), "5:8",
                 "range needs keys, and is a single value"},
        RowFault{"PriorShort", "", with("range", "range: {sigma_m: 0.1, beta_m: [0]}"), "5:31",
                 "range.beta_m has 1 entries"},
        RowFault{"PriorScalar", "", with("range", "range: {sigma_m: 0.1, beta_m: 0}"), "5:31",
                 "range.beta_m has to be a list"},
        RowFault{"PriorSigma", "", with("range", "range: {sigma_m: 0.1, gamma: [1, 0]}"), "5:34",
                 "range.gamma[1] is 0"},
        RowFault{"SurfaceType", "", with("surface", "surface: {type: sphere}"), "6:17",
                 "surface.type is 'sphere'"},
        RowFault{"SurfaceNoType", "", with("surface", "surface: {z_m: 0, normal: [0, 0, 1]}"), "6:10",
                 "surface lacks the key type"},
        RowFault{"SurfaceMixed", "", with("surface", "surface: {type: bspline, z_m: 0}"), "6:26",
                 "unknown key 'z_m'"},
        RowFault{"NormalDown", "", with("surface", "surface: {type: plane, z_m: 0, normal: [0, 0, -1]}"),
                 "6:40", "does not point up"},
        RowFault{"NormalFlat", "", with("surface", "surface: {type: plane, z_m: 0, normal: [1, 0, 0]}"),
                 "6:40", "does not point up"},
        RowFault{"NormalShort", "", with("surface", "surface: {type: plane, z_m: 0, normal: [0, 1]}"), "6:40",
                 "has 2 entries"}),
    [](const auto& fault) { return fault.param.name; });

TEST(SharedDataTest, EveryRunReadsWithoutDroppedRows) {
  GROMA_SHARED_OR_SKIP(data, ".");
  std::size_t runs = 0;
  for (const std::string kind : {"real", "simulated"}) {
    for (const auto& entry : std::filesystem::directory_iterator(data / kind)) {
      if (!std::filesystem::exists(entry.path() / "dataset.yaml")) continue;
      SCOPED_TRACE(entry.path());
      const Dataset run = read_dataset(entry.path());
      EXPECT_EQ(run.name, entry.path().filename());
      EXPECT_EQ(run.dropped.total(), 0U);
      EXPECT_GT(run.ranges.size(), 200U);
      EXPECT_GT(run.odometry.size(), 200U);
      EXPECT_GT(run.pose_prior.size(), 200U);
      EXPECT_GE(run.surveyed_anchors.size(), 4U);
      ++runs;
    }
  }
  EXPECT_GE(runs, 16U);
}

TEST(Survey, ReadsRangesBetweenAnchorsAndCountsInvalidRows) {
  const ScratchFolder folder;
  folder.write("survey.csv",
               "anchor_id,other_id,range_m,sigma_m,count\n10,11,5.25,0.04,50\n10,10,1,0.1,5\n"
               "11,12,0,0.1,5\n12,70000,4,0.1,5\n12,13,4,0.1,0\n");
  DroppedRows dropped;
  const std::vector<model::AnchorRange> ranges = read_survey(folder / "survey.csv", dropped);
  ASSERT_EQ(ranges.size(), 1U);
  EXPECT_EQ(ranges[0].anchor_id, 10);
  EXPECT_EQ(ranges[0].other_id, 11);
  EXPECT_EQ(ranges[0].range_m, 5.25);
  EXPECT_EQ(ranges[0].sigma_m, 0.04);
  EXPECT_EQ(ranges[0].count, 50U);
  EXPECT_EQ(dropped.unknown_anchor, 2U);
  EXPECT_EQ(dropped.range_out_of_bounds, 2U);
}

}  // namespace
}  // namespace groma::io
