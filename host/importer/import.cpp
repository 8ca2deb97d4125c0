#include "host/importer/import.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <map>
#include <set>
#include <utility>

#include "host/io/error.hpp"

namespace groma::importer {

namespace {

// The map's keys replace those of the data set.
void apply_site(const ImportMap& map, io::Dataset& dataset) {
  for (const std::string& key : map.given) {
    if (key == "name") dataset.name = map.site.name;
    if (key == "tags") dataset.tags = map.site.tags;
    if (key == "anchors") dataset.surveyed_anchors = map.site.surveyed_anchors;
    if (key == "odometry") dataset.odometry_noise = map.site.odometry_noise;
    if (key == "range") dataset.range_priors = map.site.range_priors;
    if (key == "surface") dataset.surface = map.site.surface;
    if (key == "imu" || key == "gnss") dataset.sensors = map.site.sensors;
  }
}

// Several sources of one table are merged by time; one source keeps its order.
void merge_by_time(const std::vector<ImportedTable>& tables, io::Dataset& dataset) {
  std::map<Table, std::size_t> sources;
  for (const ImportedTable& imported : tables)
    if (++sources[imported.table] == 2) sort_by_time(imported.table, dataset);
}

void expect_tags(const std::filesystem::path& path, const io::Dataset& dataset) {
  if (!dataset.tags.empty() || dataset.ranges.empty()) return;
  std::set<model::NodeId> ids;
  for (const model::RangeSample& range : dataset.ranges) ids.insert(range.tag_id);
  std::string list;
  for (const model::NodeId id : ids) list += fmt::format("{}{}", list.empty() ? "" : ", ", id);
  throw io::DataError(
      {path}, fmt::format("the lever arms of the tags {} are not known", list),
      fmt::format("write tags: [{{id: {}, lever_arm_m: [x, y, z]}}] in the map, for each tag", *ids.begin()));
}

std::pair<double, double> extent(const std::vector<double>& times_s) {
  const auto [first, last] = std::minmax_element(times_s.begin(), times_s.end());
  return {*first, *last};
}

void warn_of_no_overlap(Imported& out) {
  const std::vector<double> ranges_s = times_of(Table::kRanges, out.dataset);
  if (ranges_s.empty()) return;
  for (const Table table : {Table::kOdometry, Table::kPosePrior, Table::kGroundTruth}) {
    const std::vector<double> others_s = times_of(table, out.dataset);
    if (others_s.empty()) continue;
    const auto [from_s, to_s] = extent(ranges_s);
    const auto [other_from_s, other_to_s] = extent(others_s);
    if (other_from_s <= to_s && from_s <= other_to_s) continue;
    out.warnings.push_back(
        fmt::format("ranges are from {:.3f} to {:.3f} s, {} from {:.3f} to {:.3f} s: they do not overlap; "
                    "their clocks or "
                    "units of time differ",
                    from_s, to_s, name_of(table), other_from_s, other_to_s));
  }
}

}  // namespace

std::size_t begin_table(Table table, Imported& out) {
  const bool is_first = std::none_of(out.tables.begin(), out.tables.end(),
                                     [&](const ImportedTable& of) { return of.table == table; });
  if (is_first) clear(table, out.dataset);
  return rows_of(table, out.dataset);
}

Imported import_files(Format format, std::span<const std::filesystem::path> inputs, const ImportMap& map,
                      io::Dataset base) {
  Imported out{.dataset = std::move(base), .tables = {}, .warnings = {}};
  apply_site(map, out.dataset);
  switch (format) {
    case Format::kCsv:
      import_text(inputs, map, out);
      break;
    case Format::kMat:
      if (map.sources.empty())
        throw io::DataError({inputs.front()}, "its arrays have no names of columns",
                            "describe them in a file, and give it as --map FILE");
      import_text(inputs, map, out);
      break;
    case Format::kTum:
      import_tum(inputs, map, out);
      break;
    case Format::kKitti:
      import_kitti(inputs, map, out);
      break;
    case Format::kRosbag2:
      import_bags(inputs, map, out);
      break;
  }
  merge_by_time(out.tables, out.dataset);
  expect_tags(inputs.front(), out.dataset);
  warn_of_no_overlap(out);
  return out;
}

}  // namespace groma::importer
