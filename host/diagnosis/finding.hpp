// Findings of the diagnosis, in the words that the commands and gromad share.
#pragma once

#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <nlohmann/json_fwd.hpp>

#include "host/diagnosis/units.hpp"
#include "host/model/clock_error.hpp"
#include "host/model/types.hpp"

namespace groma::diagnosis {

struct Finding {
  std::string_view cause;  // one of the contract's words, such as "map-mismatch"
  std::string evidence;
  std::string remedy;
  // The error in the data with its sigma, SI units: one number, or dx, dy, dz of a lever arm; empty if the
  // cause has none.
  std::vector<double> value = {};
  std::vector<double> sigma = {};
  std::vector<model::NodeId> of = {};                     // the tags or anchors concerned
  bool is_of_odometry_alone = false;                      // poses and ranges agree with each other
  std::optional<model::ClockError> clock = std::nullopt;  // of the ranges, if the cause is their clock
};

// The calibration does not match this site. `share`: of the ranges that contradict it; none if no pose was
// found that explains the ranges.
[[nodiscard]] Finding map_mismatch(std::optional<double> share);

// The positions of tags.csv are in that unit.
[[nodiscard]] Finding lever_arms_in(const Unit& unit, std::string_view evidence);

// A list of objects with cause, evidence, remedy and, if known, value, sigma and of.
[[nodiscard]] nlohmann::ordered_json to_json(std::span<const Finding> findings);

}  // namespace groma::diagnosis
