// Messages of a recording of ROS 2 as the tables of a data set.
#include <fmt/format.h>

#include <algorithm>
#include <map>
#include <memory>
#include <stdexcept>
#include <utility>

#include "host/importer/bag.hpp"
#include "host/importer/import.hpp"
#include "host/io/error.hpp"
#include "host/ros2/message.hpp"
#include "host/ros2/schemas.hpp"

namespace groma::importer {

namespace {

using ros2::FieldPath;
using ros2::MessageDefinition;
using ros2::MessageValue;

// In place of a field: the time at which the message was recorded.
constexpr std::string_view kLogTime = "@log_time";

struct Binding {
  std::string_view column;
  std::string_view field;
};
// The fields of a known type that are the columns of a table. The first table of a type is its default.
struct KnownType {
  std::string_view type;
  Table table;
  std::vector<Binding> columns;
};

std::vector<Binding> twist(std::string_view x, std::string_view y, std::string_view omega) {
  return {{"vx_mps", x}, {"vy_mps", y}, {"omega_radps", omega}};
}

// has_covariance: the pose is a PoseWithCovariance, not a Pose.
std::vector<Binding> pose_columns(bool has_covariance) {
  if (!has_covariance) {
    return {{"x_m", "pose.position.x"},   {"y_m", "pose.position.y"},   {"z_m", "pose.position.z"},
            {"qx", "pose.orientation.x"}, {"qy", "pose.orientation.y"}, {"qz", "pose.orientation.z"},
            {"qw", "pose.orientation.w"}};
  }
  return {
      {"x_m", "pose.pose.position.x"},   {"y_m", "pose.pose.position.y"},   {"z_m", "pose.pose.position.z"},
      {"qx", "pose.pose.orientation.x"}, {"qy", "pose.pose.orientation.y"}, {"qz", "pose.pose.orientation.z"},
      {"qw", "pose.pose.orientation.w"}, {"p_xx", "pose.covariance[0]"},    {"p_xy", "pose.covariance[1]"},
      {"p_xt", "pose.covariance[5]"},    {"p_yy", "pose.covariance[7]"},    {"p_yt", "pose.covariance[11]"},
      {"p_tt", "pose.covariance[35]"}};
}

const std::vector<KnownType>& known_types() {
  static const std::vector<KnownType> types = [] {
    std::vector<KnownType> out;
    const auto nested = twist("twist.twist.linear.x", "twist.twist.linear.y", "twist.twist.angular.z");
    out.push_back({"nav_msgs/msg/Odometry", Table::kOdometry, nested});
    out.push_back({"geometry_msgs/msg/TwistWithCovarianceStamped", Table::kOdometry, nested});
    out.push_back({"geometry_msgs/msg/TwistStamped", Table::kOdometry,
                   twist("twist.linear.x", "twist.linear.y", "twist.angular.z")});
    for (const Table table : {Table::kPosePrior, Table::kGroundTruth, Table::kAbsolutePose}) {
      out.push_back({"geometry_msgs/msg/PoseStamped", table, pose_columns(false)});
      out.push_back({"geometry_msgs/msg/PoseWithCovarianceStamped", table, pose_columns(true)});
      out.push_back({"nav_msgs/msg/Odometry", table, pose_columns(true)});
    }
    out.push_back({"sensor_msgs/msg/Imu", Table::kImu, {{"omega_radps", "angular_velocity.z"}}});
    out.push_back({"std_msgs/msg/Header", Table::kZeroVelocity, {{"t_s", "stamp"}}});
    out.push_back({"groma_msgs/msg/Position",
                   Table::kGnss,
                   {{"x_m", "x_m"},
                    {"y_m", "y_m"},
                    {"p_xx", "covariance_m2[0]"},
                    {"p_xy", "covariance_m2[1]"},
                    {"p_yy", "covariance_m2[2]"}}});
    out.push_back({"groma_msgs/msg/Ranges",
                   Table::kRanges,
                   {{"t_s", "ranges[].t_s"},
                    {"tag_id", "ranges[].tag_id"},
                    {"anchor_id", "ranges[].anchor_id"},
                    {"range_m", "ranges[].range_m"},
                    {"first_path_power_dbm", "ranges[].first_path_power_dbm"},
                    {"receive_power_dbm", "ranges[].receive_power_dbm"},
                    {"clock_offset_ppm", "ranges[].clock_offset_ppm"},
                    {"noise", "ranges[].noise"},
                    {"line_of_sight", "ranges[].line_of_sight"},
                    {"corrections", "ranges[].corrections"},
                    {"network_time_dtu", "ranges[].network_time_dtu"}}});
    return out;
  }();
  return types;
}

const KnownType* known_type(std::string_view type, std::optional<Table> table) {
  for (const KnownType& known : known_types())
    if (known.type == type && (!table || known.table == *table)) return &known;
  return nullptr;
}

std::string list_of(const std::vector<BagTopic>& topics) {
  std::string list;
  for (const BagTopic& topic : topics)
    list += fmt::format("{}{} ({}, {})", list.empty() ? "" : ", ", topic.name, topic.type, topic.messages);
  return list.empty() ? "none" : list;
}

// The topics that groma convert --ros2 writes its inputs to.
std::optional<Table> table_of_own(std::string_view topic) {
  constexpr std::string_view kInput = "/groma/input/";
  if (topic == "/groma/ranges") return Table::kRanges;
  if (!topic.starts_with(kInput)) return std::nullopt;
  topic.remove_prefix(kInput.size());
  const auto found = std::find(kTableNames.begin(), kTableNames.end(), topic);
  if (found == kTableNames.end()) return std::nullopt;
  return static_cast<Table>(found - kTableNames.begin());
}

// Without sources in the map: our own topics, and each other topic of a known type, if it is the only one of
// its table.
std::vector<Source> automatic_sources(const std::filesystem::path& path,
                                      const std::vector<BagTopic>& topics) {
  std::map<Table, std::vector<std::string>> found;
  for (const BagTopic& topic : topics) {
    if (topic.messages == 0) continue;
    if (const std::optional<Table> own = table_of_own(topic.name)) {
      found[*own].push_back(topic.name);
    } else if (!topic.name.starts_with("/groma/")) {
      const KnownType* known = known_type(topic.type, std::nullopt);
      if (known != nullptr && known->table != Table::kZeroVelocity) found[known->table].push_back(topic.name);
    }
  }
  std::vector<Source> sources;
  for (const auto& [table, names] : found) {
    if (names.size() > 1)
      throw io::DataError(
          {path},
          fmt::format("{} and {} could both be the source of {}.csv", names[0], names[1], name_of(table)),
          fmt::format("choose with sources: [{{topic: {}, to: {}}}] in the map", names[0], name_of(table)));
    Source& source = sources.emplace_back();
    source.from = names.front();
    source.to = table;
  }
  if (sources.empty())
    throw io::DataError({path}, "no topic has a type that is known",
                        fmt::format("describe one in the map; the topics are {}", list_of(topics)));
  return sources;
}

// Where a column comes from.
struct Origin {
  Cell constant;
  bool is_log_time = false;
  std::optional<FieldPath> path;
};

// Decodes one topic into one table.
class Program {
 public:
  Program(const std::filesystem::path& path, const BagTopic& topic, const Source& source)
      : topic_(topic.name), source_(source), definition_(make_definition(path, topic, source)) {
    const KnownType* known = known_type(topic.type, source.to);
    for (const ColumnType& column : columns_of(source.to))
      origins_.push_back(origin_of(path, topic, column, known));
  }

