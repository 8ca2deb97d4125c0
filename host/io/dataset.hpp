// A recorded or simulated run, in the folder format shared with researchers and scripts.
#pragma once

#include <array>
#include <cstddef>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "host/io/site_description.hpp"
#include "host/model/anchor_parameters.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// Rows that were read but have wrong values: dropped and counted, without an error.
struct DroppedRows {
  std::size_t range_out_of_bounds = 0;  // not within (0, kMaxRange_m]
  std::size_t unknown_tag = 0;          // not in tags.csv
  std::size_t unknown_anchor = 0;       // no 16-bit id, or not in anchors.csv if that file is read
  std::size_t late = 0;         // in any file: out of order, see kMaxDelay_s and kMaxOdometryOutOfOrder
  std::size_t repeated = 0;     // equal time; for ranges, also equal pair and range
  std::size_t implausible = 0;  // impossible poses and positions, or invalid covariances of them

  [[nodiscard]] std::size_t total() const {
    return range_out_of_bounds + unknown_tag + unknown_anchor + late + repeated + implausible;
  }
  DroppedRows& operator+=(const DroppedRows& other) {
    range_out_of_bounds += other.range_out_of_bounds;
    unknown_tag += other.unknown_tag;
    unknown_anchor += other.unknown_anchor;
    late += other.late;
    repeated += other.repeated;
    implausible += other.implausible;
    return *this;
  }
};

inline constexpr double kMaxRange_m = 1000.0;
inline constexpr double kMaxDelay_s = 0.5;
// An odometry sample may be earlier than this many preceding samples, or later than this many following ones.
inline constexpr std::size_t kMaxOdometryOutOfOrder = 4;

// A file that describes the site, as in a data set folder.
struct DescriptionFile {
  std::string name;
  std::string text;

  bool operator==(const DescriptionFile&) const = default;
};

// Facts about a run that was read from a log.
struct LogInfo {
  std::size_t sections = 0;
  std::size_t section = 0;  // the section that was read, from 1
  std::size_t damaged_bytes = 0;
};

struct Dataset {
  std::string name;
  std::string origin;  // "recorded" or "simulated"
  model::OdometryNoise odometry_noise;
  model::RangePriors range_priors;
  model::Surface surface;
  std::vector<model::Anchor> surveyed_anchors;  // by id; empty if anchors.csv is absent
  std::vector<model::Tag> tags;                 // by id
  std::vector<model::RangeSample> ranges;       // by time, then tag, then anchor; ascending
  // Ranges that were dropped because they are out of bounds or of an unknown tag or anchor, in the order
  // read; an id that is no 16-bit number is left out.
  std::vector<model::RangeSample> dropped_ranges;
  std::vector<model::OdometrySample> odometry;  // by time, strictly ascending
  // Poses: by time, strictly ascending; roll and pitch are each NaN if the file lacks them.
  std::vector<model::PoseSample> ground_truth;  // empty if the file is absent
  std::vector<model::PoseSample> pose_prior;    // ground truth if pose_prior.csv is absent
  // Samples of other sensors: by time, strictly ascending; empty if the sensor's file is absent. Each
  // absolute pose has a covariance.
  model::SensorTables sensor_samples;
  model::SensorDescription sensors;
  DroppedRows dropped;
  std::optional<LogInfo> log;  // none: read from a folder
  std::string sha256;          // digest of the files read, hexadecimal; see InputFiles::digest()
};

// Which files are read. dataset.yaml, tags.csv, ranges.csv and the surface files that dataset.yaml names are
// always read.
struct ReadOptions {
  bool surveyed_anchors = true;  // anchors.csv, if present; ranges to other anchors are then dropped
  bool odometry = true;          // odometry.csv, or steering.csv
  bool sensors = false;          // imu.csv and the other sensors' files, if present
  bool ground_truth = true;      // groundtruth.csv, if present
  bool pose_prior = true;        // pose_prior.csv, else groundtruth.csv
  bool needs_pose_prior = true;  // throw if neither is present; false: pose_prior stays empty
  bool needs_tags = true;        // throw if tags.csv of a folder has no rows
  std::optional<std::filesystem::path> pose_file = std::nullopt;  // replaces both as pose prior
  std::optional<std::size_t> log_section = std::nullopt;          // from 1; none: the log's last section
};

// Reads a folder, or a log that gromad recorded; a log has no surveyed anchors and no truth, and may have no
// poses. Throws DataError (a file is missing or cannot be read as numbers), ConfigError (dataset.yaml) or
// PermissionError.
[[nodiscard]] Dataset read_dataset(const std::filesystem::path& path, const ReadOptions& options = {});

// Reads poses from a file with the columns of groundtruth.csv; wrong rows are dropped and counted. Throws as
// read_dataset().
[[nodiscard]] std::vector<model::PoseSample> read_poses(const std::filesystem::path& path,
                                                        DroppedRows& dropped);

// The file with a folder's odometry: odometry.csv, or steering.csv where that alone is there.
[[nodiscard]] std::filesystem::path odometry_file(const std::filesystem::path& folder);

// Reads the odometry of a folder; empty if it has none. Late and repeated rows are dropped and counted.
// Throws as read_dataset().
[[nodiscard]] std::vector<model::OdometrySample> read_odometry(const std::filesystem::path& folder,
                                                               DroppedRows& dropped);

// Reads the table that `groma survey` prints: anchor_id,other_id,range_m,sigma_m,count. Rows with a wrong id
// or range are dropped and counted. Throws as read_dataset().
[[nodiscard]] std::vector<model::AnchorRange> read_survey(const std::filesystem::path& path,
                                                          DroppedRows& dropped);

}  // namespace groma::io
