// An earlier calibration brought up to date by a later drive's own: what did not move is known better, what
// moved is named, what is new is added.
#pragma once

#include <vector>

#include "host/calibration/comparison.hpp"
#include "host/model/calibration.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

struct Update {
  model::Calibration calibration;    // anchors of both, by id; in the earlier one's frame
  Comparison comparison;             // of the later against the earlier
  std::vector<model::NodeId> moved;  // more than Comparison::kMoved_m
  std::vector<model::NodeId> added;
  std::vector<model::NodeId> kept;  // as they were: the later drive tells nothing of them
};

// `later` was found without `earlier`; `priors` are those that both had of each pair, and count once.
// A moved anchor is where the later drive found it, if that is any good, else without a position; its verdict
// is `moved` in both cases.
[[nodiscard]] Update update(const model::Calibration& earlier, const model::Calibration& later,
                            const model::RangePriors& priors);

}  // namespace groma::calibration
