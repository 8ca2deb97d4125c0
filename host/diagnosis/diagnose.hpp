// Finds the mistakes that the data of a drive shows, before anything is estimated from it.
#pragma once

#include <vector>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/io/dataset.hpp"
#include "host/model/calibration.hpp"

namespace groma::diagnosis {

// Tables that were not read stay empty.
[[nodiscard]] Data data_of(const io::Dataset& dataset);

// Most likely first; empty where nothing is wrong, or nothing fits. Deterministic.
[[nodiscard]] std::vector<Finding> diagnose(Data data);

// The same for a command that has a calibration: ranges, odometry and tags alone, and the times of poses.
[[nodiscard]] std::vector<Finding> diagnose(Data data, const model::Calibration& calibration);

// The first finding, if it shows that what anchors' positions rest on (poses, ranges, tags, clocks)
// contradicts itself; null if there is none: a fault of the odometry, or an unknown tag or anchor, leaves the
// others good.
[[nodiscard]] const Finding* find_contradiction(const std::vector<Finding>& findings);

// No anchor is then better than weak, and its advice names the cause.
void mark_contradicted(const Finding& contradiction, model::Calibration& calibration);

}  // namespace groma::diagnosis
