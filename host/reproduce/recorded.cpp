#include "host/reproduce/recorded.hpp"

#include <algorithm>
#include <array>
#include <limits>
#include <string_view>
#include <utility>

#include "host/io/dataset.hpp"
#include "host/reproduce/rows.hpp"

namespace groma::reproduce {

namespace {

// Sites with one drive: its halves.
constexpr std::array<std::string_view, 4> kHalves{"inrol_env1", "lias_fast", "plaza1", "starloc_loop2ds5"};
// Several drives of one campus.
constexpr std::string_view kCampusCalibrates = "mcd_ntu_day_09";
constexpr std::array<std::string_view, 5> kCampus{"mcd_ntu_day_04", "mcd_ntu_day_05", "mcd_ntu_day_06",
                                                  "mcd_ntu_night_03", "mcd_ntu_night_09"};

void keep(io::Dataset& drive, double from_s, double to_s) {
  const auto cut = [&](auto& samples) {
    std::erase_if(samples, [&](const auto& sample) { return sample.t_s < from_s || sample.t_s >= to_s; });
  };
  cut(drive.ranges);
  cut(drive.odometry);
  cut(drive.pose_prior);
  cut(drive.ground_truth);
}

}  // namespace

std::vector<RecordedRun> recorded_runs(const std::filesystem::path& data) {
  std::vector<RecordedRun> out;
  const auto is_there = [&](std::string_view name) { return std::filesystem::is_directory(data / name); };
  for (const std::string_view name : kHalves) {
    if (is_there(name)) out.push_back({std::string(name) + ", halves", std::string(name), std::string(name)});
  }
  for (const std::string_view name : kCampus) {
    if (is_there(kCampusCalibrates) && is_there(name))
      out.push_back({std::string(name), std::string(kCampusCalibrates), std::string(name)});
  }
  return out;
}

Json run_recorded(const RecordedRun& run, const std::filesystem::path& data, const Settings& settings) {
  io::Dataset calibrates = io::read_dataset(data / run.calibrates);
  io::Dataset localizes =
      run.localizes == run.calibrates ? calibrates : io::read_dataset(data / run.localizes);
  if (run.localizes == run.calibrates) {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    const double middle_s = 0.5 * (calibrates.ranges.front().t_s + calibrates.ranges.back().t_s);
    keep(calibrates, -kInfinity, middle_s);
    keep(localizes, middle_s, kInfinity);
  }
  const model::Calibration ours = calibrate(calibrates).calibration;
  const std::vector<Row> rows{{"odometry", "paper-odometry", filter::Model::kOdometry, {}},
                              {"original", "paper-original", filter::Model::kOriginal, {}},
                              {"adapted", "paper-adapted", filter::Model::kSchmidt, {}},
                              {"joint", "", filter::Model::kJoint, {}}};
  return run_rows(rows, {localizes, ours}, {localizes, ours}, settings);
}

}  // namespace groma::reproduce
