#include "host/model/samples.hpp"

#include <algorithm>
#include <tuple>

namespace groma::model {

void sort_ranges(std::vector<RangeSample>& ranges) {
  std::stable_sort(ranges.begin(), ranges.end(), [](const RangeSample& a, const RangeSample& b) {
    return std::tie(a.t_s, a.tag_id, a.anchor_id) < std::tie(b.t_s, b.tag_id, b.anchor_id);
  });
}

void sort_poses(std::vector<PoseSample>& poses) {
  std::stable_sort(poses.begin(), poses.end(),
                   [](const PoseSample& a, const PoseSample& b) { return a.t_s < b.t_s; });
  const auto repeated = std::unique(poses.begin(), poses.end(),
                                    [](const PoseSample& a, const PoseSample& b) { return a.t_s == b.t_s; });
  poses.erase(repeated, poses.end());
}

}  // namespace groma::model
