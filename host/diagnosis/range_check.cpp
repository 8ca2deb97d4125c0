#include "host/diagnosis/range_check.hpp"

#include <cstddef>
#include <memory>

#include "host/diagnosis/anchor_scene.hpp"
#include "host/diagnosis/hypothesis.hpp"

namespace groma::diagnosis {
namespace {

std::unique_ptr<Scene> make_anchor_scene(const Data& data, std::size_t most_rows) {
  return std::make_unique<AnchorScene>(data, most_rows);
}

}  // namespace

std::vector<Finding> compare_with_poses(Data& data, bool heading_is_known) {
  if (data.ranges.empty() || data.poses.size() < 2) return {};
  return find_mistakes(data, make_anchor_scene, [&](const Data& now) {
    const double offset_s = best_offset_s(now, make_anchor_scene);
    std::vector<Hypothesis> out{
        clock_offset(offset_s, "poses"),
        clock_drift(offset_s, now.ranges.front().t_s, now.ranges.back().t_s, "poses"),
    };
    for (std::size_t a = 0; a < now.tags.size(); ++a) {
      for (std::size_t b = a + 1; b < now.tags.size(); ++b) out.push_back(swapped_tags(a, b, now));
    }
    for (std::size_t tag = 0; tag < now.tags.size(); ++tag) out.push_back(wrong_lever_arm(tag, now));
    out.push_back(mirrored_tags());
    if (!heading_is_known) {
      out.push_back(heading_offset());
      out.push_back(heading_sign());
    }
    return out;
  });
}

}  // namespace groma::diagnosis
