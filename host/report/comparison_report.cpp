#include "host/report/comparison_report.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <string>
#include <utility>
#include <vector>

#include "host/io/calibration_file.hpp"
#include "host/report/calibration_report.hpp"
#include "host/report/series.hpp"
#include "host/report/site.hpp"

namespace groma::report {

namespace {

using Eigen::Vector2d;
using Eigen::Vector3d;

// 95 % of a Gaussian are within so many sigmas.
constexpr double kSigmas95 = 1.96;

Tone tone_of(const calibration::AnchorChange& change) {
  if (change.moved) return Tone::kBad;
  return change.differs ? Tone::kWarning : Tone::kPlain;
}

const char* word_of(const calibration::AnchorChange& change) {
  if (change.moved) return "moved";
  return change.differs ? "differs" : "same";
}

// A place of A in B's frame.
Vector3d in_frame_of_b(const calibration::FrameOffset& frame, const Vector3d& at) {
  return at + frame.mean.head<3>() + frame.mean(3) * Vector3d::UnitZ().cross(at);
}

void add_summary(Page& page, const calibration::Comparison& comparison) {
  const auto moved = std::count_if(comparison.anchors.begin(), comparison.anchors.end(),
                                   [](const auto& change) { return change.moved; });
  const auto differ = std::count_if(comparison.anchors.begin(), comparison.anchors.end(),
                                    [](const auto& change) { return change.differs; });
  const auto pairs = std::count_if(comparison.pairs.begin(), comparison.pairs.end(),
                                   [](const auto& change) { return change.differs; });
  const Eigen::Vector4d& frame = comparison.frame.mean;
  page.add_facts({{fmt::format("{}", moved), "anchors moved", moved > 0 ? Tone::kBad : Tone::kGood},
                  {fmt::format("{} of {}", differ, comparison.anchors.size()), "anchors differ",
                   differ > 0 ? Tone::kWarning : Tone::kGood},
                  {fmt::format("{} of {}", pairs, comparison.pairs.size()), "biases differ",
                   pairs > 0 ? Tone::kWarning : Tone::kGood},
                  {fmt::format("{:.3f} m", frame.head<2>().norm()), "horizontal shift of the common frame"},
                  {fmt::format("{:.4f} rad", frame(3)), "turn of the common frame"}});
  for (const auto& [ids, what, text] :
       {std::tuple{&comparison.only_a, "Missing", "has a position in the earlier calibration alone."},
        {&comparison.only_b, "New", "has a position in the later calibration alone."}}) {
    if (!ids->empty())
      page.add_notice(fmt::format("{}: {}", what, fmt::join(*ids, ", ")), fmt::format("Each {}", text),
                      Tone::kWarning);
  }
}

void add_map(Page& page, const calibration::Comparison& comparison, const model::Calibration& a,
             const model::Calibration& b) {
  Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 640.0});
  std::vector<std::pair<Vector2d, Vector2d>> moves;
  std::vector<Mark> before;
  for (const calibration::AnchorChange& change : comparison.anchors) {
    const Vector3d at = in_frame_of_b(comparison.frame, model::find_anchor(a, change.id)->position_m);
    moves.emplace_back(at.head<2>(), at.head<2>() + change.displacement_m.head<2>());
    before.push_back({.at = at.head<2>(), .label = "", .hint = fmt::format("anchor {}, earlier", change.id)});
  }
  map.add_strokes("displacement", Ink::kSeries2, std::move(moves));
  map.add_marks("earlier position", Ink::kPath, std::move(before));
  add_anchors(map, b);
  page.add_chart(
      map,
      "The later calibration's anchors, and where they were in the earlier one. The offset of the common "
      "frames is removed.");
}

