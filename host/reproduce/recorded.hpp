// Recorded runs, where they are present.
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "host/reproduce/score.hpp"
#include "host/reproduce/study.hpp"

namespace groma::reproduce {

// A drive that calibrates, and another one; or the halves of one.
struct RecordedRun {
  std::string name;
  std::string calibrates;
  std::string localizes;
};

// Those whose folders are in `data`, by name.
[[nodiscard]] std::vector<RecordedRun> recorded_runs(const std::filesystem::path& data);

// Rows "odometry", "original", "adapted" and "joint", all with our calibration: see run_rows(). Throws as the
// reader of data sets.
[[nodiscard]] Json run_recorded(const RecordedRun& run, const std::filesystem::path& data,
                                const Settings& settings);

}  // namespace groma::reproduce
