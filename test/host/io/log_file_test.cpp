// Logs: all samples are read back, and damage loses only the damaged frames.
#include "host/io/log_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <string>
#include <vector>

#include "host/io/dataset_writer.hpp"
#include "host/io/error.hpp"
#include "test/support/random.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/small_run.hpp"

namespace groma::io {
namespace {

using test::ScratchFolder;
using testing::HasSubstr;

// As received from the wire: ranges are floats.
Dataset as_recorded(double duration_s) {
  Dataset run = test::make_small_run(duration_s, 1);
  test::Random random(2);
  for (model::RangeSample& range : run.ranges) {
    range.range_m = static_cast<double>(static_cast<float>(range.range_m));
    if (range.anchor_id == 5) continue;  // has only the range
    range.first_path_power_dbm = std::round(static_cast<float>(random.uniform(-11000.0, -7000.0))) / 100.0F;
    range.receive_power_dbm = std::round(static_cast<float>(random.uniform(-11000.0, -7000.0))) / 100.0F;
    range.clock_offset_ppm = std::round(static_cast<float>(random.uniform(-20e3, 20e3))) / 1000.0F;
    range.noise = std::round(static_cast<float>(random.uniform(1.0, 90.0)));
    range.line_of_sight = static_cast<model::LineOfSight>(random.next() % 4U);
    range.corrections = model::kAntennaDelaysApplied | model::kPowerBiasCorrected;
    range.network_time_dtu = 63'897'600'000 * 1000 + std::llround(range.t_s * 63.8976e9);
  }
  return run;
}

void put(LogEncoder& log, const Dataset& run) {
  for (const model::OdometrySample& row : run.odometry) log.put(row);
  for (const model::PoseSample& pose : run.pose_prior) log.put(pose);
  for (const model::RangeSample& range : run.ranges) log.put(range);
  for (const model::YawRateSample& sample : model::samples_of<model::YawRateSample>(run.sensor_samples))
    log.put(sample);
  for (const model::PositionSample& sample : model::samples_of<model::PositionSample>(run.sensor_samples))
    log.put(sample);
  for (const model::PoseSample& sample : model::samples_of<model::PoseSample>(run.sensor_samples))
    log.put(model::SensorSample(sample));
  for (const model::ZeroVelocitySample& sample :
       model::samples_of<model::ZeroVelocitySample>(run.sensor_samples))
    log.put(sample);
  log.flush();
}

std::string log_of(const Dataset& run) {
  LogEncoder log;
  log.begin_section(describe(run), 17);
  put(log, run);
  return log.take();
}

void expect_same(const model::RangeSample& a, const model::RangeSample& b) {
  const auto same = [](float x, float y) { return x == y || (std::isnan(x) && std::isnan(y)); };
  EXPECT_EQ(a.t_s, b.t_s);
  EXPECT_EQ(a.tag_id, b.tag_id);
  EXPECT_EQ(a.anchor_id, b.anchor_id);
  EXPECT_EQ(a.range_m, b.range_m);
  EXPECT_TRUE(same(a.first_path_power_dbm, b.first_path_power_dbm));
  EXPECT_TRUE(same(a.receive_power_dbm, b.receive_power_dbm));
  EXPECT_TRUE(same(a.clock_offset_ppm, b.clock_offset_ppm));
  EXPECT_TRUE(same(a.noise, b.noise));
  EXPECT_EQ(a.line_of_sight, b.line_of_sight);
  EXPECT_EQ(a.corrections, b.corrections);
  EXPECT_EQ(a.network_time_dtu, b.network_time_dtu);
}

TEST(Log, ReadsBackWhatWasWritten) {
  Dataset run = as_recorded(20.0);
  run.pose_prior[3].roll_rad = 0.02;
  run.pose_prior[3].pitch_rad = -0.01;
  run.pose_prior[5].covariance = {0.25, 0.0625, -0.03125, 0.5, 0.015625, 0.0078125};
  const ScratchFolder folder;
  folder.write("drive.glog", log_of(run));
  const Dataset back = read_dataset(folder / "drive.glog");
  ASSERT_EQ(back.ranges.size(), run.ranges.size());
  for (std::size_t i = 0; i < run.ranges.size(); ++i) expect_same(back.ranges[i], run.ranges[i]);
  ASSERT_EQ(back.odometry.size(), run.odometry.size());
  for (std::size_t i = 0; i < run.odometry.size(); ++i) {
    EXPECT_EQ(back.odometry[i].t_s, run.odometry[i].t_s);
    EXPECT_EQ(back.odometry[i].vx_mps, run.odometry[i].vx_mps);
    EXPECT_EQ(back.odometry[i].vy_mps, run.odometry[i].vy_mps);
    EXPECT_EQ(back.odometry[i].omega_radps, run.odometry[i].omega_radps);
  }
  ASSERT_EQ(back.pose_prior.size(), run.pose_prior.size());
  for (std::size_t i = 0; i < run.pose_prior.size(); ++i) {
    EXPECT_EQ(back.pose_prior[i].t_s, run.pose_prior[i].t_s);
    EXPECT_EQ(back.pose_prior[i].x_m, run.pose_prior[i].x_m);
    EXPECT_EQ(back.pose_prior[i].yaw_rad, run.pose_prior[i].yaw_rad);
    EXPECT_EQ(std::isnan(back.pose_prior[i].roll_rad), i != 3);
    EXPECT_EQ(back.pose_prior[i].covariance, run.pose_prior[i].covariance);
  }
  EXPECT_EQ(back.pose_prior[3].roll_rad, 0.02);
  EXPECT_EQ(back.pose_prior[3].pitch_rad, -0.01);
  ASSERT_EQ(back.tags.size(), 2U);
  EXPECT_EQ(back.tags[1].lever_arm_m, run.tags[1].lever_arm_m);
  EXPECT_EQ(back.range_priors.beta_m.sigma, run.range_priors.beta_m.sigma);
  EXPECT_EQ(back.surface.at(1.0, 2.0).z_m, 0.25);
  EXPECT_TRUE(back.surveyed_anchors.empty());
  EXPECT_EQ(back.dropped.total(), 0U);
  ASSERT_TRUE(back.log.has_value());
  EXPECT_EQ(back.log->damaged_bytes, 0U);
  EXPECT_EQ(back.sha256.size(), 64U);
}

TEST(Log, ReadsBackOtherSensors) {
  Dataset run = as_recorded(1.0);
  for (int i = 0; i < 200; ++i) {
    const double t_s = 0.01 * i;
    model::samples_of<model::YawRateSample>(run.sensor_samples).push_back({t_s, 0.125 * i});
    model::samples_of<model::PositionSample>(run.sensor_samples)
        .push_back({t_s, 0.5 * i, -0.25 * i, {0.5, 0.125, 0.25}});
    model::samples_of<model::PoseSample>(run.sensor_samples)
        .push_back({.t_s = t_s, .x_m = 1.5 * i, .covariance = model::PoseCovariance{1, 0, 0, 2, 0, 3}});
    model::samples_of<model::ZeroVelocitySample>(run.sensor_samples).push_back({t_s});
  }
  run.sensors.gyro_bias_sigma_radps = 0.02;
  run.sensors.gnss_lever_arm_m = Eigen::Vector3d(0.5, -0.25, 1.5);
  const ScratchFolder folder;
  folder.write("drive.glog", log_of(run));
  ReadOptions options;
  options.sensors = true;
  const Dataset back = read_dataset(folder / "drive.glog", options);
  ASSERT_EQ(model::samples_of<model::YawRateSample>(back.sensor_samples).size(), 200U);
  ASSERT_EQ(model::samples_of<model::PositionSample>(back.sensor_samples).size(), 200U);
  ASSERT_EQ(model::samples_of<model::PoseSample>(back.sensor_samples).size(), 200U);
  ASSERT_EQ(model::samples_of<model::ZeroVelocitySample>(back.sensor_samples).size(), 200U);
  for (std::size_t i = 0; i < 200; ++i) {
    EXPECT_EQ(model::samples_of<model::YawRateSample>(back.sensor_samples)[i].omega_radps,
              model::samples_of<model::YawRateSample>(run.sensor_samples)[i].omega_radps);
    EXPECT_EQ(model::samples_of<model::PositionSample>(back.sensor_samples)[i].y_m,
              model::samples_of<model::PositionSample>(run.sensor_samples)[i].y_m);
    EXPECT_EQ(model::samples_of<model::PositionSample>(back.sensor_samples)[i].covariance_m2,
              model::samples_of<model::PositionSample>(run.sensor_samples)[i].covariance_m2);
    EXPECT_EQ(model::samples_of<model::PoseSample>(back.sensor_samples)[i].x_m,
              model::samples_of<model::PoseSample>(run.sensor_samples)[i].x_m);
    EXPECT_EQ(model::samples_of<model::PoseSample>(back.sensor_samples)[i].covariance,
              model::samples_of<model::PoseSample>(run.sensor_samples)[i].covariance);
    EXPECT_EQ(model::samples_of<model::ZeroVelocitySample>(back.sensor_samples)[i].t_s,
              model::samples_of<model::ZeroVelocitySample>(run.sensor_samples)[i].t_s);
  }
  EXPECT_EQ(back.sensors.gyro_bias_sigma_radps, 0.02);
  EXPECT_FALSE(back.sensors.gyro_sigma_radps.has_value());
  EXPECT_EQ(back.sensors.gnss_lever_arm_m, run.sensors.gnss_lever_arm_m);
  EXPECT_EQ(back.dropped.total(), 0U);
  EXPECT_TRUE(
      model::samples_of<model::YawRateSample>(read_dataset(folder / "drive.glog").sensor_samples).empty());
}

TEST(Log, CarriesASurfaceOfManyPieces) {
  Dataset run = as_recorded(1.0);
  std::vector<double> heights_m(3000);
  for (std::size_t i = 0; i < heights_m.size(); ++i)
    heights_m[i] = 0.1 * std::sin(0.37 * static_cast<double>(i));
  run.surface = model::BSpline({-5.0, -5.0, 0.5, 0.5, 60, 50}, heights_m);
  const ScratchFolder folder;
  folder.write("drive.glog", log_of(run));
  const Dataset back = read_dataset(folder / "drive.glog");
  for (const double x_m : {-3.0, 1.7, 12.0})
    EXPECT_EQ(back.surface.at(x_m, 2.0).z_m, run.surface.at(x_m, 2.0).z_m);
}

TEST(Log, TakesAboutThirtyBytesPerRange) {
  Dataset run = as_recorded(20.0);
  run.odometry.clear();
  run.pose_prior.clear();
  EXPECT_LT(static_cast<double>(log_of(run).size()) / static_cast<double>(run.ranges.size()), 35.0);
}

// Wherever the log is cut, all frames before the cut are read.
TEST(Log, LosesOnlyItsTruncatedEnd) {
  const Dataset run = as_recorded(1.0);
  const std::string whole = log_of(run);
  std::size_t before = 0;
  for (std::size_t size = 0; size <= whole.size(); ++size) {
    const LogContent content = parse_log(std::string_view(whole).substr(0, size));
    const std::size_t samples = content.sections.empty() ? 0
                                                         : content.sections[0].samples.ranges.size() +
                                                               content.sections[0].samples.odometry.size() +
                                                               content.sections[0].samples.poses.size();
    EXPECT_GE(samples, before);
    EXPECT_LT(content.damaged_bytes, 1400U);
    before = samples;
  }
  EXPECT_EQ(before, run.ranges.size() + run.odometry.size() + run.pose_prior.size());
}

TEST(Log, LosesOnlyDamagedFrames) {
  const Dataset run = as_recorded(5.0);
  const std::string whole = log_of(run);
  test::Random random(3);
  for (int i = 0; i < 300; ++i) {
    std::string damaged = whole;
    const std::size_t at = 700 + random.next() % (damaged.size() - 700);
    damaged[at] = static_cast<char>(damaged[at] ^ static_cast<char>(1U << (random.next() % 8U)));
    const LogContent content = parse_log(damaged);
    ASSERT_EQ(content.sections.size(), 1U);
    EXPECT_GT(content.damaged_bytes, 0U);
    // A bit error that splits a frame or joins two loses both.
    EXPECT_GE(content.sections[0].samples.ranges.size() + 48U, run.ranges.size());
  }
}

TEST(Log, IsAppendedToAfterATruncatedEnd) {
  const Dataset first = as_recorded(4.0);
  Dataset second = as_recorded(2.0);
  for (model::RangeSample& range : second.ranges) range.t_s += 1000.0;
  std::string bytes = log_of(first);
  bytes.resize(bytes.size() - 40);
  bytes += log_of(second);
  const ScratchFolder folder;
  folder.write("drive.glog", bytes);
  const Dataset last = read_dataset(folder / "drive.glog");
  EXPECT_EQ(last.ranges.size(), second.ranges.size());
  EXPECT_EQ(last.ranges.front().t_s, second.ranges.front().t_s);
  EXPECT_EQ(last.log->sections, 2U);
  EXPECT_EQ(last.log->section, 2U);
  EXPECT_GT(last.log->damaged_bytes, 0U);

  ReadOptions options;
  options.log_section = 1;
  const Dataset earlier = read_dataset(folder / "drive.glog", options);
  EXPECT_GE(earlier.ranges.size() + 24U, first.ranges.size());
  EXPECT_EQ(earlier.ranges.front().t_s, first.ranges.front().t_s);
  options.log_section = 3;
  EXPECT_THROW(static_cast<void>(read_dataset(folder / "drive.glog", options)), DataError);
}

TEST(Log, DropsAndCountsWrongRanges) {
  Dataset run = as_recorded(2.0);
  run.ranges[5].range_m = 0.0;
  run.ranges[9].range_m = 300e3;
  run.ranges[12].tag_id = 9;
  const ScratchFolder folder;
  folder.write("drive.glog", log_of(run));
  const Dataset back = read_dataset(folder / "drive.glog");
  EXPECT_EQ(back.dropped.range_out_of_bounds, 2U);
  EXPECT_EQ(back.dropped.unknown_tag, 1U);
  EXPECT_EQ(back.ranges.size(), run.ranges.size() - 3);
}

TEST(Log, NeverReturnsNonFiniteValues) {
  Dataset run = as_recorded(2.0);
  run.ranges[5].range_m = std::nan("");
  run.odometry[2].vx_mps = std::nan("");
  run.pose_prior[1].x_m = std::nan("");
  model::samples_of<model::YawRateSample>(run.sensor_samples) = {{0.1, std::nan("")}};
  model::samples_of<model::PositionSample>(run.sensor_samples) = {{0.1, 1.0, 2.0, {-1.0, 0.0, 1.0}}};
  model::samples_of<model::ZeroVelocitySample>(run.sensor_samples) = {{std::nan("")}};
  run.pose_prior.back().covariance = {-1.0, 0.0, 0.0, 1.0, 0.0, 1.0};
  const LogContent content = parse_log(log_of(run));
  EXPECT_GT(content.damaged_bytes, 0U);
  EXPECT_TRUE(model::samples_of<model::YawRateSample>(content.sections[0].samples.sensors).empty());
  EXPECT_TRUE(model::samples_of<model::PositionSample>(content.sections[0].samples.sensors).empty());
  EXPECT_TRUE(model::samples_of<model::ZeroVelocitySample>(content.sections[0].samples.sensors).empty());
  for (const auto& range : content.sections[0].samples.ranges) EXPECT_TRUE(std::isfinite(range.range_m));
  for (const auto& row : content.sections[0].samples.odometry) EXPECT_TRUE(std::isfinite(row.vx_mps));
  for (const auto& pose : content.sections[0].samples.poses) {
    EXPECT_TRUE(std::isfinite(pose.x_m));
    EXPECT_FALSE(pose.covariance.has_value());
  }
}

TEST(Log, IsDistinguishedFromOtherFiles) {
  const ScratchFolder folder;
  folder.write("notes.txt", "no log at all\n");
  folder.write("empty", "");
  for (const char* name : {"notes.txt", "empty"}) {
    try {
      static_cast<void>(read_dataset(folder / name));
      ADD_FAILURE() << name;
    } catch (const DataError& error) {
      EXPECT_THAT(error.what(), HasSubstr("is not a log"));
    }
  }
  // The description's last frame is truncated.
  const Dataset run = as_recorded(1.0);
  LogEncoder log;
  log.begin_section(describe(run), 1);
  const std::string description = log.take();
  folder.write("torn", description.substr(0, description.size() - 10));
  try {
    static_cast<void>(read_dataset(folder / "torn"));
    ADD_FAILURE();
  } catch (const DataError& error) {
    EXPECT_THAT(error.what(), HasSubstr("section 1 has no site description"));
  }
}

}  // namespace
}  // namespace groma::io
