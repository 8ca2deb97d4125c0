// What is wrong with an integration, in the words that commands and gromad share.
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
  std::optional<double> value = {};  // what the data has wrong, SI
};

// The calibration is not of this site, or no longer. `share`: of ranges that contradict it; none where no
// pose was found that explains them.
[[nodiscard]] Finding map_mismatch(std::optional<double> share);

// A list of objects with cause, evidence, remedy and, where it is known, value.
[[nodiscard]] nlohmann::ordered_json to_json(std::span<const Finding> findings);

}  // namespace groma::diagnosis
