// Findings of the diagnosis, in the words that the commands and gromad share.
#pragma once

#include <optional>
#include <span>
#include <string>
#include <string_view>

#include <nlohmann/json_fwd.hpp>

namespace groma::diagnosis {

struct Finding {
  std::string_view cause;  // one of the contract's words, such as "map-mismatch"
  std::string evidence;
  std::string remedy;
  std::optional<double> value = {};  // the error in the data, SI units
};

// The calibration does not match this site. `share`: of the ranges that contradict it; none if no pose was
// found that explains the ranges.
[[nodiscard]] Finding map_mismatch(std::optional<double> share);

// A list of objects with cause, evidence, remedy and, if known, value.
[[nodiscard]] nlohmann::ordered_json to_json(std::span<const Finding> findings);

}  // namespace groma::diagnosis
