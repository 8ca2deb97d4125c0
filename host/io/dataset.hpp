// A recorded or simulated run: the folder format shared with researchers and scripts.
#pragma once

#include <array>
#include <cstddef>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "host/io/site_description.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// Rows that could be read but are wrong: dropped, counted, never an error.
struct DroppedRows {
  std::size_t range_out_of_bounds = 0;  // not within (0, kMaxRange_m]
  std::size_t unknown_tag = 0;          // not in tags.csv
  std::size_t unknown_anchor = 0;       // no 16-bit id, or not in anchors.csv where that is read
  std::size_t late = 0;         // of any file: out of order, see kMaxLateness_s and kMaxOdometryOutOfOrder
  std::size_t repeated = 0;     // same instant; of ranges, the same pair and range too
  std::size_t implausible = 0;  // poses and positions that no robot has, or whose covariance is none

  [[nodiscard]] std::size_t total() const {
    return range_out_of_bounds + unknown_tag + unknown_anchor + late + repeated + implausible;
  }
};

inline constexpr double kMaxRange_m = 1000.0;
inline constexpr double kMaxLateness_s = 0.5;
// An odometry sample may be behind as many others that came before it, or ahead of as many that came after
// it.
inline constexpr std::size_t kMaxOdometryOutOfOrder = 4;

// A file that tells of the site, as a data set folder has it.
struct DescriptionFile {
  std::string name;
  std::string text;
};

// What else is known of a run that came from a log.
struct LogInfo {
  std::size_t sections = 0;
  std::size_t section = 0;  // the one that was read, from 1
  std::size_t damaged_bytes = 0;
};

struct Dataset {
  std::string name;
  std::string origin;  // "recorded" or "simulated"
  model::OdometryNoise odometry_noise;
  model::RangePriors range_priors;
  model::Surface surface;
  std::vector<model::Anchor> surveyed_anchors;  // by id; empty where anchors.csv is absent
  std::vector<model::Tag> tags;                 // by id
  std::vector<model::RangeSample> ranges;       // by time, then tag, then anchor; ascending
  std::vector<model::OdometrySample> odometry;  // by time, strictly ascending
  // Poses: by time, strictly ascending; roll and pitch each NaN where the file does not tell it.
  std::vector<model::PoseSample> ground_truth;  // empty where the file is absent
  std::vector<model::PoseSample> pose_prior;    // ground truth where pose_prior.csv is absent
  // Other sensors': by time, strictly ascending; empty where their file is absent.
  // Absolute poses have a covariance each.
  model::SensorTables sensor_samples;
  model::SensorDescription sensors;
  DroppedRows dropped;
  std::optional<LogInfo> log;  // none: from a folder
  std::string sha256;          // of the files read, hexadecimal; see InputFiles::digest()
};

// Which files are read; dataset.yaml, tags.csv, ranges.csv and a surface.csv that is named always are.
struct ReadOptions {
  bool surveyed_anchors = true;  // anchors.csv, where it is there; ranges to other anchors are then dropped
  bool odometry = true;          // odometry.csv
  bool sensors = false;          // imu.csv and those of the other sensors, where they are there
  bool ground_truth = true;      // groundtruth.csv, where it is there
  bool pose_prior = true;        // pose_prior.csv, or groundtruth.csv in its place
  bool needs_pose_prior = true;  // an error where neither is there; else it is empty
  std::optional<std::filesystem::path> pose_file = std::nullopt;  // in the place of both
  std::optional<std::size_t> log_section = std::nullopt;          // from 1; none: a log's last
};

// Of a folder, or of a log that gromad has recorded: that has no surveyed anchors and no truth, and perhaps
// no poses. Throws DataError (a file is missing or cannot be read as numbers), ConfigError (dataset.yaml) or
// PermissionError.
[[nodiscard]] Dataset read_dataset(const std::filesystem::path& path, const ReadOptions& options = {});

// Poses of a file with the columns of groundtruth.csv; wrong rows are dropped and counted.
[[nodiscard]] std::vector<model::PoseSample> read_poses(const std::filesystem::path& path,
                                                        DroppedRows& dropped);

// What `groma survey` prints: anchor_id,other_id,range_m,sigma_m,count. Rows without a range are dropped and
// counted.
[[nodiscard]] std::vector<model::AnchorRange> read_survey(const std::filesystem::path& path,
                                                          DroppedRows& dropped);

}  // namespace groma::io
