#include "host/reproduce/rows.hpp"

#include <map>
#include <utility>

namespace groma::reproduce {

namespace {

constexpr double kCurve_s = 1.0;
constexpr double kEllipse_s = 20.0;

Json scored(const std::vector<model::PlanarEstimate>& rows, const io::Dataset& drive, bool has_curves) {
  Json out{{"score", score(rows, drive.ground_truth)}};
  if (!has_curves) return out;
  out["errors"] = error_curve(rows, drive.ground_truth, kCurve_s);
  out["path"] = path_of(rows, kCurve_s);
  out["truth"] = path_of(drive.ground_truth, kCurve_s);
  out["ellipses"] = ellipses_of(rows, kEllipse_s);
  return out;
}

}  // namespace

void flatten(io::Dataset& drive) {
  drive.surface = model::Plane(0.0, {0.0, 0.0, 1.0});
}

calibration::Result calibrate(const io::Dataset& drive) {
  return calibration::calibrate({.ranges = drive.ranges,
                                 .poses = drive.pose_prior,
                                 .tags = drive.tags,
                                 .surface = &drive.surface,
                                 .priors = drive.range_priors});
}

Json run_rows(const std::vector<Row>& rows, const Input& ours, const Input& published,
              const Settings& settings) {
  Json out = Json::object();
  // The program reads a drive once for all methods that use the same ranges.
  using Ids = std::vector<model::NodeId>;
  std::map<std::pair<Ids, Ids>, std::vector<const Row*>> by_subset;
  for (const Row& row : rows) {
    const Localized run = localize(ours.drive, ours.calibration, row.ours, row.subset);
    Json& at = out[row.key]["ours"];
    at = scored(run.rows, ours.drive, settings.has_curves);
    at["update_ns"] = run.update_ns;
    at["propagate_ns"] = run.propagate_ns;
    if (!row.published.empty()) by_subset[{row.subset.tags, row.subset.anchors}].push_back(&row);
  }
  if (!settings.baselines.is_there()) return out;
  for (const auto& [subset, of] : by_subset) {
    std::vector<std::string> methods;
    for (const Row* row : of) methods.push_back(row->published);
    const auto estimates = settings.baselines.run(published.drive, published.calibration, methods,
                                                  {subset.first, subset.second}, false, settings.scratch);
    for (std::size_t i = 0; i < of.size(); ++i) {
      Json& at = out[of[i]->key]["published"];
      at = scored(estimates[i].rows, published.drive, settings.has_curves);
      at["facts"] = estimates[i].facts;
    }
  }
  return out;
}

}  // namespace groma::reproduce
