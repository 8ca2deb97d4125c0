// The experiments of the source paper on simulated sites, and beside them ours.
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <set>
#include <string>
#include <string_view>

#include "host/reproduce/score.hpp"

namespace groma::reproduce {

// One run of a study.
struct Settings {
  std::uint64_t seed = 1;
  std::filesystem::path scratch;  // a folder of this run
  const Baselines& baselines;
  bool has_curves = false;   // of errors over time, for a figure
  bool is_emulated = false;  // nodes run the firmware; else ranges come from the world with white noise
};

// Which of a study's results are wanted, by their names.
using Wanted = std::set<std::string, std::less<>>;

// "table1", "indoor", "table2", "anchor-states" (with curves alone): the warehouse of Tables I and II.
[[nodiscard]] Json run_warehouse(const Settings& settings, const Wanted& wanted);
// "table3": the forklift.
[[nodiscard]] Json run_forklift(const Settings& settings);

// What a user would otherwise take, plain and tuned, beside ours on one drive with our calibration:
// {"METHOD": {"score", "us_per_range"}, "METHOD, tuned": ..., "schmidt": ..., "joint": ...}.
[[nodiscard]] Json run_baselines(const Settings& settings);

}  // namespace groma::reproduce
