#include "host/io/dataset.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <future>
#include <limits>
#include <numbers>
#include <span>
#include <tuple>
#include <unordered_set>
#include <utility>

#include "host/io/csv.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/io/log_file.hpp"
#include "host/io/site_description.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/model/plausible.hpp"
#include "host/model/pose.hpp"

namespace groma::io {

namespace {

using Presence = CsvReader::Presence;

constexpr std::array<std::string_view, 2> kOrigins{"recorded", "simulated"};
constexpr std::int64_t kMaxId = std::numeric_limits<model::NodeId>::max();

// Sorts rows by time. A row more than kMaxDelay_s behind the latest row before it is dropped. So is a row
// ahead of most of the following rows: it would make all of them late.
template <typename Sample, typename Key>
void put_in_order(std::vector<Sample>& samples, const Key& key, DroppedRows& dropped) {
  constexpr std::ptrdiff_t kRowsAhead = 16;
  double latest_s = -std::numeric_limits<double>::infinity();
  auto kept = samples.begin();
  for (auto row = samples.begin(); row != samples.end(); ++row) {
    bool misplaced = row->t_s < latest_s - kMaxDelay_s;
    if (row->t_s > latest_s + kMaxDelay_s) {
      const auto next = std::next(row);
      const auto end = samples.end() - next > kRowsAhead ? next + kRowsAhead : samples.end();
      const auto behind =
          std::count_if(next, end, [&](const Sample& other) { return other.t_s < row->t_s - kMaxDelay_s; });
      misplaced = 2 * behind > end - next;
    }
    if (misplaced) {
      ++dropped.late;
    } else {
      latest_s = std::max(latest_s, row->t_s);
      *kept++ = *row;
    }
  }
  samples.erase(kept, samples.end());
  const auto before = [&](const Sample& a, const Sample& b) { return key(a) < key(b); };
  if (!std::is_sorted(samples.begin(), samples.end(), before))
    std::stable_sort(samples.begin(), samples.end(), before);
  const auto end = std::unique(samples.begin(), samples.end(),
                               [&](const Sample& a, const Sample& b) { return key(a) == key(b); });
  dropped.repeated += static_cast<std::size_t>(samples.end() - end);
  samples.erase(end, samples.end());
}

// At least as many as rows.
std::size_t lines_of(std::string_view text) {
  return static_cast<std::size_t>(std::count(text.begin(), text.end(), '\n')) + 1;
}

template <typename Sample>
void put_in_order(std::vector<Sample>& samples, DroppedRows& dropped) {
  put_in_order(
      samples, [](const Sample& sample) { return sample.t_s; }, dropped);
}

// Odometry comes from one source, in order. A sample that is out of order by more than a few samples has a
// wrong timestamp: its velocity belongs to another time, and sorting it in would contradict the samples
// there.
void put_in_order(std::vector<model::OdometrySample>& odometry, DroppedRows& dropped) {
  std::vector<model::OdometrySample> kept;
  kept.reserve(odometry.size());
  for (auto row = odometry.begin(); row != odometry.end(); ++row) {
    const auto few = static_cast<std::ptrdiff_t>(kMaxOdometryOutOfOrder);
    const bool late =
        std::ssize(kept) > few && std::all_of(kept.end() - few - 1, kept.end(),
                                              [&](const auto& other) { return row->t_s < other.t_s; });
    const auto next = row + 1;
    const bool early =
        odometry.end() - next > few &&
        std::all_of(next, next + few + 1, [&](const auto& other) { return row->t_s > other.t_s; });
    if (late || early) {
      ++dropped.late;
    } else {
      kept.push_back(*row);
    }
  }
  odometry = std::move(kept);
  put_in_order<model::OdometrySample>(odometry, dropped);
}

constexpr auto kRangeKey = [](const model::RangeSample& range) {
  return std::tuple(range.t_s, range.tag_id, range.anchor_id, range.range_m);
};

// The id in a field; none if it is not a 16-bit number.
std::optional<model::NodeId> node_id(const CsvReader& csv, std::size_t column) {
  const std::int64_t id = csv.integer(column);
  if (id < 0 || id > kMaxId) return std::nullopt;
  return static_cast<model::NodeId>(id);
}

// The rows id,x_m,y_m,z_m of tags.csv or anchors.csv, sorted by id.
std::vector<std::pair<model::NodeId, Eigen::Vector3d>> parse_points(const std::filesystem::path& path,
                                                                    std::string_view text,
                                                                    std::string_view id_column) {
  CsvReader csv(path, text, {{id_column}, {"x_m"}, {"y_m"}, {"z_m"}});
  std::vector<std::pair<model::NodeId, Eigen::Vector3d>> points;
  std::unordered_set<model::NodeId> seen;
  while (csv.next()) {
    const std::optional<model::NodeId> id = node_id(csv, 0);
    if (!id)
      throw DataError(csv.place(0), "the id is out of range", fmt::format("it has to be 0 to {}", kMaxId));
    if (!seen.insert(*id).second) {
      throw DataError(csv.place(0), fmt::format("id {} occurs twice", *id), "keep one of the rows");
    }
    points.emplace_back(*id, Eigen::Vector3d(csv.number(1), csv.number(2), csv.number(3)));
  }
  std::sort(points.begin(), points.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
  return points;
}

std::vector<model::Tag> parse_tags(const std::filesystem::path& path, std::string_view text,
                                   bool needs_tags = true) {
  std::vector<model::Tag> tags;
  for (const auto& [id, point] : parse_points(path, text, "tag_id")) tags.push_back({id, point});
  if (tags.empty() && needs_tags)
    throw DataError({path}, "there are no tags", "add a row tag_id,x_m,y_m,z_m for each");
  return tags;
}

std::vector<model::Anchor> parse_anchors(const std::filesystem::path& path, std::string_view text) {
  std::vector<model::Anchor> anchors;
  for (const auto& [id, point] : parse_points(path, text, "anchor_id")) anchors.push_back({id, point});
  return anchors;
}

// Which of all ids are there.
template <typename Node>
std::vector<bool> known_ids(const std::vector<Node>& nodes) {
  std::vector<bool> known(kMaxId + 1, false);
  for (const Node& node : nodes) known[node.id] = true;
  return known;
}

float optional_float(const CsvReader& csv, std::size_t column) {
  const std::optional<double> value = csv.optional_number(column);
  return value ? static_cast<float>(*value) : model::kUnknown;
}

// A field's whole number; 0 (unknown) unless it is within 0 to `largest`.
std::uint8_t optional_code(const CsvReader& csv, std::size_t column, std::uint8_t largest) {
  const std::int64_t code = csv.optional_integer(column).value_or(0);
  return code >= 0 && code <= largest ? static_cast<std::uint8_t>(code) : std::uint8_t{0};
}

// Whether to keep a range; counts those that are dropped.
bool accept(double range_m, bool knows_tag, bool knows_anchor, DroppedRows& dropped) {
  if (!(range_m > 0.0 && range_m <= kMaxRange_m)) {
    ++dropped.range_out_of_bounds;
  } else if (!knows_tag) {
    ++dropped.unknown_tag;
  } else if (!knows_anchor) {
    ++dropped.unknown_anchor;
  } else {
    return true;
  }
  return false;
}

// The rows of ranges.csv.
struct Ranges {
  std::vector<model::RangeSample> kept;
  std::vector<model::RangeSample> dropped_rows;  // Dataset::dropped_ranges
  DroppedRows dropped;
};

// `anchors` is null if every anchor is accepted.
Ranges parse_ranges(const std::filesystem::path& path, std::string_view text,
                    const std::vector<model::Tag>& tags, const std::vector<model::Anchor>* anchors) {
  Ranges out;
  CsvReader csv(path, text,
                {{"t_s"},
                 {"tag_id"},
                 {"anchor_id"},
                 {"range_m"},
                 {"first_path_power_dbm", Presence::kOptional},
                 {"receive_power_dbm", Presence::kOptional},
                 {"clock_offset_ppm", Presence::kOptional},
                 {"noise", Presence::kOptional},
                 {"line_of_sight", Presence::kOptional},
                 {"corrections", Presence::kOptional},
                 {"network_time_dtu", Presence::kOptional}});
  const std::vector<bool> known_tags = known_ids(tags);
  const std::vector<bool> known_anchors =
      anchors != nullptr ? known_ids(*anchors) : std::vector<bool>(kMaxId + 1, true);
  out.kept.reserve(lines_of(text));
  while (csv.next()) {
    const double t_s = csv.number(0);
    const std::optional<model::NodeId> tag_id = node_id(csv, 1);
    const std::optional<model::NodeId> anchor_id = node_id(csv, 2);
    const double range_m = csv.number(3);
    const float first_path_power_dbm = optional_float(csv, 4);
    const float receive_power_dbm = optional_float(csv, 5);
    const float clock_offset_ppm = optional_float(csv, 6);
    const float noise = optional_float(csv, 7);
    const auto line_of_sight = static_cast<model::LineOfSight>(optional_code(csv, 8, 3));
    const std::uint8_t corrections = optional_code(csv, 9, 0xFF);
    const std::int64_t network_time_dtu = csv.optional_integer(10).value_or(0);
    const model::RangeSample range{t_s,
                                   tag_id.value_or(0),
                                   anchor_id.value_or(0),
                                   range_m,
                                   first_path_power_dbm,
                                   receive_power_dbm,
                                   clock_offset_ppm,
                                   noise,
                                   line_of_sight,
                                   corrections,
                                   network_time_dtu};
    const bool knows_tag = tag_id && known_tags[*tag_id];
    const bool knows_anchor = anchor_id && known_anchors[*anchor_id];
    if (accept(range_m, knows_tag, knows_anchor, out.dropped)) {
      out.kept.push_back(range);
    } else if (tag_id && anchor_id) {
      out.dropped_rows.push_back(range);
    }
  }
  put_in_order(out.kept, kRangeKey, out.dropped);
  return out;
}

constexpr const char* kOdometryFile = "odometry.csv";
constexpr const char* kSteeringFile = "steering.csv";

std::vector<model::OdometrySample> parse_velocities(const std::filesystem::path& path,
                                                    std::string_view text) {
  CsvReader csv(path, text, {{"t_s"}, {"vx_mps"}, {"vy_mps"}, {"omega_radps"}});
  std::vector<model::OdometrySample> odometry;
  odometry.reserve(lines_of(text));
  while (csv.next()) odometry.push_back({csv.number(0), csv.number(1), csv.number(2), csv.number(3)});
  return odometry;
}

std::vector<model::OdometrySample> parse_steering(const std::filesystem::path& path, std::string_view text,
                                                  const model::Steering& vehicle) {
  CsvReader csv(path, text, {{"t_s"}, {"speed_mps"}, {"steering_rad"}});
  std::vector<model::OdometrySample> odometry;
  while (csv.next()) {
    const model::SteeringSample sample{csv.number(0), csv.number(1), csv.number(2)};
    if (!(std::abs(sample.steering_rad) <= model::kMostSteering_rad)) {
      throw DataError(csv.row_place(), fmt::format("{} rad is no steering angle", sample.steering_rad),
                      "give the angle of the front wheel in radians, positive to the left");
    }
    odometry.push_back(model::to_odometry(sample, vehicle));
  }
  return odometry;
}

std::optional<model::Steering> vehicle_of(const YamlValue& description) {
  const auto steering = description.find("steering");
  return steering ? std::optional(parse_steering(*steering)) : std::nullopt;
}

// `read` gives the text of a file.
template <typename Read>
std::vector<model::OdometrySample> parse_odometry(const std::filesystem::path& folder,
                                                  const std::optional<model::Steering>& vehicle, Read read,
                                                  DroppedRows& dropped) {
  const std::filesystem::path path = folder / (vehicle ? kSteeringFile : kOdometryFile);
  const std::string text = read(path);
  std::vector<model::OdometrySample> odometry =
      vehicle ? parse_steering(path, text, *vehicle) : parse_velocities(path, text);
  put_in_order(odometry, dropped);
  return odometry;
}

// Implausible rows are dropped; if they are half of all rows or more, the file is wrong: finish() throws.
class ImplausibleRows {
 public:
  void add(const CsvReader& csv, const char* problem, const char* remedy) {
    if (count_++ == 0) first_ = DataError(csv.row_place(), problem, remedy);
  }
  // kept: the number of plausible rows.
  void finish(std::size_t kept, DroppedRows& dropped) const {
    if (first_ && count_ >= kept) throw DataError(*first_);
    dropped.implausible += count_;
  }

 private:
  std::size_t count_ = 0;
  std::optional<DataError> first_;
};

constexpr const char* kNoRobot = "no ground robot has such a position or attitude";
constexpr const char* kNoRobotRemedy = "give metres and radians, or remove the row";

// The six fields from `first` on; none if all are empty.
std::optional<model::PoseCovariance> optional_covariance(const CsvReader& csv, std::size_t first) {
  model::PoseCovariance terms{};
  std::size_t given = 0;
  for (std::size_t i = 0; i < terms.size(); ++i) {
    if (!csv.has(first + i)) continue;
    terms[i] = csv.number(first + i);
    ++given;
  }
  if (given == 0) return std::nullopt;
  constexpr const char* kWhole = "give p_xx, p_xy, p_xt, p_yy, p_yt and p_tt of a row, or none of them";
  if (given < terms.size()) throw DataError(csv.row_place(), "the pose's covariance is incomplete", kWhole);
  return terms;
}

// Whether the pose is one of a ground robot if its roll and pitch are in degrees.
bool is_plausible_in_degrees(model::PoseSample pose) {
  constexpr double kRadians = std::numbers::pi / 180.0;
  pose.roll_rad *= kRadians;
  pose.pitch_rad *= kRadians;
  return model::is_plausible(pose);
}

// Whether to keep the row.
bool check(const CsvReader& csv, const model::PoseSample& pose, ImplausibleRows& implausible) {
  if (pose.covariance && !model::is_covariance(*pose.covariance)) {
    implausible.add(
        csv, "p_xx to p_tt are not a covariance of x, y and yaw",
        "variances have to be above zero and correlations within -1 to 1; leave the fields empty if they "
        "are unknown");
    return false;
  }
  if (!model::is_plausible(pose)) {
    implausible.add(csv, kNoRobot, kNoRobotRemedy);
    return false;
  }
  return true;
}

std::vector<model::PoseSample> parse_poses(const std::filesystem::path& path, std::string_view text,
                                           DroppedRows& dropped) {
  CsvReader csv(path, text,
                {{"t_s"},
                 {"x_m"},
                 {"y_m"},
                 {"z_m"},
                 {"yaw_rad"},
                 {"roll_rad", Presence::kOptional},
                 {"pitch_rad", Presence::kOptional},
                 {"p_xx", Presence::kOptional},
                 {"p_xy", Presence::kOptional},
                 {"p_xt", Presence::kOptional},
                 {"p_yy", Presence::kOptional},
                 {"p_yt", Presence::kOptional},
                 {"p_tt", Presence::kOptional}});
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  std::vector<model::PoseSample> poses;
  poses.reserve(lines_of(text));
  std::vector<model::PoseSample> tilted;
  ImplausibleRows implausible;
  ImplausibleRows tilts;
  while (csv.next()) {
    const model::PoseSample pose{csv.number(0),
                                 csv.number(1),
                                 csv.number(2),
                                 csv.number(3),
                                 csv.number(4),
                                 csv.optional_number(5).value_or(kNone),
                                 csv.optional_number(6).value_or(kNone),
                                 optional_covariance(csv, 7)};
    const bool is_tilted = is_plausible_in_degrees(pose);
    if (check(csv, pose, is_tilted ? tilts : implausible)) {
      poses.push_back(pose);
    } else if (is_tilted) {
      tilted.push_back(pose);
    }
  }
  implausible.finish(poses.size() + tilted.size(), dropped);
  // Most are a mistake of the unit, which the diagnosis names; a few are wrong rows.
  if (!tilted.empty() && tilted.size() >= poses.size()) {
    poses.insert(poses.end(), tilted.begin(), tilted.end());
    std::stable_sort(poses.begin(), poses.end(), [](const auto& a, const auto& b) { return a.t_s < b.t_s; });
  } else {
    tilts.finish(poses.size(), dropped);
  }
  put_in_order(poses, dropped);
  return poses;
}

void parse(const std::filesystem::path& path, std::string_view text, std::vector<model::YawRateSample>& out,
           DroppedRows& dropped) {
  CsvReader csv(path, text, {{"t_s"}, {"omega_radps"}});
  while (csv.next()) out.push_back({csv.number(0), csv.number(1)});
  put_in_order(out, dropped);
}

void parse(const std::filesystem::path& path, std::string_view text,
           std::vector<model::PositionSample>& positions, DroppedRows& dropped) {
  CsvReader csv(path, text, {{"t_s"}, {"x_m"}, {"y_m"}, {"p_xx"}, {"p_xy"}, {"p_yy"}});
  ImplausibleRows implausible;
  while (csv.next()) {
    const model::PositionSample position{
        csv.number(0), csv.number(1), csv.number(2), {csv.number(3), csv.number(4), csv.number(5)}};
    if (!model::is_covariance(position.covariance_m2)) {
      implausible.add(csv, "p_xx, p_xy and p_yy are not a covariance of x and y",
                      "variances have to be above zero and the correlation between -1 and 1");
    } else if (!model::is_plausible(position)) {
      implausible.add(csv, kNoRobot, kNoRobotRemedy);
    } else {
      positions.push_back(position);
    }
  }
  implausible.finish(positions.size(), dropped);
  put_in_order(positions, dropped);
}

// Like parse_poses(), but without a height, and with a covariance in each row.
void parse(const std::filesystem::path& path, std::string_view text, std::vector<model::PoseSample>& poses,
           DroppedRows& dropped) {
  CsvReader csv(path, text,
                {{"t_s"},
                 {"x_m"},
                 {"y_m"},
                 {"yaw_rad"},
                 {"p_xx"},
                 {"p_xy"},
                 {"p_xt"},
                 {"p_yy"},
                 {"p_yt"},
                 {"p_tt"},
                 {"roll_rad", Presence::kOptional},
                 {"pitch_rad", Presence::kOptional}});
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  ImplausibleRows implausible;
  while (csv.next()) {
    const std::optional<model::PoseCovariance> covariance = optional_covariance(csv, 4);
    if (!covariance)
      throw DataError(csv.row_place(), "the pose has no covariance", "give p_xx to p_tt in each row");
    const model::PoseSample pose{csv.number(0),
                                 csv.number(1),
                                 csv.number(2),
                                 0.0,
                                 csv.number(3),
                                 csv.optional_number(10).value_or(kNone),
                                 csv.optional_number(11).value_or(kNone),
                                 covariance};
    if (check(csv, pose, implausible)) poses.push_back(pose);
  }
  implausible.finish(poses.size(), dropped);
  put_in_order(poses, dropped);
}

void parse(const std::filesystem::path& path, std::string_view text,
           std::vector<model::ZeroVelocitySample>& out, DroppedRows& dropped) {
  CsvReader csv(path, text, {{"t_s"}});
  while (csv.next()) out.push_back({csv.number(0)});
  put_in_order(out, dropped);
}

void read_sensors(const std::filesystem::path& folder, InputFiles& files, Dataset& dataset) {
  const auto read = [&]<class Sample>(std::vector<Sample>& out) {
    const std::string_view name = model::kSensorNames.at(model::kSensorOf<Sample>);
    const std::filesystem::path path = folder / fmt::format("{}.csv", name);
    if (std::filesystem::exists(path)) parse(path, files.read(path), out, dataset.dropped);
  };
  std::apply([&](auto&... tables) { (read(tables), ...); }, dataset.sensor_samples);
}

// Returns the car-like vehicle whose odometry is its steering, if it is one.
std::optional<model::Steering> parse_description(const YamlValue& yaml, const std::filesystem::path& folder,
                                                 InputFiles& files, Dataset& dataset) {
  yaml.expect_keys(
      {{"schema", "name", "origin", "range", "surface"}, {"odometry", "steering", "imu", "gnss"}});
  expect_odometry(yaml);
  if (yaml.at("schema").integer(0, std::numeric_limits<std::int64_t>::max()) != 1) {
    yaml.at("schema").fail("is not 1", "this program reads schema 1 only");
  }
  dataset.name = yaml.at("name").text();
  dataset.origin = kOrigins.at(yaml.at("origin").one_of(kOrigins));

  const std::optional<model::Steering> vehicle = vehicle_of(yaml);
  dataset.odometry_noise = vehicle ? model::noise_of(*vehicle) : parse_odometry_noise(yaml.at("odometry"));
  dataset.range_priors = parse_range_priors(yaml.at("range"));
  dataset.sensors = parse_sensors(yaml);
  dataset.surface = parse_surface(yaml.at("surface"), folder, files);
  return vehicle;
}

// Drops the ranges that read_dataset() would drop from a folder.
std::vector<model::RangeSample> keep_good(const std::vector<model::RangeSample>& ranges,
                                          const std::vector<model::Tag>& tags, Dataset& dataset) {
  const std::vector<bool> known_tags = known_ids(tags);
  std::vector<model::RangeSample> kept;
  kept.reserve(ranges.size());
  for (const model::RangeSample& range : ranges) {
    const bool is_good = accept(range.range_m, known_tags[range.tag_id], true, dataset.dropped);
    (is_good ? kept : dataset.dropped_ranges).push_back(range);
  }
  put_in_order(kept, kRangeKey, dataset.dropped);
  return kept;
}

Dataset read_log(const std::filesystem::path& path, const ReadOptions& options) {
  InputFiles files;
  LogContent content = parse_log(files.read(path), options.log_section);
  if (content.sections.empty()) {
    throw DataError({path}, "is not a log", "give a data set folder, or a log that gromad recorded");
  }
  const std::size_t count = content.sections.size();
  const std::size_t chosen = options.log_section.value_or(count);
  if (chosen < 1 || chosen > count) {
    throw DataError({path}, fmt::format("has no section {}", chosen),
                    fmt::format("its sections are 1 to {}", count));
  }
  LogSection& section = content.sections[chosen - 1];
  if (section.description.empty() || section.description.back().name != "dataset.yaml") {
    throw DataError({path},
                    fmt::format("section {} has no site description: its beginning is damaged", chosen),
                    count > 1 ? "choose another with --section" : "record another");
  }
  Dataset dataset;
  dataset.log = {.sections = count, .section = chosen, .damaged_bytes = content.damaged_bytes};
  InputFiles described;
  for (DescriptionFile& file : section.description) described.provide(path / file.name, std::move(file.text));
  const std::filesystem::path description = path / "dataset.yaml";
  parse_description(YamlValue::parse(description, described.read(description)), path, described, dataset);
  const std::filesystem::path tags = path / "tags.csv";
  dataset.tags = parse_tags(tags, described.read(tags));

  dataset.ranges = keep_good(section.samples.ranges, dataset.tags, dataset);
  if (options.odometry) {
    dataset.odometry = std::move(section.samples.odometry);
    put_in_order(dataset.odometry, dataset.dropped);
  }
  if (options.pose_prior && options.pose_file) {
    dataset.pose_prior = parse_poses(*options.pose_file, files.read(*options.pose_file), dataset.dropped);
  } else if (options.pose_prior) {
    dataset.pose_prior = std::move(section.samples.poses);
    put_in_order(dataset.pose_prior, dataset.dropped);
  }
  if (options.sensors) {
    dataset.sensor_samples = std::move(section.samples.sensors);
    std::apply([&](auto&... tables) { (put_in_order(tables, dataset.dropped), ...); },
               dataset.sensor_samples);
  }
  dataset.sha256 = files.digest();
  return dataset;
}

}  // namespace

Dataset read_dataset(const std::filesystem::path& path, const ReadOptions& options) {
  if (!std::filesystem::exists(path))
    throw DataError({path}, "does not exist", "give the folder of a data set, or a log");
  if (!std::filesystem::is_directory(path)) return read_log(path, options);

  const std::filesystem::path& folder = path;
  InputFiles files;
  Dataset dataset;
  const std::filesystem::path description = folder / "dataset.yaml";
  const std::optional<model::Steering> vehicle =
      parse_description(YamlValue::parse(description, files.read(description)), folder, files, dataset);

  const std::filesystem::path tags = folder / "tags.csv";
  dataset.tags = parse_tags(tags, files.read(tags), options.needs_tags);

  const std::filesystem::path anchors = folder / "anchors.csv";
  const bool with_anchors = options.surveyed_anchors && std::filesystem::exists(anchors);
  if (with_anchors) dataset.surveyed_anchors = parse_anchors(anchors, files.read(anchors));

  // Beside the other files, because ranges.csv is as long as all of them together.
  const std::filesystem::path ranges_path = folder / "ranges.csv";
  auto ranges = std::async(std::launch::async, [&dataset, &ranges_path, with_anchors,
                                                text = files.read(ranges_path)] {
    return parse_ranges(ranges_path, text, dataset.tags, with_anchors ? &dataset.surveyed_anchors : nullptr);
  });

  if (options.odometry) {
    const auto read = [&](const std::filesystem::path& file) { return files.read(file); };
    dataset.odometry = parse_odometry(folder, vehicle, read, dataset.dropped);
  }

  if (options.sensors) read_sensors(folder, files, dataset);

  const std::filesystem::path truth = folder / "groundtruth.csv";
  const bool truth_is_there = std::filesystem::exists(truth);
  std::filesystem::path prior = options.pose_file.value_or(folder / "pose_prior.csv");
  if (options.pose_prior && !options.pose_file && !std::filesystem::exists(prior)) {
    if (!truth_is_there && options.needs_pose_prior)
      throw DataError({prior}, "does not exist, nor does groundtruth.csv", "add one of them");
    prior = truth;
  }
  const bool prior_is_there = prior != truth || truth_is_there;
  if (options.ground_truth && truth_is_there) {
    dataset.ground_truth = parse_poses(truth, files.read(truth), dataset.dropped);
  }
  if (options.pose_prior && prior_is_there) {
    dataset.pose_prior = options.ground_truth && prior == truth
                             ? dataset.ground_truth
                             : parse_poses(prior, files.read(prior), dataset.dropped);
  }
  Ranges parsed = ranges.get();
  dataset.ranges = std::move(parsed.kept);
  dataset.dropped_ranges = std::move(parsed.dropped_rows);
  dataset.dropped += parsed.dropped;
  dataset.sha256 = files.digest();
  return dataset;
}

std::vector<model::PoseSample> read_poses(const std::filesystem::path& path, DroppedRows& dropped) {
  return parse_poses(path, read_file(path), dropped);
}

std::filesystem::path odometry_file(const std::filesystem::path& folder) {
  const bool is_car =
      !std::filesystem::exists(folder / kOdometryFile) && std::filesystem::exists(folder / kSteeringFile);
  return folder / (is_car ? kSteeringFile : kOdometryFile);
}

std::vector<model::OdometrySample> read_odometry(const std::filesystem::path& folder, DroppedRows& dropped) {
  if (!std::filesystem::exists(odometry_file(folder))) return {};
  const std::filesystem::path description = folder / "dataset.yaml";
  return parse_odometry(folder, vehicle_of(YamlValue::parse(description, read_file(description))), read_file,
                        dropped);
}

std::vector<model::AnchorRange> read_survey(const std::filesystem::path& path, DroppedRows& dropped) {
  const std::string text = read_file(path);
  CsvReader csv(path, text, {{"anchor_id"}, {"other_id"}, {"range_m"}, {"sigma_m"}, {"count"}});
  std::vector<model::AnchorRange> out;
  while (csv.next()) {
    const std::optional<model::NodeId> anchor_id = node_id(csv, 0);
    const std::optional<model::NodeId> other_id = node_id(csv, 1);
    const double range_m = csv.number(2);
    const double sigma_m = csv.number(3);
    const std::int64_t count = csv.integer(4);
    if (!anchor_id || !other_id || *anchor_id == *other_id) {
      ++dropped.unknown_anchor;
    } else if (!(range_m > 0.0 && range_m <= kMaxRange_m) || sigma_m < 0.0 || count < 1) {
      ++dropped.range_out_of_bounds;
    } else {
      out.push_back({*anchor_id, *other_id, range_m, sigma_m, static_cast<std::size_t>(count)});
    }
  }
  return out;
}

}  // namespace groma::io
