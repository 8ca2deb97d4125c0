// The diagnosis names each mistake in a small drive, with its size, and nothing in a good one.
#include "host/diagnosis/diagnose.hpp"

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

#include "host/calibration/association.hpp"
#include "host/diagnosis/plain_checks.hpp"
#include "host/diagnosis/slice_gain.hpp"
#include "test/host/diagnosis/mistakes.hpp"
#include "test/support/random.hpp"
#include "test/support/small_run.hpp"

namespace groma::diagnosis {
namespace {

// The small run's robot moves along its heading. Here base_link swings about that, so that it also moves
// sideways.
double swing_rad(double t_s) {
  return 0.35 * std::sin(0.7 * t_s);
}

Data small_drive(std::uint64_t seed, double duration_s = 32.0) {
  constexpr double kStep_s = 0.05;
  io::Dataset run = test::make_small_run(duration_s, seed);
  for (model::OdometrySample& sample : run.odometry) {
    const double now_rad = swing_rad(sample.t_s);
    const double turn_rad = swing_rad(sample.t_s + kStep_s) - now_rad;
    const Eigen::Vector2d velocity_mps =
        Eigen::Rotation2Dd(-now_rad - 0.5 * turn_rad) * Eigen::Vector2d(sample.vx_mps, sample.vy_mps);
    sample.vx_mps = velocity_mps.x();
    sample.vy_mps = velocity_mps.y();
    sample.omega_radps += turn_rad / kStep_s;
  }
  const std::vector<model::PoseSample> along = run.ground_truth;
  for (model::PoseSample& pose : run.pose_prior)
    pose.yaw_rad = model::wrap_angle(pose.yaw_rad + swing_rad(pose.t_s));
  // The tags swing with base_link.
  for (model::RangeSample& range : run.ranges) {
    const auto next =
        std::find_if(along.begin(), along.end(), [&](const auto& pose) { return pose.t_s > range.t_s; });
    if (next == along.begin() || next == along.end()) continue;
    const model::RigidPose pose = calibration::interpolate_pose(
        *std::prev(next), *next, (range.t_s - std::prev(next)->t_s) / kStep_s, run.surface);
    const Eigen::Vector3d lever_arm_m = run.tags[range.tag_id - 1U].lever_arm_m;
    const Eigen::Vector3d swung_m =
        Eigen::AngleAxisd(swing_rad(range.t_s), Eigen::Vector3d::UnitZ()) * lever_arm_m;
    const Eigen::Vector3d anchor_m = run.surveyed_anchors[range.anchor_id - 4U].position_m;
    const auto distance_m = [&](const Eigen::Vector3d& arm_m) {
      return (pose.position_m + pose.rotation * arm_m - anchor_m).norm();
    };
    range.range_m += distance_m(swung_m) - distance_m(lever_arm_m);
  }
  return data_of(run);
}

std::vector<std::string> causes_of(const std::vector<Finding>& findings) {
  std::vector<std::string> out;
  out.reserve(findings.size());
  for (const Finding& finding : findings) out.emplace_back(finding.cause);
  return out;
}

void expect_size(const Finding& finding, const test::MistakeMade& made) {
  ASSERT_EQ(finding.value.size(), made.value.size());
  for (std::size_t i = 0; i < finding.value.size(); ++i) {
    const double sigma = finding.sigma.empty() ? 1e-3 * std::abs(made.value[i]) : finding.sigma[i];
    EXPECT_NEAR(finding.value[i], made.value[i], 4.0 * sigma);
  }
}

void expect_unit(const std::vector<Finding>& findings, const test::MistakeMade& made) {
  ASSERT_THAT(causes_of(findings), testing::ElementsAre(made.cause));
  EXPECT_EQ(findings.front().value, made.value);
}

// Of a test, for its name.
std::string name_of(const testing::TestParamInfo<test::MistakeMade>& made) {
  std::string name = fmt::format("{}_{}_{}", made.index, made.param.cause, made.param.name);
  std::erase_if(name, [](char c) { return c == '\''; });
  std::replace_if(
      name.begin(), name.end(), [](char c) { return c == ' ' || c == '-'; }, '_');
  return name;
}

class DiagnoseTest : public testing::TestWithParam<test::MistakeMade> {};

TEST_P(DiagnoseTest, NamesTheMistakeAndItsSizeAndNothingElse) {
  Data data = small_drive(1);
  GetParam().make(data);
  const std::vector<Finding> findings = diagnose(std::move(data));
  ASSERT_THAT(causes_of(findings), testing::ElementsAre(GetParam().cause));
  const Finding& finding = findings.front();
  EXPECT_FALSE(finding.evidence.empty());
  EXPECT_FALSE(finding.remedy.empty());
  expect_size(finding, GetParam());
}

INSTANTIATE_TEST_SUITE_P(
    Mistakes, DiagnoseTest,
    testing::Values(test::clock_offset(0.25), test::pose_clock_offset(-0.25),
                    test::odometry_clock_offset(0.25), test::clock_drift(0.01), test::time_overlap(),
                    test::time_unit(1e3), test::all_times_unit(1e3), test::all_times_unit(1e9),
                    test::length_unit(1e3), test::odometry_length_unit(1e3), test::lever_arm_unit(1e3),
                    test::lever_arm_unit(1e2), test::lever_arm_unit(1.0 / 0.0254), test::angle_unit(),
                    test::tilt_unit(), test::heading_offset(1.5708), test::heading_sign(),
                    test::lateral_sign(), test::yaw_rate_sign(), test::yaw_rate_scale(1.1),
                    test::odometry_scale(0.9), test::swapped_tags(), test::lever_arm({0.5, 0.0, 0.0}),
                    test::surface_height(0.5), test::odometry_of_another_drive(), test::unknown_tag(),
                    test::unknown_anchor(), test::renumbered_anchors(), test::another_site()),
    name_of);

TEST(Diagnose, NamesNothingInAGoodDrive) {
  for (const std::uint64_t seed : {1U, 2U}) {
    EXPECT_THAT(causes_of(diagnose(small_drive(seed))), testing::IsEmpty()) << "seed " << seed;
  }
}

TEST(Diagnose, AThirdOfASizeThatMattersIsNotNamed) {
  for (const test::MistakeMade& made : {test::clock_offset(0.033), test::lever_arm({0.1, 0.0, 0.0}),
                                        test::odometry_scale(1.0 + 0.05 / 3.0)}) {
    Data data = small_drive(3);
    made.make(data);
    EXPECT_THAT(causes_of(diagnose(std::move(data))), testing::IsEmpty()) << made.cause;
  }
}

// All ranges of a round come with nearly one time.
TEST(Diagnose, RangesInBurstsDoNotHideTheUnitOfTheTimes) {
  Data data = small_drive(6);
  constexpr double kRound_s = 0.12;
  for (std::size_t i = 0; i < data.ranges.size(); ++i) {
    data.ranges[i].t_s =
        kRound_s * std::floor(data.ranges[i].t_s / kRound_s) + 1e-6 * static_cast<double>(i % 12);
  }
  const test::MistakeMade made = test::all_times_unit(1e6);
  made.make(data);
  expect_unit(find_wrong_times(data), made);
}

// A robot on a circle of 0.7 m radius is never 2 m from where it was.
TEST(Diagnose, NamesTheUnitOfRangesInASmallRoom) {
  Data data;
  data.tags = {{1, Eigen::Vector3d::Zero()}};
  for (int i = 0; i < 1000; ++i) {
    const double t_s = 0.1 * i;
    const Eigen::Vector2d place_m = 0.7 * Eigen::Vector2d(std::cos(0.5 * t_s), std::sin(0.5 * t_s));
    data.poses.push_back({.t_s = t_s, .x_m = place_m.x(), .y_m = place_m.y()});
    data.ranges.push_back({t_s, 1, 4, (place_m - Eigen::Vector2d(3.0, 1.0)).norm()});
  }
  EXPECT_THAT(find_wrong_lengths(data), testing::IsEmpty());
  const test::MistakeMade made = test::length_unit(1e2);
  made.make(data);
  expect_unit(find_wrong_lengths(data), made);
}

// Most slices show nothing of a clock, as the robot stands; those in which it moves show it clearly.
TEST(Diagnose, NamesAClockThatFewSlicesShow) {
  constexpr double kStands_s = 22.0;
  Data data = small_drive(6, 60.0);
  const auto stands = [&](const auto& sample) { return sample.t_s > kStands_s; };
  test::SmallNoise noise(6);
  const model::PoseSample place = *std::prev(std::find_if(data.poses.begin(), data.poses.end(), stands));
  std::map<std::pair<model::NodeId, model::NodeId>, double> last_m;
  for (model::PoseSample& pose : data.poses) {
    if (!stands(pose)) continue;
    const double t_s = pose.t_s;
    pose = place;
    pose.t_s = t_s;
  }
  for (model::RangeSample& range : data.ranges) {
    double& range_m = last_m[{range.tag_id, range.anchor_id}];
    if (stands(range)) {
      range.range_m = range_m + 0.08 * noise();
    } else {
      range_m = range.range_m;
    }
  }
  data.odometry.clear();
  const test::MistakeMade made = test::clock_offset(0.5);
  made.make(data);
  const std::vector<Finding> findings = diagnose(std::move(data));
  ASSERT_THAT(causes_of(findings), testing::ElementsAre("clock-offset"));
  expect_size(findings.front(), made);
}

TEST(Diagnose, NamesTwoMistakesAtOnce) {
  Data data = small_drive(4);
  test::swapped_tags().make(data);
  test::clock_offset(0.4).make(data);
  EXPECT_THAT(causes_of(diagnose(std::move(data))),
              testing::UnorderedElementsAre("swapped-tags", "clock-offset"));
}

TEST(Diagnose, WithoutOdometryTheRangesShowTheHeading) {
  Data data = small_drive(5);
  data.odometry.clear();
  test::heading_offset(0.5 * std::numbers::pi).make(data);
  EXPECT_THAT(causes_of(diagnose(std::move(data))), testing::ElementsAre("heading-offset"));
}

model::Calibration surveyed(const Data& data) {
  model::Calibration calibration = model::surveyed_calibration(data.anchors, data.tags, data.priors, 0.02);
  for (model::AnchorCalibration& anchor : calibration.anchors) {
    for (model::PairBias& pair : anchor.pairs) {
      pair.beta_m = test::small_run_beta_m(pair.tag_id, anchor.id);
      pair.beta_sigma_m = 0.02;
    }
  }
  return calibration;
}

// Without poses a drive has to be longer.
constexpr double kLonger_s = 64.0;

class DiagnoseWithCalibrationTest : public testing::TestWithParam<test::MistakeMade> {};

TEST_P(DiagnoseWithCalibrationTest, NamesTheMistakeWithoutPoses) {
  Data data = small_drive(7, kLonger_s);
  GetParam().make(data);
  const model::Calibration calibration = surveyed(data);
  data.poses.clear();
  const std::vector<Finding> findings = diagnose(std::move(data), calibration);
  ASSERT_THAT(causes_of(findings), testing::ElementsAre(GetParam().cause));
  expect_size(findings.front(), GetParam());
}

INSTANTIATE_TEST_SUITE_P(Mistakes, DiagnoseWithCalibrationTest,
                         testing::Values(test::clock_offset(0.25), test::yaw_rate_sign(),
                                         test::swapped_tags(), test::tags_too_high(0.5),
                                         test::all_times_unit(1e6), test::length_unit(1e3),
                                         test::length_unit(1.0 / 0.3048), test::odometry_length_unit(1e3),
                                         test::odometry_length_unit(1.0 / 0.3048), test::lever_arm_unit(1e3),
                                         test::yaw_rate_unit(), test::unknown_tag(), test::unknown_anchor(),
                                         test::renumbered_anchors(), test::all_anchors_renumbered(),
                                         test::another_site()),
                         name_of);

TEST(Diagnose, WithACalibrationNamesNothingInAGoodDrive) {
  Data data = small_drive(8, kLonger_s);
  const model::Calibration calibration = surveyed(data);
  EXPECT_THAT(causes_of(diagnose(std::move(data), calibration)), testing::IsEmpty());
}

// What a filter starts from.
TEST(Diagnose, NamesAWrongStart) {
  Data data = small_drive(7, kLonger_s);
  const model::Calibration calibration = surveyed(data);
  const model::PoseSample truth = data.poses[20];
  data.poses.clear();
  const auto findings_at = [&](double x_m, double y_m, double yaw_rad) {
    Data started = data;
    started.start = {.t_s = truth.t_s, .pose = {x_m, y_m, yaw_rad}};
    return diagnose(std::move(started), calibration);
  };
  const auto findings_from = [&](double yaw_rad) { return findings_at(truth.x_m, truth.y_m, yaw_rad); };
  EXPECT_THAT(findings_from(truth.yaw_rad + 0.1), testing::IsEmpty());
  for (const double error_rad : {0.4, -0.5 * std::numbers::pi, std::numbers::pi}) {
    const std::vector<Finding> findings = findings_from(truth.yaw_rad + error_rad);
    ASSERT_THAT(causes_of(findings), testing::ElementsAre("heading-offset")) << error_rad;
    EXPECT_NEAR(model::wrap_angle(findings.front().value.at(0) - error_rad), 0.0,
                4.0 * findings.front().sigma.at(0));
  }
  EXPECT_THAT(causes_of(findings_from(-truth.yaw_rad)), testing::ElementsAre("heading-sign"));
  EXPECT_THAT(causes_of(findings_from(truth.yaw_rad * test::kDegrees)), testing::ElementsAre("angle-unit"));
  EXPECT_THAT(findings_at(truth.x_m + 1.0, truth.y_m - 1.0, truth.yaw_rad), testing::IsEmpty());
  EXPECT_THAT(causes_of(findings_at(truth.x_m - 30.0, truth.y_m + 20.0, truth.yaw_rad + 1.0)),
              testing::ElementsAre("map-mismatch"));
  EXPECT_THAT(causes_of(findings_at(1e3 * truth.x_m, 1e3 * truth.y_m, truth.yaw_rad)),
              testing::ElementsAre("length-unit"));
}

TEST(Diagnose, AnUnusableCalibrationProvesNothing) {
  Data data = small_drive(7, kLonger_s);
  test::clock_offset(0.25).make(data);
  model::Calibration calibration = surveyed(data);
  data.poses.clear();
  EXPECT_THAT(causes_of(diagnose(Data(data), calibration)), testing::ElementsAre("clock-offset"));
  calibration.verdict = model::Verdict::kUnusable;
  EXPECT_THAT(causes_of(diagnose(std::move(data), calibration)), testing::IsEmpty());
}

// Gains of 0.5 and 1.5 in turn: 1 in the mean, with a sample deviation of 0.5 sqrt(n / (n - 1)).
TEST(SliceGain, FewSlicesSayLess) {
  const auto gain = [](int slices) {
    std::vector<double> cost(static_cast<std::size_t>(slices) + 1);
    for (std::size_t i = 0; i < cost.size(); ++i) cost[i] = i % 2 == 0 ? -0.5 : -1.5;
    cost.back() = std::nan("");  // a slice without data
    return gain_in_sigmas(cost, std::vector<double>(cost.size(), 0.0));
  };
  // Probabilities of Student's t: of t = 2 sqrt(3) with 3 degrees of freedom 0.0203, of t = 2 sqrt(19) with
  // 19 degrees 2.4e-8; normal deviates of these.
  EXPECT_NEAR(gain(4), 2.047, 0.02);
  EXPECT_NEAR(gain(20), 5.46, 0.02);
  EXPECT_EQ(gain(1), 0.0);
}

// Biases at their priors are not known; a mistake would explain them.
TEST(Diagnose, WithSurveyedAnchorsAloneNamesNothing) {
  Data data = small_drive(9, kLonger_s);
  const model::Calibration calibration =
      model::surveyed_calibration(data.anchors, data.tags, data.priors, 0.02);
  EXPECT_THAT(causes_of(diagnose(std::move(data), calibration)), testing::IsEmpty());
}

// On a circle at constant speed nothing shows a clock, and a drift is a scale.
TEST(Diagnose, ACircleAtConstantSpeedShowsTheScaleAndNoClock) {
  constexpr double kSpeed_mps = 0.5;
  constexpr double kRadius_m = 5.0;
  for (const double noise : {0.0, 1.0}) {
    for (const double scale : {1.0, 1.2}) {
      test::Random random(11);
      Data data;
      for (double t_s = 0.0; t_s < 240.0; t_s += 0.05) {
        const double turned_rad = kSpeed_mps / kRadius_m * t_s;
        data.poses.push_back({.t_s = t_s,
                              .x_m = kRadius_m * std::sin(turned_rad) + 0.005 * noise * random.gaussian(),
                              .y_m = -kRadius_m * std::cos(turned_rad) + 0.005 * noise * random.gaussian(),
                              .z_m = 0.0,
                              .yaw_rad = model::wrap_angle(turned_rad + 0.002 * noise * random.gaussian())});
        data.odometry.push_back({t_s, scale * kSpeed_mps + 0.02 * noise * random.gaussian(),
                                 0.02 * noise * random.gaussian(),
                                 kSpeed_mps / kRadius_m + 0.006 * noise * random.gaussian()});
      }
      const std::vector<Finding> findings = diagnose(std::move(data));
      if (scale == 1.0) {
        EXPECT_THAT(causes_of(findings), testing::IsEmpty()) << "noise " << noise;
      } else {
        ASSERT_THAT(causes_of(findings), testing::ElementsAre("odometry-scale")) << "noise " << noise;
        EXPECT_NEAR(findings.front().value.front(), scale, 0.01);
      }
    }
  }
}

// As those of a lidar: a large part of the motion in a second, but not in two.
TEST(Diagnose, WhiteNoiseOfThePosesIsNoContradiction) {
  for (const std::uint64_t seed : {1U, 2U, 3U}) {
    test::Random random(seed);
    Data data = small_drive(seed);
    for (model::PoseSample& pose : data.poses) {
      pose.x_m += 0.05 * random.gaussian();
      pose.y_m += 0.05 * random.gaussian();
      pose.yaw_rad += 0.006 * random.gaussian();
    }
    EXPECT_THAT(causes_of(diagnose(std::move(data))), testing::IsEmpty()) << "seed " << seed;
  }
}

// On a straight drive the yaw rates of poses and odometry are both noise, whose ratio may be that of a unit.
TEST(Diagnose, AStraightDriveShowsNoYawRate) {
  constexpr double kSpeed_mps = 0.5;
  for (std::uint64_t seed = 1; seed <= 8; ++seed) {
    test::Random random(seed);
    Data data;
    for (double t_s = 0.0; t_s < 30.0; t_s += 0.05) {
      data.poses.push_back({.t_s = t_s,
                            .x_m = kSpeed_mps * t_s + 0.005 * random.gaussian(),
                            .y_m = 0.005 * random.gaussian(),
                            .z_m = 0.0,
                            .yaw_rad = 0.001 * random.gaussian()});
      data.odometry.push_back(
          {t_s, kSpeed_mps + 0.02 * random.gaussian(), 0.02 * random.gaussian(), 0.02 * random.gaussian()});
    }
    EXPECT_THAT(causes_of(diagnose(std::move(data))), testing::IsEmpty()) << "seed " << seed;
  }
}

TEST(Diagnose, OfNothingNamesNothing) {
  Data data = small_drive(6);
  data.poses.clear();
  EXPECT_THAT(diagnose(data), testing::IsEmpty());
  data.ranges.clear();
  data.odometry.clear();
  EXPECT_THAT(diagnose(std::move(data)), testing::IsEmpty());
}

TEST(Finding, IsAnObjectWithWhatIsKnown) {
  const std::vector findings{Finding{.cause = "lever-arm",
                                     .evidence = "e",
                                     .remedy = "r",
                                     .value = {0.1, 0.2, 0.3},
                                     .sigma = {0.01, 0.01, 0.02},
                                     .of = {3}},
                             Finding{.cause = "clock-offset", .evidence = "e", .remedy = "r", .value = {0.5}},
                             map_mismatch(0.5)};
  const auto json = to_json(findings);
  EXPECT_EQ(json[0]["value"], (std::vector<double>{0.1, 0.2, 0.3}));
  EXPECT_EQ(json[0]["of"], (std::vector<int>{3}));
  EXPECT_EQ(json[1]["value"], 0.5);
  EXPECT_FALSE(json[1].contains("sigma"));
  EXPECT_FALSE(json[2].contains("value"));
}

}  // namespace
}  // namespace groma::diagnosis