  void take(std::uint64_t log_time_ns, std::string_view data, io::Dataset& dataset) {
    ++messages_;
    const std::optional<MessageValue> message = definition_.read(data);
    if (!message)
      return skip(fmt::format("its {} bytes do not have the layout of its definition", data.size()));
    std::size_t rows = 1;
    std::vector<std::vector<const MessageValue*>> values(origins_.size());
    bool is_of_each = false;
    for (std::size_t i = 0; i < origins_.size(); ++i) {
      if (!origins_[i].path) continue;
      values[i] = values_at(*message, *origins_[i].path);
      if (!origins_[i].path->is_of_each()) continue;
      if (is_of_each && values[i].size() != rows) return skip("its arrays differ in length");
      rows = values[i].size();
      is_of_each = true;
    }
    std::vector<Cell> cells(origins_.size());
    for (std::size_t row = 0; row < rows; ++row) {
      Units units = source_.units;
      for (std::size_t i = 0; i < origins_.size(); ++i) {
        cells[i] = origins_[i].constant;
        if (origins_[i].is_log_time) {
          cells[i] = cell(seconds(log_time_ns / kNsPerS, log_time_ns % kNsPerS));
          units.time_s = 1.0;
        } else if (origins_[i].path && !values[i].empty()) {
          cells[i] = cell_of(*values[i][origins_[i].path->is_of_each() ? row : 0], units);
        }
      }
      const std::string problem = add_row(source_.to, cells, units, dataset);
      if (problem.empty()) {
        ++rows_;
      } else {
        skip(problem);
      }
    }
  }