void add_displacements(Page& page, const calibration::Comparison& comparison) {
  std::vector<std::string> names;
  std::array<std::pair<std::vector<Vector2d>, std::vector<double>>, 3> axes;
  for (const calibration::AnchorChange& change : comparison.anchors) {
    for (int axis = 0; axis < 3; ++axis) {
      auto& [points, halves] = axes.at(static_cast<std::size_t>(axis));
      points.emplace_back(static_cast<double>(names.size()) + 0.22 * (axis - 1), change.displacement_m(axis));
      halves.push_back(kSigmas95 * std::sqrt(change.covariance_m2(axis, axis)));
    }
    names.push_back(fmt::format("{}", change.id));
  }
  // A weak anchor's interval does not shrink the others.
  std::vector<double> sizes_m{0.02};
  std::vector<double> halves_m;
  for (const auto& [points, halves] : axes) {
    for (const Vector2d& point : points) sizes_m.push_back(1.2 * std::abs(point.y()));
    halves_m.insert(halves_m.end(), halves.begin(), halves.end());
  }
  if (!halves_m.empty()) sizes_m.push_back(3.0 * quantile(std::move(halves_m), 0.5));
  const double limit_m = *std::max_element(sizes_m.begin(), sizes_m.end());
  Chart chart({.x_label = "anchor",
               .y_label = "displacement (m)",
               .height_px = 280.0,
               .y_range = Vector2d(-limit_m, limit_m)});
  chart.name_x(std::move(names));
  constexpr std::array kNames{"x", "y", "z"};
  for (std::size_t axis = 0; axis < 3; ++axis)
    chart.add_intervals(kNames.at(axis), series_ink(axis), std::move(axes.at(axis).first),
                        std::move(axes.at(axis).second));
  page.add_heading("Displacements");
  page.add_chart(chart,
                 "Later minus earlier position of each anchor, with the 95 % interval of both together; long "
                 "ones are cut off.");
}

void add_table(Page& page, const calibration::Comparison& comparison, const model::Calibration& a,
               const model::Calibration& b) {
  std::vector<std::vector<Cell>> rows;
  for (const calibration::AnchorChange& change : comparison.anchors) {
    const Vector3d& d = change.displacement_m;
    const model::AnchorVerdict later = model::find_anchor(b, change.id)->verdict;
    rows.push_back({{fmt::format("{}", change.id)},
                    {fmt::format("{:+.3f}", d.x())},
                    {fmt::format("{:+.3f}", d.y())},
                    {fmt::format("{:+.3f}", d.z())},
                    {fmt::format("{:.3f}", d.norm())},
                    {fmt::format("{:.1f}", change.chi2)},
                    {fmt::format("{:.2g}", change.chance)},
                    {std::string(io::word(model::find_anchor(a, change.id)->verdict))},
                    {std::string(io::word(later)), tone(later)},
                    {word_of(change), tone_of(change)}});
  }
  page.add_table(
      {"anchor", "dx m", "dy m", "dz m", "distance m", "chi2", "chance", "earlier", "later", "change"}, rows);
}

void add_biases(Page& page, const calibration::Comparison& comparison) {
  std::vector<std::string> names;
  std::vector<model::NodeId> tags;
  for (const calibration::PairChange& pair : comparison.pairs) tags.push_back(pair.tag_id);
  std::sort(tags.begin(), tags.end());
  tags.erase(std::unique(tags.begin(), tags.end()), tags.end());
  if (tags.empty()) return;
  std::vector<std::pair<std::vector<Vector2d>, std::vector<double>>> series(tags.size());
  for (const calibration::PairChange& pair : comparison.pairs) {
    const std::string name = fmt::format("{}", pair.anchor_id);
    if (names.empty() || names.back() != name) names.push_back(name);
    const auto tag =
        static_cast<std::size_t>(std::lower_bound(tags.begin(), tags.end(), pair.tag_id) - tags.begin());
    const double shift = 0.2 * (static_cast<double>(tag) - 0.5 * static_cast<double>(tags.size() - 1));
    series[tag].first.emplace_back(static_cast<double>(names.size() - 1) + shift, pair.beta_m);
    series[tag].second.push_back(kSigmas95 * pair.beta_sigma_m);
  }
  Chart chart({.x_label = "anchor", .y_label = "change of beta (m)", .height_px = 260.0});
  chart.name_x(std::move(names));
  for (std::size_t i = 0; i < tags.size(); ++i)
    chart.add_intervals(fmt::format("tag {}", tags[i]), series_ink(i), std::move(series[i].first),
                        std::move(series[i].second));
  page.add_heading("Range biases");
  page.add_chart(chart, "Later minus earlier bias β of each pair, with the 95 % interval of both together.");
}

}  // namespace

void add_comparison(Page& page, const calibration::Comparison& comparison, const model::Calibration& a,
                    const model::Calibration& b) {
  add_summary(page, comparison);
  add_map(page, comparison, a, b);
  add_displacements(page, comparison);
  add_table(page, comparison, a, b);
  add_biases(page, comparison);
}

}  // namespace groma::report
