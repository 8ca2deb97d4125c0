#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "host/importer/import.hpp"
#include "host/io/error.hpp"
#include "host/model/median.hpp"

namespace groma::importer {

namespace {

// By hand: no robot localizes by rows that are further apart.
constexpr double kMaxStep_s = 2.5;
constexpr std::size_t kFewRows = 10;

// The unit of time in which such steps are plausible.
std::string_view likely_unit(double step_s) {
  constexpr std::array<std::pair<std::string_view, double>, 3> kUnits{
      {{"ms", 1e-3}, {"us", 1e-6}, {"ns", 1e-9}}};
  for (const auto& [word, unit_s] : kUnits)
    if (step_s * unit_s <= kMaxStep_s) return word;
  return "ns";
}

void expect_times(const std::filesystem::path& path, const ImportedTable& imported,
                  std::span<const double> times_s, const Units& units) {
  if (times_s.size() < kFewRows) return;
  std::vector<double> steps_s;
  std::size_t backward = 0;
  for (std::size_t i = 1; i < times_s.size(); ++i) {
    const double step_s = times_s[i] - times_s[i - 1];
    if (step_s < 0.0) ++backward;
    if (step_s > 0.0) steps_s.push_back(step_s);
  }
  if (steps_s.empty() || 4 * backward > times_s.size()) {
    throw io::DataError({path},
                        fmt::format("the times of {} do not increase: {} of {} rows are earlier than the row "
                                    "before",
                                    imported.source, backward, times_s.size()),
                        "give the column or field of the time as t_s in the map");
  }
  const double step_s = model::median(std::move(steps_s));
  if (units.time_is_given || step_s <= kMaxStep_s) return;
  throw io::DataError(
      {path},
      fmt::format("the rows of {} are {:g} s apart: the times are probably in {}", imported.source, step_s,
                  likely_unit(step_s)),
      fmt::format("write units: {{time: {}}} in the map; if they are right, time: s", likely_unit(step_s)));
}

void expect_ranges(const std::filesystem::path& path, const ImportedTable& imported,
                   std::span<const model::RangeSample> ranges, const Units& units) {
  if (ranges.empty() || units.length_is_given) return;
  std::vector<double> lengths_m;
  lengths_m.reserve(ranges.size());
  for (const model::RangeSample& range : ranges) lengths_m.push_back(range.range_m);
  const double middle_m = model::median(std::move(lengths_m));
  if (middle_m <= io::kMaxRange_m) return;
  throw io::DataError(
      {path},
      fmt::format("the ranges of {} are about {:.0f} m: they are probably in mm", imported.source, middle_m),
      "write units: {length: mm} in the map; if they are right, length: m");
}

void expect_headings(const std::filesystem::path& path, const ImportedTable& imported,
                     std::span<const model::PoseSample> poses, const Units& units) {
  if (units.angle_is_given) return;
  constexpr double kLeastWrap = 300.0;
  constexpr double kMostWrap = 361.0;
  for (std::size_t i = 1; i < poses.size(); ++i) {
    const double step = std::abs(poses[i].yaw_rad - poses[i - 1].yaw_rad);
    if (step < kLeastWrap || step > kMostWrap) continue;
    throw io::DataError({path},
                        fmt::format("the heading of {} jumps by {:.1f} rad: it is probably in degrees",
                                    imported.source, step),
                        "write units: {angle: deg} in the map; if it is right, angle: rad");
  }
}

}  // namespace

void expect_plausible(const std::filesystem::path& path, const ImportedTable& imported, std::size_t begin,
                      const Units& units, const io::Dataset& dataset) {
  const std::vector<double> times_s = times_of(imported.table, dataset);
  if (times_s.empty()) return;
  expect_times(path, imported, std::span(times_s).subspan(begin), units);
  if (imported.table == Table::kRanges)
    expect_ranges(path, imported, std::span(dataset.ranges).subspan(begin), units);
  if (imported.table == Table::kPosePrior)
    expect_headings(path, imported, std::span(dataset.pose_prior).subspan(begin), units);
  if (imported.table == Table::kGroundTruth)
    expect_headings(path, imported, std::span(dataset.ground_truth).subspan(begin), units);
}

}  // namespace groma::importer