  void finish(const std::filesystem::path& path, std::size_t begin, Imported& out) const {
    if (rows_ == 0) {
      throw io::DataError({path},
                          fmt::format("topic {} gives no rows: {}", topic_,
                                      problem_.empty() ? "it has no messages" : problem_),
                          "check the topic and its fields in the map");
    }
    if (skipped_ > 0)
      out.warnings.push_back(fmt::format("{} rows of {} were left out, first in its message {}: {}", skipped_,
                                         topic_, first_skipped_, problem_));
    const ImportedTable& imported = out.tables.emplace_back(ImportedTable{source_.to, topic_, rows_, ""});
    expect_plausible(path, imported, begin, source_.units, out.dataset);
  }
  [[nodiscard]] Table table() const { return source_.to; }
  [[nodiscard]] const std::optional<Eigen::Isometry3d>& base_link() const { return source_.base_link; }

 private:
  static constexpr std::uint64_t kNsPerS = 1'000'000'000;

  static double seconds(std::uint64_t s, std::uint64_t ns) {
    return static_cast<double>(s) + static_cast<double>(ns) / 1e9;
  }

  static MessageDefinition make_definition(const std::filesystem::path& path, const BagTopic& topic,
                                           const Source& source) {
    if (topic.encoding != "cdr")
      throw io::DataError({path},
                          fmt::format("topic {} is encoded as {}", topic.name, io::shown(topic.encoding)),
                          "give a recording of ROS 2, whose messages are cdr");
    std::string text = source.definition;
    if (text.empty() && topic.definition != nullptr) text = *topic.definition;
    if (text.empty()) text = ros2::schema_of(topic.type);
    if (text.empty())
      throw io::DataError(
          {path}, fmt::format("the recording does not define the type {} of {}", topic.type, topic.name),
          "write the content of its .msg file as definition of the source in the map");
    try {
      return MessageDefinition(topic.type, text);
    } catch (const std::invalid_argument& error) {
      throw io::DataError({path},
                          fmt::format("the definition of {} cannot be used: {}", topic.type, error.what()),
                          "write the content of its .msg file as definition of the source in the map");
    }
  }

  Origin origin_of(const std::filesystem::path& path, const BagTopic& topic, const ColumnType& column,
                   const KnownType* known) const {
    const auto given = source_.columns.find(column.name);
    if (given != source_.columns.end() && given->second.constant)
      return {.constant = cell(*given->second.constant), .path = {}};
    std::string field = given != source_.columns.end() ? given->second.name : "";
    if (field == kLogTime) return {.is_log_time = true, .path = {}};
    if (field.empty() && known != nullptr) {
      for (const Binding& binding : known->columns)
        if (binding.column == column.name) field = binding.field;
    }
    if (field.empty() && column.name == "t_s") {
      if (!definition_.has("header")) return {.is_log_time = true, .path = {}};
      field = "header.stamp";
    }
    if (field.empty() && !column.required) return {};
    const std::string what = fmt::format("{} ({})", topic.name, topic.type);
    if (field.empty())
      throw io::ConfigError(
          source_.place.path.empty() ? io::FilePlace{path} : source_.place,
          fmt::format("nothing gives {} of {}.csv from {}", column.name, name_of(source_.to), what),
          fmt::format("write columns: {{{}: FIELD}}", column.name));
    std::optional<FieldPath> parsed = FieldPath::parse(field);
    const std::string problem =
        parsed ? definition_.problem_of(*parsed) : fmt::format("has no field {}", field);
    if (!problem.empty())
      throw io::ConfigError(source_.place.path.empty() ? io::FilePlace{path} : source_.place,
                            fmt::format("{} {}", what, problem), "correct the field in the map");
    return {.path = std::move(parsed)};
  }

  // A number, or a timestamp of ROS 2, which is in seconds whatever the units are.
  static Cell cell_of(const MessageValue& value, Units& units) {
    if (const auto* number = std::get_if<double>(&value.content)) return cell(*number);
    if (const auto* whole = std::get_if<std::int64_t>(&value.content)) return cell(*whole);
    const MessageValue* s = field_of(value, "sec");
    const MessageValue* ns = field_of(value, "nanosec");
    const auto* s_number = s != nullptr ? std::get_if<std::int64_t>(&s->content) : nullptr;
    const auto* ns_number = ns != nullptr ? std::get_if<std::int64_t>(&ns->content) : nullptr;
    if (s_number == nullptr || ns_number == nullptr) return {};
    units.time_s = 1.0;
    return cell(static_cast<double>(*s_number) + static_cast<double>(*ns_number) / 1e9);
  }

