#include "host/io/dataset_writer.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>

#include "host/io/error.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::io {
namespace {

Dataset sample() {
  Dataset dataset;
  dataset.name = "a \"quoted\" \\ name: 1";
  dataset.origin = "simulated";
  dataset.odometry_noise = {0.021, 0.032, 0.0061};
  dataset.range_priors = {0.07, {0.2, 0.3}, {1.001, 0.005}};
  dataset.surface =
      model::BSpline({-3.5, 1.25, 0.5, 1.0 / 3.0, 4, 5},
                     {0, 0.1, 0.2, 0.3, 0.4, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0.125, 2, 2, 2, 2, 1.0 / 7.0});
  dataset.surveyed_anchors = {{4, {1.0 / 3.0, 2.0, 3.0}}, {900, {-1.5, 0.0, 0.25}}};
  dataset.tags = {{1, {0.75, 0.45, 1.9}}, {2, {-0.7, 0.1, 0.35}}};
  dataset.ranges = {
      {0.1, 1, 4, 5.25},
      {0.1 + 1e-9, 2, 900, std::sqrt(2.0), -80.5F, -79.25F, -3.25F, 57.0F, model::LineOfSight::kUnlikely,
       model::kAntennaDelaysApplied | model::kPowerBiasCorrected, 9'123'456'789'012'345}};
  dataset.odometry = {{0.0, 0.5, -0.01, 0.002}, {0.02, 1.0 / 3.0, 0.0, -0.002}};
  dataset.ground_truth = {{0.0, 1.0, 2.0, 0.5, 3.1}, {0.05, 1.0 / 7.0, 2.0, 0.5, -3.1}};
  const model::PoseCovariance covariance{0.04, 0.01, -1.0 / 300.0, 0.09, 0.002, 0.0025};
  dataset.pose_prior = {{0.0, 1.01, 2.02, 0.5, 3.0, 0.01, -0.02},
                        {0.1, 1.03, 2.02, 0.5, 3.0, 0.01, -0.02, covariance}};
  return dataset;
}

TEST(DatasetWriter, WhatIsWrittenReadsBackTheSame) {
  const test::ScratchFolder scratch;
  const Dataset written = sample();
  write_dataset(scratch / "run", written);
  const Dataset read = read_dataset(scratch / "run");

  EXPECT_EQ(read.name, written.name);
  EXPECT_EQ(read.origin, written.origin);
  EXPECT_EQ(read.odometry_noise.sigma_vy_mps, written.odometry_noise.sigma_vy_mps);
  EXPECT_EQ(read.range_priors.sigma_m, written.range_priors.sigma_m);
  EXPECT_EQ(read.range_priors.beta_m.sigma, written.range_priors.beta_m.sigma);
  EXPECT_EQ(read.range_priors.gamma.mean, written.range_priors.gamma.mean);
  EXPECT_EQ(read.dropped.total(), 0U);

  for (const double x : {-3.3, -3.1, 9.0}) {
    for (const double y : {1.3, 1.6, 1.9}) EXPECT_EQ(read.surface.at(x, y).z_m, written.surface.at(x, y).z_m);
  }
  ASSERT_EQ(read.surveyed_anchors.size(), 2U);
  EXPECT_EQ(read.surveyed_anchors[0].position_m, written.surveyed_anchors[0].position_m);
  EXPECT_EQ(read.surveyed_anchors[1].id, 900);
  ASSERT_EQ(read.tags.size(), 2U);
  EXPECT_EQ(read.tags[1].lever_arm_m, written.tags[1].lever_arm_m);

  ASSERT_EQ(read.ranges.size(), 2U);
  EXPECT_TRUE(std::isnan(read.ranges[0].receive_power_dbm));
  EXPECT_EQ(read.ranges[1].t_s, written.ranges[1].t_s);
  EXPECT_EQ(read.ranges[1].range_m, written.ranges[1].range_m);
  EXPECT_EQ(read.ranges[1].first_path_power_dbm, -80.5F);
  EXPECT_TRUE(std::isnan(read.ranges[0].noise));
  EXPECT_EQ(read.ranges[0].line_of_sight, model::LineOfSight::kNotKnown);
  EXPECT_EQ(read.ranges[0].network_time_dtu, 0);
  EXPECT_EQ(read.ranges[1].noise, 57.0F);
  EXPECT_EQ(read.ranges[1].clock_offset_ppm, -3.25F);
  EXPECT_EQ(read.ranges[1].line_of_sight, model::LineOfSight::kUnlikely);
  EXPECT_EQ(read.ranges[1].corrections, model::kAntennaDelaysApplied | model::kPowerBiasCorrected);
  EXPECT_EQ(read.ranges[1].network_time_dtu, 9'123'456'789'012'345);
  ASSERT_EQ(read.odometry.size(), 2U);
  EXPECT_EQ(read.odometry[1].vx_mps, written.odometry[1].vx_mps);
  ASSERT_EQ(read.ground_truth.size(), 2U);
  EXPECT_EQ(read.ground_truth[1].x_m, written.ground_truth[1].x_m);
  EXPECT_TRUE(std::isnan(read.ground_truth[1].roll_rad));
  ASSERT_EQ(read.pose_prior.size(), 2U);
  EXPECT_EQ(read.pose_prior[0].pitch_rad, -0.02);
  EXPECT_FALSE(read.pose_prior[0].covariance.has_value());
  EXPECT_EQ(read.pose_prior[1].covariance, written.pose_prior[1].covariance);
}

TEST(DatasetWriter, APlaneStandsInTheDescription) {
  const test::ScratchFolder scratch;
  Dataset written = sample();
  written.surface = model::Plane(0.25, {-0.02, 0.01, 2.0});
  write_dataset(scratch.path(), written);
  EXPECT_FALSE(std::filesystem::exists(scratch / "surface.csv"));
  EXPECT_NEAR(read_dataset(scratch.path()).surface.at(3.0, -8.0).z_m, written.surface.at(3.0, -8.0).z_m,
              1e-15);
}

TEST(DatasetWriter, LeavesOutWhatThereIsNot) {
  const test::ScratchFolder scratch;
  Dataset written = sample();
  written.surveyed_anchors.clear();
  written.ground_truth.clear();
  write_dataset(scratch.path(), written);
  EXPECT_FALSE(std::filesystem::exists(scratch / "anchors.csv"));
  EXPECT_FALSE(std::filesystem::exists(scratch / "groundtruth.csv"));
  EXPECT_TRUE(read_dataset(scratch.path()).surveyed_anchors.empty());
}

TEST(DatasetWriter, LeavesOutColumnsOfRangesThatNoRowKnows) {
  const test::ScratchFolder scratch;
  Dataset written = sample();
  written.ranges.resize(1);
  write_dataset(scratch / "few", written);
  EXPECT_EQ(test::read_text(scratch / "few/ranges.csv"),
            "t_s,tag_id,anchor_id,range_m,first_path_power_dbm,receive_power_dbm\n0.1,1,4,5.25,,\n");
  written.ranges.push_back({0.2, 1, 4, 5.5});
  written.ranges.back().noise = 57.0F;
  write_dataset(scratch / "noise", written);
  EXPECT_EQ(test::read_text(scratch / "noise/ranges.csv"),
            "t_s,tag_id,anchor_id,range_m,first_path_power_dbm,receive_power_dbm,noise\n0.1,1,4,5.25,,,\n"
            "0.2,1,4,5.5,,,57\n");
}

TEST(DatasetWriter, SaysWhereItCannotWrite) {
  const test::ScratchFolder scratch;
  scratch.write("file", "");
  EXPECT_THROW(write_dataset(scratch / "file", sample()), Error);
}

}  // namespace
}  // namespace groma::io
