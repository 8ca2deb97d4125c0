// The tables of a data set as a source fills them: named columns, in the units of the source.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Geometry>

#include "host/io/dataset.hpp"

namespace groma::importer {

enum class Table {
  kRanges,
  kOdometry,
  kPosePrior,
  kGroundTruth,
  kAbsolutePose,
  kImu,
  kGnss,
  kZeroVelocity,
  kTags,
  kAnchors
};
// In the order of Table: the names of the files without ".csv".
inline constexpr std::array<std::string_view, 10> kTableNames{
    "ranges", "odometry", "pose_prior",    "groundtruth", "absolute_pose",
    "imu",    "gnss",     "zero_velocity", "tags",        "anchors"};
[[nodiscard]] constexpr std::string_view name_of(Table table) noexcept {
  return kTableNames[static_cast<std::size_t>(table)];
}

struct ColumnType {
  std::string_view name;
  bool required = true;
  // Its unit: metres and radians to these powers.
  int length = 0;
  int angle = 0;
};
// The first column of each table but tags and anchors is t_s. A pose also has yaw_rad, or qx, qy, qz and qw.
// Odometry has vx_mps and omega_radps; or dx_m and dyaw_rad, the increments since the row before; or left_mps
// and right_mps, the speeds of two wheels, and wheel_base_m between them.
[[nodiscard]] std::span<const ColumnType> columns_of(Table table) noexcept;

// SI units per unit of the source.
struct Units {
  double time_s = 1.0;
  double length_m = 1.0;
  double angle_rad = 1.0;
  bool is_date = false;  // time is a date and time of day
  // Whether the user has given them: then they are not checked.
  bool time_is_given = false;
  bool length_is_given = false;
  bool angle_is_given = false;
};

struct Cell {
  double number = std::numeric_limits<double>::quiet_NaN();
  std::int64_t whole = 0;  // the same as a whole number, exactly, if is_whole
  bool is_whole = false;
  bool is_known = false;
};
[[nodiscard]] Cell cell(double number) noexcept;
[[nodiscard]] Cell cell(std::int64_t whole) noexcept;

// Adds a row to its table, in SI units. `cells` are those of columns_of(table), t_s in the unit of the
// source. Returns the problem with the row, such as "qx, qy, qz and qw have the norm 0.5, not 1"; empty: it
// was added.
[[nodiscard]] std::string add_row(Table table, std::span<const Cell> cells, const Units& units,
                                  io::Dataset& dataset);

// The times of a table's rows; none for tags and anchors.
[[nodiscard]] std::vector<double> times_of(Table table, const io::Dataset& dataset);

[[nodiscard]] std::size_t rows_of(Table table, const io::Dataset& dataset);

// Rows of one time keep their order. Tags and anchors stay as they are.
void sort_by_time(Table table, io::Dataset& dataset);

// The poses of the table from row `begin` on are of another frame of the robot; base_link has the pose
// `in_body` in it. Makes them those of base_link. Roll and pitch that are not known stay so.
void move_to_base_link(Table table, std::size_t begin, const Eigen::Isometry3d& in_body,
                       io::Dataset& dataset);

// Empties the table.
void clear(Table table, io::Dataset& dataset);

// Adds the table's rows of another data set.
void append(Table table, const io::Dataset& from, io::Dataset& to);

}  // namespace groma::importer