  void skip(const std::string& problem) {
    if (skipped_++ > 0) return;
    problem_ = problem;
    first_skipped_ = messages_;
  }

  std::string topic_;
  Source source_;
  MessageDefinition definition_;
  std::vector<Origin> origins_;
  std::size_t messages_ = 0;
  std::size_t rows_ = 0;
  std::size_t skipped_ = 0;
  std::size_t first_skipped_ = 0;
  std::string problem_;
};

struct OpenBag {
  std::filesystem::path path;
  std::unique_ptr<Bag> bag;
};

// Whether the messages of both are decoded in the same way.
bool is_alike(const BagTopic& a, const BagTopic& b) {
  const std::string_view of_a = a.definition != nullptr ? std::string_view(*a.definition) : "";
  const std::string_view of_b = b.definition != nullptr ? std::string_view(*b.definition) : "";
  return a.type == b.type && a.encoding == b.encoding && of_a == of_b;
}

// A topic has one type and one definition in all files.
void expect_one_type(const std::vector<OpenBag>& bags, const BagTopic& topic) {
  for (const OpenBag& of : bags) {
    for (const BagTopic& other : of.bag->topics()) {
      if (other.name != topic.name || is_alike(other, topic)) continue;
      throw io::DataError(
          {of.path},
          other.type != topic.type
              ? fmt::format("topic {} has the types {} and {}", topic.name, topic.type, other.type)
              : fmt::format("topic {} has two definitions of its type {}", topic.name, topic.type),
          "import the recordings one by one, each into its own data set");
    }
  }
}

// The topics of all files, each once.
std::vector<BagTopic> all_topics(const std::vector<OpenBag>& bags) {
  std::vector<BagTopic> topics;
  for (const OpenBag& of : bags) {
    for (const BagTopic& topic : of.bag->topics()) {
      const auto known = std::find_if(topics.begin(), topics.end(),
                                      [&](const BagTopic& other) { return other.name == topic.name; });
      if (known == topics.end()) {
        topics.push_back(topic);
      } else {
        known->messages += topic.messages;
      }
    }
  }
  return topics;
}

}  // namespace

void import_bags(std::span<const std::filesystem::path> inputs, const ImportMap& map, Imported& out) {
  std::vector<OpenBag> bags;
  for (const std::filesystem::path& input : inputs)
    for (const std::filesystem::path& file : bag_files(input)) bags.push_back({file, open_bag(file)});
  // The files of one recording follow one another, in whatever order they were given.
  std::stable_sort(bags.begin(), bags.end(),
                   [](const OpenBag& a, const OpenBag& b) { return a.bag->begin_ns() < b.bag->begin_ns(); });
  const std::vector<BagTopic> topics = all_topics(bags);
  const std::filesystem::path& path = inputs.front();
  const std::vector<Source> sources = map.sources.empty() ? automatic_sources(path, topics) : map.sources;

  std::vector<Program> programs;
  std::multimap<std::string, std::size_t, std::less<>> programs_of;  // by topic
  std::vector<io::Dataset> parts(sources.size());                    // each source's rows
  for (const Source& source : sources) {
    const auto topic = std::find_if(topics.begin(), topics.end(),
                                    [&](const BagTopic& of) { return of.name == source.from; });
    if (topic == topics.end())
      throw io::ConfigError(source.place,
                            fmt::format("the recording has no topic {}", io::shown(source.from)),
                            fmt::format("its topics are {}", list_of(topics)));
    expect_one_type(bags, *topic);
    programs_of.emplace(topic->name, programs.size());
    programs.emplace_back(path, *topic, source);
  }
  for (const OpenBag& of : bags) {
    of.bag->read([&](std::size_t topic, std::uint64_t log_time_ns, std::string_view message) {
      const auto [begin, end] = programs_of.equal_range(of.bag->topics()[topic].name);
      for (auto program = begin; program != end; ++program)
        programs[program->second].take(log_time_ns, message, parts[program->second]);
    });
    if (const std::string damage = of.bag->damage(); !damage.empty())
      out.warnings.push_back(fmt::format("{}: {}", of.path.string(), damage));
  }
  for (std::size_t i = 0; i < programs.size(); ++i) {
    const std::size_t begin = begin_table(programs[i].table(), out);
    append(programs[i].table(), parts[i], out.dataset);
    if (programs[i].base_link())
      move_to_base_link(programs[i].table(), begin, *programs[i].base_link(), out.dataset);
    programs[i].finish(path, begin, out);
  }
}

}  // namespace groma::importer
