#include "host/importer/table.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <type_traits>
#include <utility>

#include <Eigen/Geometry>

namespace groma::importer {

namespace {

constexpr bool kOptional = false;

constexpr std::array kRangeColumns{ColumnType{"t_s"},
                                   ColumnType{"tag_id"},
                                   ColumnType{"anchor_id"},
                                   ColumnType{"range_m", true, 1},
                                   ColumnType{"first_path_power_dbm", kOptional},
                                   ColumnType{"receive_power_dbm", kOptional},
                                   ColumnType{"clock_offset_ppm", kOptional},
                                   ColumnType{"noise", kOptional},
                                   ColumnType{"line_of_sight", kOptional},
                                   ColumnType{"corrections", kOptional},
                                   ColumnType{"network_time_dtu", kOptional}};
enum OdometryColumn : std::size_t { kVx = 1, kVy, kOmega, kDx, kDyaw, kLeft, kRight, kWheelBase };
constexpr std::array kOdometryColumns{ColumnType{"t_s"},
                                      ColumnType{"vx_mps", kOptional, 1},
                                      ColumnType{"vy_mps", kOptional, 1},
                                      ColumnType{"omega_radps", kOptional, 0, 1},
                                      ColumnType{"dx_m", kOptional, 1},
                                      ColumnType{"dyaw_rad", kOptional, 0, 1},
                                      ColumnType{"left_mps", kOptional, 1},
                                      ColumnType{"right_mps", kOptional, 1},
                                      ColumnType{"wheel_base_m", kOptional, 1}};
enum PoseColumn : std::size_t { kX = 1, kY, kZ, kYaw, kRoll, kPitch, kQx, kQw = kQx + 3, kPxx };
constexpr std::array kPoseColumns{ColumnType{"t_s"},
                                  ColumnType{"x_m", true, 1},
                                  ColumnType{"y_m", true, 1},
                                  ColumnType{"z_m", kOptional, 1},
                                  ColumnType{"yaw_rad", kOptional, 0, 1},
                                  ColumnType{"roll_rad", kOptional, 0, 1},
                                  ColumnType{"pitch_rad", kOptional, 0, 1},
                                  ColumnType{"qx", kOptional},
                                  ColumnType{"qy", kOptional},
                                  ColumnType{"qz", kOptional},
                                  ColumnType{"qw", kOptional},
                                  ColumnType{"p_xx", kOptional, 2},
                                  ColumnType{"p_xy", kOptional, 2},
                                  ColumnType{"p_xt", kOptional, 1, 1},
                                  ColumnType{"p_yy", kOptional, 2},
                                  ColumnType{"p_yt", kOptional, 1, 1},
                                  ColumnType{"p_tt", kOptional, 0, 2}};
constexpr std::array kImuColumns{ColumnType{"t_s"}, ColumnType{"omega_radps", true, 0, 1}};
constexpr std::array kGnssColumns{ColumnType{"t_s"},           ColumnType{"x_m", true, 1},
                                  ColumnType{"y_m", true, 1},  ColumnType{"p_xx", true, 2},
                                  ColumnType{"p_xy", true, 2}, ColumnType{"p_yy", true, 2}};
constexpr std::array kTimeColumns{ColumnType{"t_s"}};
constexpr std::array kTagColumns{ColumnType{"tag_id"}, ColumnType{"x_m", true, 1}, ColumnType{"y_m", true, 1},
                                 ColumnType{"z_m", true, 1}};
constexpr std::array kAnchorColumns{ColumnType{"anchor_id"}, ColumnType{"x_m", true, 1},
                                    ColumnType{"y_m", true, 1}, ColumnType{"z_m", true, 1}};

double power(double base, int exponent) {
  double out = 1.0;
  for (int i = 0; i < exponent; ++i) out *= base;
  return out;
}

// A row's values in SI units; NaN: unknown.
class Row {
 public:
  Row(Table table, std::span<const Cell> cells, const Units& units) : cells_(cells) {
    const std::span<const ColumnType> columns = columns_of(table);
    for (std::size_t i = 0; i < cells.size(); ++i) {
      const bool is_time = columns[i].name == "t_s";
      // Divided where the unit is a fraction: 1000 ms is then exactly 1 s.
      values_[i] = is_time && units.time_s < 1.0
                       ? cells[i].number / std::round(1.0 / units.time_s)
                       : cells[i].number * (is_time ? units.time_s
                                                    : power(units.length_m, columns[i].length) *
                                                          power(units.angle_rad, columns[i].angle));
    }
  }
  [[nodiscard]] double operator[](std::size_t column) const { return values_[column]; }
  [[nodiscard]] bool has(std::size_t column) const { return cells_[column].is_known; }
  [[nodiscard]] float optional(std::size_t column) const {
    return has(column) ? static_cast<float>(values_[column]) : model::kUnknown;
  }
  [[nodiscard]] std::optional<model::NodeId> id(std::size_t column) const {
    const Cell& cell = cells_[column];
    if (!cell.is_whole || cell.whole < 0 || cell.whole > std::numeric_limits<model::NodeId>::max())
      return std::nullopt;
    return static_cast<model::NodeId>(cell.whole);
  }
  [[nodiscard]] std::int64_t whole(std::size_t column) const {
    return cells_[column].is_whole ? cells_[column].whole : 0;
  }

