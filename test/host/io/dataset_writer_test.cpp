#include "host/io/dataset_writer.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <filesystem>
#include <limits>
#include <numeric>
#include <optional>
#include <tuple>
#include <type_traits>
#include <utility>
#include <variant>
#include <vector>

#include "host/io/error.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::io {
namespace {

// The members of a struct as a tuple. A new member of one of these structs breaks the compilation here: add
// it here, set it in sample(), and write it in write_dataset().
auto members(const Dataset& of) {
  const auto& [name, origin, odometry_noise, range_priors, surface, surveyed_anchors, tags, ranges,
               dropped_ranges, odometry, ground_truth, pose_prior, sensor_samples, sensors, dropped, log,
               sha256] = of;
  return std::tie(name, origin, odometry_noise, range_priors, surface, surveyed_anchors, tags, ranges,
                  dropped_ranges, odometry, ground_truth, pose_prior, sensor_samples, sensors, dropped, log,
                  sha256);
}
auto members(const model::OdometryNoise& of) {
  const auto& [vx, vy, omega, curve] = of;
  return std::tie(vx, vy, omega, curve);
}
auto members(const model::ScalarPrior& of) {
  const auto& [mean, sigma] = of;
  return std::tie(mean, sigma);
}
auto members(const model::RangePriors& of) {
  return std::apply([&](const auto&... term) { return std::tie(of.sigma_m, of.*term.prior...); },
                    model::kPairTerms);
}
auto members(const model::SurfaceMismatch& of) {
  const auto& [sigma, slope_sigma, length] = of;
  return std::tie(sigma, slope_sigma, length);
}
auto members(const model::BSpline::Grid& of) {
  const auto& [x0, y0, dx, dy, nx, ny] = of;
  return std::tie(x0, y0, dx, dy, nx, ny);
}
auto members(const model::Chart& of) {
  const auto& [name, shape, domain, mismatch] = of;
  return std::tie(name, shape, domain, mismatch);
}
auto members(const model::Anchor& of) {
  const auto& [id, position] = of;
  return std::tie(id, position);
}
auto members(const model::Tag& of) {
  const auto& [id, lever_arm] = of;
  return std::tie(id, lever_arm);
}
auto members(const model::RangeSample& of) {
  const auto& [t, tag, anchor, range, first_path_power, receive_power, clock_offset, noise, line_of_sight,
               corrections, network_time] = of;
  return std::tie(t, tag, anchor, range, first_path_power, receive_power, clock_offset, noise, line_of_sight,
                  corrections, network_time);
}
auto members(const model::OdometrySample& of) {
  const auto& [t, vx, vy, omega] = of;
  return std::tie(t, vx, vy, omega);
}
auto members(const model::PoseSample& of) {
  const auto& [t, x, y, z, yaw, roll, pitch, covariance] = of;
  return std::tie(t, x, y, z, yaw, roll, pitch, covariance);
}
auto members(const model::YawRateSample& of) {
  const auto& [t, omega] = of;
  return std::tie(t, omega);
}
auto members(const model::PositionSample& of) {
  const auto& [t, x, y, covariance] = of;
  return std::tie(t, x, y, covariance);
}
auto members(const model::ZeroVelocitySample& of) {
  const auto& [t] = of;
  return std::tie(t);
}
auto members(const model::SensorDescription& of) {
  const auto& [gyro_sigma, gyro_bias_sigma, lever_arm] = of;
  return std::tie(gyro_sigma, gyro_bias_sigma, lever_arm);
}
auto members(const DroppedRows& of) {
  const auto& [range_out_of_bounds, unknown_tag, unknown_anchor, late, repeated, implausible] = of;
  return std::tie(range_out_of_bounds, unknown_tag, unknown_anchor, late, repeated, implausible);
}
auto members(const LogInfo& of) {
  const auto& [sections, section, damaged_bytes] = of;
  return std::tie(sections, section, damaged_bytes);
}
// A plane is given by its height and gradient.
auto members(const model::Plane& of) {
  const model::SurfacePoint origin = of.at(0.0, 0.0);
  return std::tuple(origin.z_m, origin.gradient);
}
auto members(const model::BSpline& of) {
  return std::tie(of.grid(), of.heights_m());
}
auto members(const model::Surface& of) {
  return std::tie(of.charts());
}

template <typename T>
concept Structure = requires(const T& of) {
  members(of);
};

template <typename T>
bool same(const T& a, const T& b);
template <typename T>
bool same(const std::vector<T>& a, const std::vector<T>& b) {
  if (a.size() != b.size()) return false;
  for (std::size_t i = 0; i < a.size(); ++i) {
    if (!same(a[i], b[i])) return false;
  }
  return true;
}
template <typename... T>
bool same(const std::tuple<T...>& a, const std::tuple<T...>& b) {
  return (same(std::get<T>(a), std::get<T>(b)) && ...);
}
template <typename T>
bool same(const std::optional<T>& a, const std::optional<T>& b) {
  return a.has_value() == b.has_value() && (!a || same(*a, *b));
}
template <typename... T>
bool same(const std::variant<T...>& a, const std::variant<T...>& b) {
  return a.index() == b.index() &&
         std::visit([&b](const auto& of) { return same(of, std::get<std::decay_t<decltype(of)>>(b)); }, a);
}
// Equal to the bit, except that all NaNs are equal.
template <typename T>
bool same(const T& a, const T& b) {
  if constexpr (Structure<T>) {
    return std::apply(
        [&b](const auto&... of_a) {
          return std::apply([&](const auto&... of_b) { return (same(of_a, of_b) && ...); }, members(b));
        },
        members(a));
  } else if constexpr (std::is_floating_point_v<T>) {
    return a == b || (std::isnan(a) && std::isnan(b));
  } else {
    return a == b;
  }
}

// The indices of the members that are equal in both.
template <typename T>
std::vector<std::size_t> same_members(const T& a, const T& b) {
  std::vector<std::size_t> out;
  const auto of_a = members(a);
  const auto of_b = members(b);
  const auto compare = [&]<std::size_t... kAt>(std::index_sequence<kAt...>) {
    ((same(std::get<kAt>(of_a), std::get<kAt>(of_b)) ? out.push_back(kAt) : void()), ...);
  };
  compare(std::make_index_sequence<std::tuple_size_v<decltype(of_a)>>());
  return out;
}

// Each member differs from that of an empty data set, and each member of the last row of each table from that
// of an empty row, except the members that describe the reading.
Dataset sample() {
  Dataset dataset;
  dataset.name = "a \"quoted\" \\ name: 1";
  dataset.origin = "simulated";
  dataset.odometry_noise = {0.021, 0.032, 0.0061, 0.04};
  dataset.range_priors.sigma_m = 0.07;
  for (const model::PairTerm& term : model::kPairTerms)
    dataset.range_priors.*term.prior = {term.neutral + 0.2, 0.3};
  dataset.surface = model::Surface(std::vector<model::Chart>{
      {"ground",
       model::BSpline({-3.5, 1.25, 0.5, 1.0 / 3.0, 5, 6}, {0, 0.1, 0.2, 0.3, 0.4,       7,  //
                                                           1, 1,   1,   1,   1,         6,  //
                                                           0, 0,   0,   0,   0.125,     5,  //
                                                           2, 2,   2,   2,   1.0 / 7.0, 4,  //
                                                           3, 3,   3,   3,   3,         3}),
       {{-3.0, 1.5}, {4.0, 1.5}, {1.0 / 3.0, 8.0}},
       {0.02, 0.011, 3.5}},
      {"roof",
       model::Plane(4.25, {-0.02, 0.01, 2.0}),
       {{-1.0, -1.0}, {6.0, -1.0}, {6.0, 5.0}},
       {0.03, 0.012, 4.5}}});
  dataset.surveyed_anchors = {{4, {1.0 / 3.0, 2.0, 3.0}}, {900, {-1.5, 0.0, 0.25}}};
  dataset.tags = {{1, {0.75, 0.45, 1.9}}, {2, {-0.7, 0.1, 0.35}}};
  dataset.ranges = {
      {0.1, 1, 4, 5.25},
      {0.1 + 1e-9, 2, 900, std::sqrt(2.0), -80.5F, -79.25F, -3.25F, 57.0F, model::LineOfSight::kUnlikely,
       model::kAntennaDelaysApplied | model::kPowerBiasCorrected, 9'123'456'789'012'345}};
  dataset.odometry = {{0.0, 0.5, -0.01, 0.002}, {0.02, 1.0 / 3.0, 0.015, -0.002}};
  const model::PoseCovariance covariance{0.04, 0.01, -1.0 / 300.0, 0.09, 0.002, 0.0025};
  dataset.ground_truth = {{0.0, 1.0, 2.0, 0.5, 3.1},
                          {0.05, 1.0 / 7.0, 2.0, 0.5, -3.1, 0.03, -0.04, covariance}};
  dataset.pose_prior = {{0.0, 1.01, 2.02, 0.5, 3.0, 0.01, -0.02},
                        {0.1, 1.03, 2.02, 0.5, 3.0, 0.01, -0.02, covariance}};
  model::samples_of<model::YawRateSample>(dataset.sensor_samples) = {{0.003, 0.11}, {0.013, -1.0 / 9.0}};
  model::samples_of<model::PositionSample>(dataset.sensor_samples) = {
      {0.2, 5.5, -6.25, {0.5, 0.0, 0.4}}, {0.3, 5.6, -1.0 / 11.0, {0.6, 0.1, 0.45}}};
  constexpr double kNoTilt = std::numeric_limits<double>::quiet_NaN();
  model::samples_of<model::PoseSample>(dataset.sensor_samples) = {
      {0.4, 7.5, -8.25, 0.0, 1.5, kNoTilt, kNoTilt, covariance},
      {0.5, 1.0 / 13.0, -8.5, 0.0, 1.25, 0.015, -0.025, covariance}};
  model::samples_of<model::ZeroVelocitySample>(dataset.sensor_samples) = {{0.6}, {2.0 / 3.0}};
  dataset.sensors = {.gyro_sigma_radps = 0.0031,
                     .gyro_bias_sigma_radps = 0.0017,
                     .gnss_lever_arm_m = Eigen::Vector3d(0.125, -0.25, 1.0 / 17.0)};
  return dataset;
}

ReadOptions everything() {
  ReadOptions options;
  options.sensors = true;
  return options;
}

// These members of Dataset describe the reading.
constexpr std::size_t kDroppedRanges = 8;
constexpr std::size_t kDropped = 14;
constexpr std::size_t kLog = 15;
constexpr std::size_t kSha256 = 16;

TEST(DatasetWriter, EachMemberOfTheSampleIsSet) {
  const Dataset set = sample();
  EXPECT_EQ(same_members(set, Dataset{}), (std::vector{kDroppedRanges, kDropped, kLog, kSha256}));
  const std::vector<std::size_t> none;
  EXPECT_EQ(same_members(set.odometry_noise, {}), none);
  EXPECT_EQ(same_members(set.range_priors, {}), none);
  for (const model::PairTerm& term : model::kPairTerms)
    EXPECT_EQ(same_members(set.range_priors.*term.prior, {}), none);
  EXPECT_EQ(same_members(set.sensors, {}), none);
  EXPECT_EQ(same_members(set.surveyed_anchors.back(), {}), none);
  EXPECT_EQ(same_members(set.tags.back(), {}), none);
  EXPECT_EQ(same_members(set.ranges.back(), {}), none);
  EXPECT_EQ(same_members(set.odometry.back(), {}), none);
  EXPECT_EQ(same_members(set.ground_truth.back(), {}), none);
  EXPECT_EQ(same_members(set.pose_prior.back(), {}), none);
  EXPECT_EQ(same_members(model::samples_of<model::YawRateSample>(set.sensor_samples).back(), {}), none);
  EXPECT_EQ(same_members(model::samples_of<model::PositionSample>(set.sensor_samples).back(), {}), none);
  EXPECT_EQ(same_members(model::samples_of<model::PoseSample>(set.sensor_samples).back(), {}),
            (std::vector<std::size_t>{3}))
      << "it has no height";
  EXPECT_EQ(same_members(model::samples_of<model::ZeroVelocitySample>(set.sensor_samples).back(), {}), none);
  for (const model::Chart& chart : set.surface.charts()) {
    EXPECT_EQ(same_members(chart, {}), none);
    EXPECT_EQ(same_members(chart.mismatch, {}), none);
  }
}

TEST(DatasetWriter, AWrittenDataSetReadsBackEqual) {
  const test::ScratchFolder scratch;
  const Dataset written = sample();
  write_dataset(scratch / "run", written);
  const Dataset read = read_dataset(scratch / "run", everything());
  std::vector<std::size_t> as_written(kSha256);
  std::iota(as_written.begin(), as_written.end(), std::size_t{0});
  EXPECT_EQ(same_members(read, written), as_written);
  EXPECT_EQ(read.sha256.size(), 64U);

  // A second write gives the same files and the same data set.
  write_dataset(scratch / "again", read);
  EXPECT_TRUE(same(read_dataset(scratch / "again", everything()), read));
}

TEST(DatasetWriter, ASingleFloorKeepsItsNameAndDomain) {
  const test::ScratchFolder scratch;
  Dataset written = sample();
  written.surface = model::Surface({written.surface.charts().front()});
  write_dataset(scratch.path(), written);
  EXPECT_TRUE(same(read_dataset(scratch.path()).surface, written.surface));
}

TEST(DatasetWriter, APlaneIsWrittenIntoTheDescription) {
  const test::ScratchFolder scratch;
  Dataset written = sample();
  written.surface = model::Plane(0.25, {-0.02, 0.01, 2.0});
  write_dataset(scratch.path(), written);
  EXPECT_FALSE(std::filesystem::exists(scratch / "surface.csv"));
  EXPECT_TRUE(same(read_dataset(scratch.path()).surface, written.surface));
}

TEST(DatasetWriter, OmitsFilesOfEmptyTables) {
  const test::ScratchFolder scratch;
  Dataset written = sample();
  written.surveyed_anchors.clear();
  written.ground_truth.clear();
  written.sensor_samples = {};
  write_dataset(scratch.path(), written);
  EXPECT_FALSE(std::filesystem::exists(scratch / "anchors.csv"));
  EXPECT_FALSE(std::filesystem::exists(scratch / "groundtruth.csv"));
  for (const char* table : {"imu.csv", "gnss.csv", "absolute_pose.csv", "zero_velocity.csv"})
    EXPECT_FALSE(std::filesystem::exists(scratch / table)) << table;
  EXPECT_TRUE(read_dataset(scratch.path()).surveyed_anchors.empty());
}

TEST(DatasetWriter, OmitsRangeColumnsWithoutAnyValue) {
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

TEST(DatasetWriter, ThrowsWhereItCannotWrite) {
  const test::ScratchFolder scratch;
  scratch.write("file", "");
  EXPECT_THROW(write_dataset(scratch / "file", sample()), Error);
}

}  // namespace
}  // namespace groma::io
