// Where ranges and odometry alone put the anchors relative to each other, compared with the calibration.
#pragma once

#include <cstddef>
#include <map>
#include <optional>

#include "host/diagnosis/data.hpp"
#include "host/model/calibration.hpp"

namespace groma::diagnosis {

struct Constellation {
  std::size_t anchors = 0;  // that are compared
  std::size_t own = 0;      // of them are where the calibration has them, however that is turned and moved
  std::size_t own_mirrored = 0;  // the same, if the robot turns the other way
  // Are where the calibration has an anchor, if it is turned and moved otherwise; the ids of those that are
  // where another one should be, and its id.
  std::size_t any = 0;
  std::map<model::NodeId, model::NodeId> exchanged;
};

// Solves the anchors in a piece of the drive as if its dead reckoning were poses. None if no piece of the
// drive shows enough anchors.
[[nodiscard]] std::optional<Constellation> compare_constellation(const Data& data,
                                                                 const model::Calibration& calibration);

}  // namespace groma::diagnosis