 private:
  std::span<const Cell> cells_;
  std::array<double, kPoseColumns.size()> values_{};
};

std::string add_range(const Row& row, std::vector<model::RangeSample>& ranges) {
  const std::optional<model::NodeId> tag = row.id(1);
  const std::optional<model::NodeId> anchor = row.id(2);
  if (!tag || !anchor) return fmt::format("{} is no id from 0 to 65535", tag ? "anchor_id" : "tag_id");
  const std::int64_t line_of_sight = row.whole(8);
  const std::int64_t corrections = row.whole(9);
  ranges.push_back(
      {row[0], *tag, *anchor, row[3], row.optional(4), row.optional(5), row.optional(6), row.optional(7),
       static_cast<model::LineOfSight>(line_of_sight >= 0 && line_of_sight <= 3 ? line_of_sight : 0),
       static_cast<std::uint8_t>(corrections >= 0 && corrections <= 0xFF ? corrections : 0), row.whole(10)});
  return {};
}

std::string add_odometry(const Row& row, std::vector<model::OdometrySample>& odometry) {
  if (row.has(kVx) && row.has(kOmega)) {
    odometry.push_back({row[0], row[kVx], row.has(kVy) ? row[kVy] : 0.0, row[kOmega]});
  } else if (row.has(kLeft) && row.has(kRight) && row.has(kWheelBase)) {
    if (!(row[kWheelBase] > 0.0)) return "wheel_base_m is not positive";
    odometry.push_back(
        {row[0], 0.5 * (row[kLeft] + row[kRight]), 0.0, (row[kRight] - row[kLeft]) / row[kWheelBase]});
  } else if (row.has(kDx) && row.has(kDyaw)) {
    // A sample holds until the next: the increment since the row before is that row's velocity. The first row
    // has none before it, and the last keeps the velocity that it ends with.
    model::OdometrySample sample{row[0], 0.0, 0.0, 0.0};
    if (!odometry.empty()) {
      const double step_s = row[0] - odometry.back().t_s;
      if (!(step_s > 0.0))
        return "dx_m and dyaw_rad have no time in which they happened: t_s does not increase";
      sample.vx_mps = odometry.back().vx_mps = row[kDx] / step_s;
      sample.omega_radps = odometry.back().omega_radps = row[kDyaw] / step_s;
    }
    odometry.push_back(sample);
  } else {
    return "the odometry has neither vx_mps and omega_radps, nor dx_m and dyaw_rad, nor left_mps, right_mps "
           "and wheel_base_m";
  }
  return {};
}

// Yaw, pitch and roll (ZYX) of a unit quaternion.
void set_attitude(const Eigen::Quaterniond& rotation, model::PoseSample& pose) {
  const Eigen::Matrix3d r = rotation.toRotationMatrix();
  pose.yaw_rad = std::atan2(r(1, 0), r(0, 0));
  pose.pitch_rad = std::asin(std::clamp(-r(2, 0), -1.0, 1.0));
  pose.roll_rad = std::atan2(r(2, 1), r(2, 2));
}

// ROS 2 has no unknown covariance: 0, or a large variance, stands for it.
constexpr double kUnknownVariance = 1e6;

std::string add_pose(const Row& row, bool with_covariance, std::vector<model::PoseSample>& poses) {
  model::PoseSample pose{row[0], row[kX], row[kY], row.has(kZ) ? row[kZ] : 0.0};
  if (row.has(kYaw)) {
    pose.yaw_rad = row[kYaw];
    if (row.has(kRoll)) pose.roll_rad = row[kRoll];
    if (row.has(kPitch)) pose.pitch_rad = row[kPitch];
  } else if (row.has(kQx) && row.has(kQw)) {
    const Eigen::Quaterniond rotation(row[kQw], row[kQx], row[kQx + 1], row[kQx + 2]);
    constexpr double kTolerance = 0.01;
    if (std::abs(rotation.norm() - 1.0) > kTolerance)
      return fmt::format("qx, qy, qz and qw have the norm {:.3f}, not 1", rotation.norm());
    set_attitude(rotation.normalized(), pose);
  } else {
    return "the pose has neither yaw_rad nor qx, qy, qz and qw";
  }
  if (with_covariance && row.has(kPxx) && row[kPxx] > 0.0 && row[kPxx] < kUnknownVariance) {
    model::PoseCovariance& covariance = pose.covariance.emplace();
    for (std::size_t i = 0; i < covariance.size(); ++i) covariance[i] = row[kPxx + i];
  }
  if (with_covariance && !pose.covariance) return "the pose has no covariance p_xx to p_tt";
  poses.push_back(pose);
  return {};
}

template <typename Node>
std::string add_node(const Row& row, std::vector<Node>& nodes) {
  const std::optional<model::NodeId> id = row.id(0);
  if (!id) return "the id is no number from 0 to 65535";
  const auto at = std::lower_bound(nodes.begin(), nodes.end(), *id,
                                   [](const Node& node, model::NodeId of) { return node.id < of; });
  if (at != nodes.end() && at->id == *id) return fmt::format("id {} occurs twice", *id);
  nodes.insert(at, {*id, {row[1], row[2], row[3]}});
  return {};
}

template <typename Samples>
std::vector<double> times(const Samples& samples) {
  std::vector<double> out;
  out.reserve(samples.size());
  for (const auto& sample : samples) out.push_back(sample.t_s);
  return out;
}

// Calls use(samples) with the table's vector.
template <typename Set, typename Use>
auto with_samples(Table table, Set& dataset, const Use& use) {
  using model::samples_of;
  switch (table) {
    case Table::kRanges:
      return use(dataset.ranges);
    case Table::kOdometry:
      return use(dataset.odometry);
    case Table::kPosePrior:
      return use(dataset.pose_prior);
    case Table::kGroundTruth:
      return use(dataset.ground_truth);
    case Table::kAbsolutePose:
      return use(samples_of<model::PoseSample>(dataset.sensor_samples));
    case Table::kImu:
      return use(samples_of<model::YawRateSample>(dataset.sensor_samples));
    case Table::kGnss:
      return use(samples_of<model::PositionSample>(dataset.sensor_samples));
    case Table::kZeroVelocity:
      return use(samples_of<model::ZeroVelocitySample>(dataset.sensor_samples));
    case Table::kTags:
      return use(dataset.tags);
    case Table::kAnchors:
      break;
  }
  return use(dataset.surveyed_anchors);
}

}  // namespace

std::span<const ColumnType> columns_of(Table table) noexcept {
  switch (table) {
    case Table::kRanges:
      return kRangeColumns;
    case Table::kOdometry:
      return kOdometryColumns;
    case Table::kPosePrior:
    case Table::kGroundTruth:
    case Table::kAbsolutePose:
      return kPoseColumns;
    case Table::kImu:
      return kImuColumns;
    case Table::kGnss:
      return kGnssColumns;
    case Table::kZeroVelocity:
      return kTimeColumns;
    case Table::kTags:
      return kTagColumns;
    case Table::kAnchors:
      break;
  }
  return kAnchorColumns;
}

Cell cell(double number) noexcept {
  constexpr double kExact = 9007199254740992.0;  // 2^53
  const bool is_whole = std::abs(number) < kExact && number == std::round(number);
  return {number, is_whole ? static_cast<std::int64_t>(number) : 0, is_whole, !std::isnan(number)};
}

Cell cell(std::int64_t whole) noexcept {
  return {static_cast<double>(whole), whole, true, true};
}

std::string add_row(Table table, std::span<const Cell> cells, const Units& units, io::Dataset& dataset) {
  const std::span<const ColumnType> columns = columns_of(table);
  for (std::size_t i = 0; i < columns.size(); ++i) {
    if (columns[i].required && !cells[i].is_known) return fmt::format("{} is not a number", columns[i].name);
    if (cells[i].is_known && !std::isfinite(cells[i].number))
      return fmt::format("{} is not finite", columns[i].name);
  }
  const Row row(table, cells, units);
  return with_samples(table, dataset, [&]<class Sample>(std::vector<Sample>& samples) -> std::string {
    if constexpr (std::is_same_v<Sample, model::RangeSample>) {
      return add_range(row, samples);
    } else if constexpr (std::is_same_v<Sample, model::OdometrySample>) {
      return add_odometry(row, samples);
    } else if constexpr (std::is_same_v<Sample, model::PoseSample>) {
      return add_pose(row, table == Table::kAbsolutePose, samples);
    } else if constexpr (std::is_same_v<Sample, model::YawRateSample>) {
      samples.push_back({row[0], row[1]});
    } else if constexpr (std::is_same_v<Sample, model::PositionSample>) {
      samples.push_back({row[0], row[1], row[2], {row[3], row[4], row[5]}});
    } else if constexpr (std::is_same_v<Sample, model::ZeroVelocitySample>) {
      samples.push_back({row[0]});
    } else {
      return add_node(row, samples);
    }
    return {};
  });
}

std::vector<double> times_of(Table table, const io::Dataset& dataset) {
  return with_samples(table, dataset, []<class Sample>(const std::vector<Sample>& samples) {
    if constexpr (std::is_same_v<Sample, model::Tag> || std::is_same_v<Sample, model::Anchor>) {
      return std::vector<double>();
    } else {
      return times(samples);
    }
  });
}

std::size_t rows_of(Table table, const io::Dataset& dataset) {
  return with_samples(table, dataset, [](const auto& samples) { return samples.size(); });
}

void sort_by_time(Table table, io::Dataset& dataset) {
  with_samples(table, dataset, []<class Sample>(std::vector<Sample>& samples) {
    if constexpr (!std::is_same_v<Sample, model::Tag> && !std::is_same_v<Sample, model::Anchor>)
      std::stable_sort(samples.begin(), samples.end(),
                       [](const Sample& a, const Sample& b) { return a.t_s < b.t_s; });
  });
}

void move_to_base_link(Table table, std::size_t begin, const Eigen::Isometry3d& in_body,
                       io::Dataset& dataset) {
  with_samples(table, dataset, [&]<class Sample>(std::vector<Sample>& samples) {
    if constexpr (std::is_same_v<Sample, model::PoseSample>) {
      for (std::size_t i = begin; i < samples.size(); ++i) {
        model::PoseSample& pose = samples[i];
        const bool is_level = !std::isfinite(pose.roll_rad) || !std::isfinite(pose.pitch_rad);
        const Eigen::Isometry3d body =
            Eigen::Translation3d(pose.x_m, pose.y_m, pose.z_m) *
            (Eigen::AngleAxisd(pose.yaw_rad, Eigen::Vector3d::UnitZ()) *
             Eigen::AngleAxisd(is_level ? 0.0 : pose.pitch_rad, Eigen::Vector3d::UnitY()) *
             Eigen::AngleAxisd(is_level ? 0.0 : pose.roll_rad, Eigen::Vector3d::UnitX()));
        const Eigen::Isometry3d base_link = body * in_body;
        const Eigen::Vector3d at_m = base_link.translation();
        pose.x_m = at_m.x();
        pose.y_m = at_m.y();
        pose.z_m = at_m.z();
        set_attitude(Eigen::Quaterniond(base_link.rotation()), pose);
        if (is_level) pose.roll_rad = pose.pitch_rad = model::PoseSample().roll_rad;
      }
    }
  });
}

void clear(Table table, io::Dataset& dataset) {
  with_samples(table, dataset, [](auto& samples) { samples.clear(); });
}

void append(Table table, const io::Dataset& from, io::Dataset& to) {
  with_samples(table, to, [&]<class Sample>(std::vector<Sample>& samples) {
    with_samples(table, from, [&]<class Other>(const std::vector<Other>& others) {
      if constexpr (std::is_same_v<Sample, Other>)
        samples.insert(samples.end(), others.begin(), others.end());
    });
  });
}

}  // namespace groma::importer
