// A recorded or simulated run: the folder format shared with researchers and scripts.
#pragma once

#include <array>
#include <cstddef>
#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::io {

// Rows that could be read but are wrong: dropped, counted, never an error.
struct DroppedRows {
  std::size_t range_out_of_bounds = 0;  // not within (0, kMaxRange_m]
  std::size_t unknown_tag = 0;
  std::size_t unknown_anchor = 0;
  std::size_t late = 0;      // more than kMaxLateness_s behind the latest row before it
  std::size_t repeated = 0;  // same pair, same instant

  [[nodiscard]] std::size_t total() const {
    return range_out_of_bounds + unknown_tag + unknown_anchor + late + repeated;
  }
};

inline constexpr double kMaxRange_m = 1000.0;
inline constexpr double kMaxLateness_s = 0.5;

struct Dataset {
  std::string name;
  std::string origin;  // "recorded" or "simulated"
  model::OdometryNoise odometry_noise;
  model::RangePriors range_priors;
  model::Surface surface;
  std::vector<model::Anchor> surveyed_anchors;  // empty where anchors.csv is absent
  std::vector<model::Tag> tags;
  std::vector<model::RangeSample> ranges;       // by time, ascending
  std::vector<model::OdometrySample> odometry;  // by time, ascending
  std::vector<model::PoseSample> ground_truth;  // empty where the file is absent
  std::vector<model::PoseSample> pose_prior;    // ground truth where pose_prior.csv is absent
  DroppedRows dropped;
  std::string sha256;  // of the files read, hexadecimal
};

}  // namespace groma::io
