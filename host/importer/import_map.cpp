#include "host/importer/import_map.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <limits>
#include <numbers>
#include <span>
#include <utility>

#include "host/io/input_file.hpp"
#include "host/io/site_description.hpp"
#include "host/io/yaml_reader.hpp"

namespace groma::importer {

namespace {

using io::YamlValue;

constexpr std::int64_t kMaxId = std::numeric_limits<model::NodeId>::max();

struct Unit {
  std::string_view word;
  double si = 1.0;
};

// The SI value of the unit that the key names; `is_given`: the key is there.
template <std::size_t kUnits>
double parse_unit(const YamlValue& yaml, std::string_view key, const std::array<Unit, kUnits>& units,
                  bool& is_given) {
  const std::optional<YamlValue> value = yaml.find(key);
  if (!value) return 1.0;
  std::vector<std::string_view> words;
  words.reserve(units.size());
  for (const Unit& unit : units) words.push_back(unit.word);
  is_given = true;
  return units.at(value->one_of(words)).si;
}

Units parse_units(const YamlValue& yaml) {
  constexpr std::array<Unit, 5> kTimes{{{"s", 1.0}, {"ms", 1e-3}, {"us", 1e-6}, {"ns", 1e-9}, {"date", 1.0}}};
  constexpr std::array<Unit, 5> kLengths{
      {{"m", 1.0}, {"cm", 0.01}, {"mm", 0.001}, {"ft", 0.3048}, {"in", 0.0254}}};
  constexpr std::array<Unit, 2> kAngles{{{"rad", 1.0}, {"deg", std::numbers::pi / 180.0}}};
  yaml.expect_keys({{}, {"time", "length", "angle"}});
  Units units;
  units.time_s = parse_unit(yaml, "time", kTimes, units.time_is_given);
  units.is_date = units.time_is_given && yaml.at("time").text() == "date";
  units.length_m = parse_unit(yaml, "length", kLengths, units.length_is_given);
  units.angle_rad = parse_unit(yaml, "angle", kAngles, units.angle_is_given);
  return units;
}

// A name, a number of a column, or {value: NUMBER}.
SourceColumn parse_column(const YamlValue& yaml) {
  SourceColumn column;
  if (yaml.is_map()) {
    yaml.expect_keys({{"value"}});
    column.constant = yaml.at("value").number();
    return column;
  }
  column.name = yaml.text();
  const bool is_number =
      !column.name.empty() && column.name.find_first_not_of("0123456789") == std::string::npos;
  if (is_number) column.number = static_cast<std::size_t>(yaml.integer(1, 100000));
  return column;
}

model::NodeId parse_id(const YamlValue& yaml) {
  return static_cast<model::NodeId>(yaml.integer(0, kMaxId));
}

PairColumn parse_pair(const YamlValue& yaml) {
  yaml.expect_keys({{"tag", "anchor", "column"}});
  return {parse_id(yaml.at("tag")), parse_id(yaml.at("anchor")), parse_column(yaml.at("column"))};
}

char parse_separator(const YamlValue& yaml) {
  constexpr std::array<std::string_view, 4> kWords{"comma", "semicolon", "tab", "blanks"};
  constexpr std::string_view kSeparators = ",;\t ";
  return kSeparators.at(yaml.one_of(kWords));
}

bool contains(std::span<const std::string_view> words, std::string_view word) {
  return std::find(words.begin(), words.end(), word) != words.end();
}

constexpr std::array<std::string_view, 13> kSourceKeys{"to",    "file",  "topic",     "array",  "columns",
                                                       "pairs", "units", "base_link", "header", "separator",
                                                       "rows",  "order", "definition"};

std::span<const std::string_view> keys_of_source(Format format) {
  static constexpr std::array<std::string_view, 10> kText{
      "to", "file", "columns", "pairs", "units", "base_link", "header", "separator", "rows", "order"};
  static constexpr std::array<std::string_view, 9> kArrays{"to",    "file",      "array", "columns", "pairs",
                                                           "units", "base_link", "rows",  "order"};
  static constexpr std::array<std::string_view, 4> kTrajectory{"to", "file", "units", "base_link"};
  static constexpr std::array<std::string_view, 6> kMessages{"to",    "topic",     "columns",
                                                             "units", "base_link", "definition"};
  switch (format) {
    case Format::kCsv:
      return kText;
    case Format::kTum:
    case Format::kKitti:
      return kTrajectory;
    case Format::kMat:
      return kArrays;
    case Format::kRosbag2:
      break;
  }
  return kMessages;
}

// Of the keys of any format, those that this one uses.
void expect_used(const YamlValue& yaml, std::span<const std::string_view> all,
                 std::span<const std::string_view> used, Format format) {
  // Where two formats have different keys for one thing.
  constexpr std::array<std::pair<std::string_view, std::string_view>, 2> kOthers{
      {{"file", "topic"}, {"topic", "file"}}};
  std::string list;
  for (const std::string_view key : used) list += fmt::format("{}{}", list.empty() ? "" : ", ", key);
  const std::string_view name = kFormatNames.at(static_cast<std::size_t>(format));
  for (const std::string_view key : all) {
    const std::optional<YamlValue> value = yaml.find(key);
    if (!value || contains(used, key)) continue;
    const auto* const other =
        std::find_if(kOthers.begin(), kOthers.end(), [&](const auto& pair) { return pair.first == key; });
    const bool is_other = other != kOthers.end() && contains(used, other->second);
    value->fail(fmt::format("is not used by groma import {}", name),
                fmt::format("{}{} uses {}",
                            is_other ? fmt::format("did you mean '{}'? ", other->second) : "remove it; ",
                            name, list));
  }
}

void expect_used_units(const YamlValue& yaml, Format format) {
  constexpr std::array<std::string_view, 3> kAll{"time", "length", "angle"};
  const bool is_trajectory = format == Format::kTum || format == Format::kKitti;  // has no angles
  expect_used(yaml, kAll, std::span(kAll).first(is_trajectory ? 2 : 3), format);
  const std::optional<YamlValue> time = yaml.find("time");
  if (time && format != Format::kCsv && time->text() == "date")
    time->fail("is a date, which only tables have", "write s, ms, us or ns");
}

void parse_columns(const YamlValue& yaml, Source& source) {
  YamlValue::Keys keys;
  for (const ColumnType& column : columns_of(source.to)) keys.optional.push_back(column.name);
  yaml.expect_keys(keys);
  for (const ColumnType& column : columns_of(source.to)) {
    if (const std::optional<YamlValue> value = yaml.find(column.name))
      source.columns.emplace(column.name, parse_column(*value));
  }
}

void parse_pairs(const YamlValue& yaml, Source& source) {
  if (source.to != Table::kRanges) yaml.fail("is not of ranges", "write it only with to: ranges");
  for (const std::string_view column : {"tag_id", "anchor_id", "range_m"})
    if (source.columns.contains(column))
      yaml.fail(fmt::format("is there beside a column {}", column), "keep one of them");
  for (const YamlValue& pair : yaml.list()) source.pairs.push_back(parse_pair(pair));
}

Eigen::Isometry3d parse_base_link(const YamlValue& yaml) {
  constexpr std::array<std::string_view, 6> kKeys{"x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad"};
  yaml.expect_keys({{}, {kKeys.begin(), kKeys.end()}});
  std::array<double, kKeys.size()> values{};
  for (std::size_t i = 0; i < kKeys.size(); ++i)
    if (const std::optional<YamlValue> value = yaml.find(kKeys[i])) values[i] = value->number();
  return Eigen::Translation3d(values[0], values[1], values[2]) *
         (Eigen::AngleAxisd(values[5], Eigen::Vector3d::UnitZ()) *
          Eigen::AngleAxisd(values[4], Eigen::Vector3d::UnitY()) *
          Eigen::AngleAxisd(values[3], Eigen::Vector3d::UnitX()));
}

Source parse_source(const YamlValue& yaml, Format format) {
  constexpr std::array<std::string_view, 4> kHeaders{"first", "comment", "none", "skip"};
  yaml.expect_keys({{"to"}, {kSourceKeys.begin() + 1, kSourceKeys.end()}});
  expect_used(yaml, kSourceKeys, keys_of_source(format), format);
  if (format == Format::kRosbag2) static_cast<void>(yaml.at("topic"));
  Source source;
  if (format == Format::kMat) {
    source.array = yaml.at("array").text();
    source.header = Source::Header::kNone;
    source.separator = ' ';
  }
  source.place = yaml.place();
  for (const std::string_view key : {"file", "topic"})
    if (const auto value = yaml.find(key)) source.from = value->text();
  source.to = static_cast<Table>(yaml.at("to").one_of(kTableNames));
  if (const auto value = yaml.find("columns")) parse_columns(*value, source);
  if (const auto value = yaml.find("pairs")) parse_pairs(*value, source);
  if (const auto value = yaml.find("units")) {
    source.units = parse_units(*value);
    expect_used_units(*value, format);
  }
  if (const auto value = yaml.find("base_link")) {
    if (source.to != Table::kGroundTruth && source.to != Table::kPosePrior)
      value->fail("is of poses", "write it only with to: groundtruth or to: pose_prior");
    source.base_link = parse_base_link(*value);
  }
  if (const auto value = yaml.find("header"))
    source.header = static_cast<Source::Header>(value->one_of(kHeaders));
  if (const auto value = yaml.find("separator")) source.separator = parse_separator(*value);
  if (const auto value = yaml.find("rows")) {
    value->expect_keys({{"column", "equals"}});
    source.row_kind = parse_column(value->at("column"));
    source.row_kind_text = value->at("equals").text();
  }
  if (const auto value = yaml.find("order")) {
    constexpr std::array<std::string_view, 2> kOrders{"file", "time"};
    source.sort_by_time = value->one_of(kOrders) == 1;
  }
  if (const auto value = yaml.find("definition")) source.definition = value->text();
  return source;
}

template <typename Node>
std::vector<Node> parse_nodes(const YamlValue& yaml, std::string_view key) {
  std::vector<Node> nodes;
  for (const YamlValue& entry : yaml.list()) {
    entry.expect_keys({{"id", key}});
    const std::vector<double> at = entry.at(key).numbers(3);
    nodes.push_back({parse_id(entry.at("id")), {at[0], at[1], at[2]}});
  }
  std::sort(nodes.begin(), nodes.end(), [](const Node& a, const Node& b) { return a.id < b.id; });
  const auto twice = std::adjacent_find(nodes.begin(), nodes.end(),
                                        [](const Node& a, const Node& b) { return a.id == b.id; });
  if (twice != nodes.end()) yaml.fail(fmt::format("has id {} twice", twice->id), "keep one of them");
  return nodes;
}

}  // namespace

ImportMap read_import_map(const std::filesystem::path& path, Format format) {
  const YamlValue yaml = YamlValue::parse(path, io::read_file(path));
  constexpr std::array<std::string_view, 8> kSiteKeys{"name",  "tags",    "anchors", "odometry",
                                                      "range", "surface", "imu",     "gnss"};
  YamlValue::Keys keys{{"schema"}, {kSiteKeys.begin(), kSiteKeys.end()}};
  keys.optional.insert(keys.optional.end(), {"sources", "axes"});
  yaml.expect_keys(keys);
  if (yaml.at("schema").integer(0, kMaxId) != 1)
    yaml.at("schema").fail("is not 1", "this program reads schema 1 only");
  ImportMap map;
  for (const std::string_view key : kSiteKeys)
    if (yaml.find(key)) map.given.emplace_back(key);
  if (const auto value = yaml.find("name")) map.site.name = value->text();
  if (const auto value = yaml.find("tags")) map.site.tags = parse_nodes<model::Tag>(*value, "lever_arm_m");
  if (const auto value = yaml.find("anchors"))
    map.site.surveyed_anchors = parse_nodes<model::Anchor>(*value, "position_m");
  if (const auto value = yaml.find("odometry")) map.site.odometry_noise = io::parse_odometry_noise(*value);
  if (const auto value = yaml.find("range")) map.site.range_priors = io::parse_range_priors(*value);
  if (const auto value = yaml.find("surface")) {
    io::InputFiles files;
    map.site.surface = io::parse_surface(*value, path.parent_path(), files);
  }
  map.site.sensors = io::parse_sensors(yaml);
  if (const auto value = yaml.find("sources"))
    for (const YamlValue& source : value->list()) map.sources.push_back(parse_source(source, format));
  if (const auto value = yaml.find("axes")) {
    if (format != Format::kKitti) value->fail("is of KITTI trajectories", "remove it");
    constexpr std::array<std::string_view, 2> kAxes{"robot", "camera"};
    map.axes = value->one_of(kAxes) == 0 ? Axes::kRobot : Axes::kCamera;
  }
  return map;
}

}  // namespace groma::importer
