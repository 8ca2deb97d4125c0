#include "host/diagnosis/range_check.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cstddef>
#include <memory>

#include "host/diagnosis/anchor_scene.hpp"
#include "host/diagnosis/hypothesis.hpp"
#include "host/diagnosis/thresholds.hpp"

namespace groma::diagnosis {
namespace {

std::unique_ptr<Scene> make_anchor_scene(const Data& data, std::size_t most_rows) {
  return std::make_unique<AnchorScene>(data, most_rows);
}

}  // namespace

std::vector<Finding> compare_with_poses(Data& data, bool heading_is_known) {
  if (data.ranges.empty() || data.poses.size() < 2) return {};
  const auto hypotheses = [&](const Data& now, const RangeFit& given) {
    std::vector<Hypothesis> out = of_clock_and_tags(now, given, make_anchor_scene, "poses'");
    if (!heading_is_known) {
      out.push_back(heading_offset());
      out.push_back(heading_sign());
    }
    return out;
  };
  // More than the errors of good poses, which last longer than a slice: by hand.
  constexpr double kLeastGain = 0.02;
  return find_mistakes(data, make_anchor_scene, hypotheses, kLeastGain);
}

std::vector<Finding> compare_with_survey(const Data& data) {
  if (data.ranges.empty() || data.poses.size() < 2 || data.anchors.empty()) return {};
  constexpr std::size_t kSurveyRows = 3000;
  const AnchorScene scene(data, kSurveyRows);
  const RangeFit fit = fit_ranges(scene, {});
  if (2 * fit.rows < scene.rows().size() || fit.scale_m > kFitSigmas * data.priors.sigma_m) return {};
  // By hand: a survey and an estimate are better than 1 m, or where the anchor is far away, than 5 % of the
  // way.
  constexpr double kNear_m = 1.0;
  constexpr double kNearShare = 0.05;
  std::vector<double> range_m(scene.block_count(), 0.0);
  for (const RangeRow& row : scene.rows()) range_m[row.block] = std::max(range_m[row.block], row.range_m);
  std::vector<model::NodeId> exchanged;
  std::size_t compared = 0;
  std::size_t differing = 0;
  for (std::size_t i = 0; i < scene.block_count(); ++i) {
    const double near_m = std::max(kNear_m, kNearShare * range_m[i]);
    const auto is_near = [&](const model::Anchor& anchor) {
      return (anchor.position_m - fit.blocks[i].head<3>()).head<2>().norm() < near_m;
    };
    const auto own = std::find_if(data.anchors.begin(), data.anchors.end(), [&](const model::Anchor& anchor) {
      return anchor.id == scene.anchors()[i];
    });
    if (own == data.anchors.end()) continue;
    ++compared;
    if (is_near(*own)) continue;
    ++differing;
    if (std::any_of(data.anchors.begin(), data.anchors.end(), is_near)) exchanged.push_back(own->id);
  }
  if (exchanged.size() >= 2 && 2 * exchanged.size() > differing) {
    return {
        {.cause = "renumbered-anchors",
         .evidence = fmt::format("anchors {} are where anchors.csv has others", fmt::join(exchanged, ", ")),
         .remedy = "correct the ids in anchors.csv, or calibrate again",
         .of = exchanged}};
  }
  constexpr std::size_t kMinAnchors = 3;
  if (differing < kMinAnchors || 2 * differing <= compared) return {};
  return {
      {.cause = "map-mismatch",
       .evidence = fmt::format("{} of {} anchors are not where anchors.csv has them", differing, compared),
       .remedy = "give the anchors.csv of this site, in the frame of the poses"}};
}

}  // namespace groma::diagnosis
