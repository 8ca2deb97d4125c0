// Runs the experiments over seeds and keeps their results, so that an interrupted run goes on where it ended.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/reproduce/score.hpp"

namespace groma::reproduce {

// "table1", "indoor", "table2", "anchor-states", "effort", "table3", "sensitivity", "baselines", "recorded".
[[nodiscard]] const std::vector<std::string>& experiments();

struct Plan {
  std::vector<std::string> wanted;  // of experiments()
  std::size_t seeds = 20;           // from 1 on
  bool has_firmware = false;        // the warehouse's seed 1 also with nodes that run the firmware
  std::filesystem::path folder;     // the results are in runs/ within
  std::optional<std::filesystem::path> recorded;
  std::function<void(std::string_view phase, double done)> progress;
};

// Results of an experiment by its parts (a factor, a recorded run, kFirmware; "" for others), and by seed.
inline constexpr const char* kFirmware = "firmware";
using Seeds = std::map<std::uint64_t, Json>;
using Results = std::map<std::string, std::map<std::string, Seeds>, std::less<>>;

struct Outcome {
  Results results;
  bool has_baselines = false;
};

// Several seeds at once. A result of this build that is in the folder is not made again. Throws as the
// studies do.
[[nodiscard]] Outcome run(const Plan& plan);

}  // namespace groma::reproduce
