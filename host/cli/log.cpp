// groma log: looks into the logs of gromad, and cuts them.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/io/log_file.hpp"
#include "host/io/output_file.hpp"

namespace groma::cli {

namespace {

struct LogOptions {
  std::filesystem::path log;
  double from_s = -std::numeric_limits<double>::infinity();
  double to_s = std::numeric_limits<double>::infinity();
  std::optional<std::size_t> section;
  std::filesystem::path output;
  bool json = false;
};

// A pose prior apart from the poses of other localization systems.
struct Prior {
  model::PoseSample pose;
};
struct Record {
  double order_s = 0.0;  // its time, or that of a record of its kind that came earlier if that is later
  std::variant<model::RangeSample, model::OdometrySample, Prior, model::SensorSample> sample;
};

// The samples of all kinds by time; those of one kind in the order of their arrival.
std::vector<Record> records_of(const io::LogSamples& samples, const LogOptions& options) {
  std::vector<Record> records;
  const auto add = [&](const auto& table, const auto& make) {
    double latest_s = -std::numeric_limits<double>::infinity();
    for (const auto& sample : table) {
      latest_s = std::max(latest_s, sample.t_s);
      if (sample.t_s >= options.from_s && sample.t_s <= options.to_s)
        records.push_back({latest_s, make(sample)});
    }
  };
  add(samples.ranges, [](const auto& sample) { return sample; });
  add(samples.odometry, [](const auto& sample) { return sample; });
  add(samples.poses, [](const auto& sample) { return Prior{sample}; });
  std::apply(
      [&](const auto&... tables) {
        (add(tables, [](const auto& sample) { return model::SensorSample(sample); }), ...);
      },
      samples.sensors);
  std::stable_sort(records.begin(), records.end(),
                   [](const Record& a, const Record& b) { return a.order_s < b.order_s; });
  return records;
}

io::LogContent read_log(const LogOptions& options, const std::string& bytes) {
  io::LogContent content = io::parse_log(bytes, options.section);
  const std::size_t count = content.sections.size();
  if (count == 0) throw io::DataError({options.log}, "is not a log", "give a log that gromad recorded");
  if (options.section && (*options.section < 1 || *options.section > count)) {
    throw io::DataError({options.log}, fmt::format("has no section {}", *options.section),
                        fmt::format("its sections are 1 to {}", count));
  }
  return content;
}

io::LogSection& chosen(io::LogContent& content, const LogOptions& options) {
  return content.sections[options.section.value_or(content.sections.size()) - 1];
}

void warn_of_damage(std::size_t damaged_bytes, Warnings& warnings) {
  if (damaged_bytes > 0)
    warnings.add(fmt::format("{} bytes of the log are damaged and were skipped", damaged_bytes));
}

// By hand: a source of odometry or ranges that is silent for longer is worth a look.
constexpr double kGap_s = 0.5;

struct KindInfo {
  std::string name;
  std::size_t count = 0;
  double from_s = 0.0;
  double to_s = 0.0;
  std::size_t gaps = 0;
  double longest_gap_s = 0.0;
  double longest_gap_at_s = 0.0;
};

template <typename Samples>
void add_kind(std::string_view name, const Samples& samples, std::vector<KindInfo>& out) {
  if (samples.empty()) return;
  std::vector<double> times_s;
  times_s.reserve(samples.size());
  for (const auto& sample : samples) times_s.push_back(sample.t_s);
  std::sort(times_s.begin(), times_s.end());
  KindInfo& info = out.emplace_back();
  info.name = name;
  info.count = times_s.size();
  info.from_s = times_s.front();
  info.to_s = times_s.back();
  for (std::size_t i = 1; i < times_s.size(); ++i) {
    const double gap_s = times_s[i] - times_s[i - 1];
    if (gap_s > kGap_s) ++info.gaps;
    if (gap_s <= info.longest_gap_s) continue;
    info.longest_gap_s = gap_s;
    info.longest_gap_at_s = times_s[i - 1];
  }
}

std::vector<KindInfo> kinds_of(const io::LogSamples& samples) {
  std::vector<KindInfo> kinds;
  add_kind("ranges", samples.ranges, kinds);
  add_kind("odometry", samples.odometry, kinds);
  add_kind("pose_prior", samples.poses, kinds);
  std::apply(
      [&]<class... Each>(const std::vector<Each>&... tables) {
        (add_kind(model::kSensorNames.at(model::kSensorOf<Each>), tables, kinds), ...);
      },
      samples.sensors);
  return kinds;
}

std::map<model::NodeId, std::size_t> count_by(const std::vector<model::RangeSample>& ranges,
                                              model::NodeId model::RangeSample::*id) {
  std::map<model::NodeId, std::size_t> counts;
  for (const model::RangeSample& range : ranges) ++counts[range.*id];
  return counts;
}

std::string date_of(std::uint64_t unix_time_ns) {
  const auto s = static_cast<std::time_t>(unix_time_ns / 1'000'000'000);
  std::tm parts{};
  ::gmtime_r(&s, &parts);
  return fmt::format("{:04}-{:02}-{:02}T{:02}:{:02}:{:02}Z", parts.tm_year + 1900, parts.tm_mon + 1,
                     parts.tm_mday, parts.tm_hour, parts.tm_min, parts.tm_sec);
}

double duration_of(const std::vector<KindInfo>& kinds) {
  if (kinds.empty()) return 0.0;
  const auto from = std::min_element(kinds.begin(), kinds.end(),
                                     [](const auto& a, const auto& b) { return a.from_s < b.from_s; });
  const auto to = std::max_element(kinds.begin(), kinds.end(),
                                   [](const auto& a, const auto& b) { return a.to_s < b.to_s; });
  return to->to_s - from->from_s;
}

Json section_json(const io::LogSection& section, std::size_t number) {
  const std::vector<KindInfo> kinds = kinds_of(section.samples);
  Json out{{"section", number},
           {"version", section.program_version},
           {"start", date_of(section.unix_time_ns)},
           {"duration_s", duration_of(kinds)},
           {"kinds", Json::array()},
           {"tags", Json::array()},
           {"anchors", Json::array()}};
  for (const KindInfo& kind : kinds) {
    out["kinds"].push_back({{"kind", kind.name},
                            {"count", kind.count},
                            {"from_s", kind.from_s},
                            {"to_s", kind.to_s},
                            {"gaps", kind.gaps},
                            {"longest_gap_s", kind.longest_gap_s},
                            {"longest_gap_at_s", kind.longest_gap_at_s}});
  }
  for (const auto& [id, count] : count_by(section.samples.ranges, &model::RangeSample::tag_id))
    out["tags"].push_back({{"id", id}, {"ranges", count}});
  for (const auto& [id, count] : count_by(section.samples.ranges, &model::RangeSample::anchor_id))
    out["anchors"].push_back({{"id", id}, {"ranges", count}});
  return out;
}

void say_section(const io::LogSection& section, std::size_t number) {
  const std::vector<KindInfo> kinds = kinds_of(section.samples);
  say(fmt::format("section {}: {}, gromad {}, {:.3f} s\n", number, date_of(section.unix_time_ns),
                  section.program_version, duration_of(kinds)));
  Table table({"", "count", "from (s)", "to (s)", "per s", "gaps > 0.5 s", "longest (s)", "at (s)"});
  for (const KindInfo& kind : kinds) {
    const double time_s = kind.to_s - kind.from_s;
    table.add({kind.name, fmt::format("{}", kind.count), fmt::format("{:.3f}", kind.from_s),
               fmt::format("{:.3f}", kind.to_s),
               time_s > 0.0 ? fmt::format("{:.1f}", static_cast<double>(kind.count) / time_s) : "",
               fmt::format("{}", kind.gaps), fmt::format("{:.3f}", kind.longest_gap_s),
               kind.longest_gap_s > 0.0 ? fmt::format("{:.3f}", kind.longest_gap_at_s) : ""});
  }
  say(table.format());
  Table nodes({"node", "ranges"});
  for (const auto& [id, count] : count_by(section.samples.ranges, &model::RangeSample::tag_id))
    nodes.add({fmt::format("tag {}", id), fmt::format("{}", count)});
  for (const auto& [id, count] : count_by(section.samples.ranges, &model::RangeSample::anchor_id))
    nodes.add({fmt::format("anchor {}", id), fmt::format("{}", count)});
  if (!section.samples.ranges.empty()) say(nodes.format());
}

int run_info(const LogOptions& options) {
  const std::string bytes = io::read_file(options.log);
  const io::LogContent last = read_log(options, bytes);
  Json sections = Json::array();
  for (std::size_t number = 1; number <= last.sections.size(); ++number) {
    const io::LogContent content = io::parse_log(bytes, number);
    if (options.json) {
      sections.push_back(section_json(content.sections[number - 1], number));
    } else {
      say_section(content.sections[number - 1], number);
    }
  }
  Warnings warnings;
  warn_of_damage(last.damaged_bytes, warnings);
  if (options.json)
    say_json(
        {{"bytes", bytes.size()}, {"damaged_bytes", last.damaged_bytes}, {"sections", std::move(sections)}});
  return warnings.exit_code();
}

std::vector<Record> chosen_records(const io::LogSection& section, const LogOptions& options) {
  std::vector<Record> records = records_of(section.samples, options);
  if (records.empty())
    throw io::DataError({options.log}, "there are no samples in the chosen time",
                        "choose another --from and --to");
  return records;
}

int run_cut(const LogOptions& options) {
  io::expect_writable(options.output);
  io::LogContent content = read_log(options, io::read_file(options.log));
  const io::LogSection& section = chosen(content, options);
  const std::vector<Record> records = chosen_records(section, options);
  io::LogEncoder encoder;
  encoder.begin_section(section.description, section.unix_time_ns);
  for (const Record& record : records) {
    std::visit(
        [&]<class Sample>(const Sample& sample) {
          if constexpr (std::is_same_v<Sample, Prior>)
            encoder.put(sample.pose);
          else
            encoder.put(sample);
        },
        record.sample);
  }
  encoder.flush();
  io::write_file(options.output, encoder.take());
  say(fmt::format("{} samples, written to {}\n", records.size(), options.output.string()));
  Warnings warnings;
  warn_of_damage(content.damaged_bytes, warnings);
  return warnings.exit_code();
}

Json pose_values(const model::PoseSample& pose) {
  Json out{
      {"t_s", pose.t_s}, {"x_m", pose.x_m}, {"y_m", pose.y_m}, {"z_m", pose.z_m}, {"yaw_rad", pose.yaw_rad}};
  if (std::isfinite(pose.roll_rad)) out["roll_rad"] = pose.roll_rad;
  if (std::isfinite(pose.pitch_rad)) out["pitch_rad"] = pose.pitch_rad;
  if (pose.covariance) out["covariance"] = *pose.covariance;
  return out;
}

Json range_values(const model::RangeSample& range) {
  Json out{{"t_s", range.t_s},
           {"tag_id", range.tag_id},
           {"anchor_id", range.anchor_id},
           {"range_m", range.range_m}};
  const auto add = [&](const char* key, float value) {
    if (std::isfinite(value)) out[key] = value;
  };
  add("first_path_power_dbm", range.first_path_power_dbm);
  add("receive_power_dbm", range.receive_power_dbm);
  add("clock_offset_ppm", range.clock_offset_ppm);
  add("noise", range.noise);
  if (range.line_of_sight != model::LineOfSight::kNotKnown)
    out["line_of_sight"] = static_cast<unsigned>(range.line_of_sight);
  if (range.corrections != 0) out["corrections"] = range.corrections;
  if (range.network_time_dtu != 0) out["network_time_dtu"] = range.network_time_dtu;
  return out;
}

std::pair<std::string_view, Json> sensor_json(const model::SensorSample& sample) {
  return std::visit(
      []<class Sample>(const Sample& of) -> std::pair<std::string_view, Json> {
        if constexpr (std::is_same_v<Sample, model::YawRateSample>) {
          return {"IMU", {{"t_s", of.t_s}, {"omega_radps", of.omega_radps}}};
        } else if constexpr (std::is_same_v<Sample, model::PositionSample>) {
          return {"GNSS",
                  {{"t_s", of.t_s}, {"x_m", of.x_m}, {"y_m", of.y_m}, {"covariance_m2", of.covariance_m2}}};
        } else if constexpr (std::is_same_v<Sample, model::PoseSample>) {
          return {"ABSOLUTE_POSE", pose_values(of)};
        } else {
          return {"ZERO_VELOCITY", {{"t_s", of.t_s}}};
        }
      },
      sample);
}

std::pair<std::string_view, Json> record_json(const Record& record) {
  return std::visit(
      []<class Sample>(const Sample& of) -> std::pair<std::string_view, Json> {
        if constexpr (std::is_same_v<Sample, model::RangeSample>) {
          return {"RANGE", range_values(of)};
        } else if constexpr (std::is_same_v<Sample, model::OdometrySample>) {
          return {"ODOMETRY",
                  {{"t_s", of.t_s},
                   {"vx_mps", of.vx_mps},
                   {"vy_mps", of.vy_mps},
                   {"omega_radps", of.omega_radps}}};
        } else if constexpr (std::is_same_v<Sample, Prior>) {
          return {"POSE_PRIOR", pose_values(of.pose)};
        } else {
          return sensor_json(of);
        }
      },
      record.sample);
}

int run_cat(const LogOptions& options) {
  io::LogContent content = read_log(options, io::read_file(options.log));
  for (const Record& record : chosen_records(chosen(content, options), options)) {
    const auto [name, values] = record_json(record);
    Json line{{"class", name}};
    line.update(values);
    say(line.dump() + '\n');
  }
  Warnings warnings;
  warn_of_damage(content.damaged_bytes, warnings);
  return warnings.exit_code();
}

using LogAction = int (*)(const LogOptions&);

CLI::App* add_part(CLI::App& log, const char* name, const char* description,
                   const std::shared_ptr<LogOptions>& options, LogAction run, Action& action) {
  CLI::App* command = log.add_subcommand(name, description);
  command->add_option("LOG", options->log, "Log that gromad recorded")->required()->type_name("FILE");
  command->callback([options, run, &action] { action = [options, run] { return run(*options); }; });
  return command;
}

void add_times(CLI::App& command, LogOptions& options) {
  command.add_option("--from", options.from_s, "Begin, t_s in seconds")->type_name("S");
  command.add_option("--to", options.to_s, "End, t_s in seconds")->type_name("S");
  command.add_option("--section", options.section, "Section of the log, from 1. Default: the last")
      ->type_name("N");
}

}  // namespace

void add_log(CLI::App& app, Action& action) {
  CLI::App* log = app.add_subcommand("log", "Look into a log of gromad, and cut it.");
  log->require_subcommand(1);
  const auto options = std::make_shared<LogOptions>();
  CLI::App* info =
      add_part(*log, "info", "Print duration, counts by kind and by node, rates and gaps of each section.",
               options, run_info, action);
  info->add_flag("--json", options->json, "Print one JSON object");
  CLI::App* cut =
      add_part(*log, "cut",
               "Write the measurements of an interval as a log. It contains no capture: groma replay "
               "reads it with a calibration.",
               options, run_cut, action);
  add_times(*cut, *options);
  cut->add_option("-o,--output", options->output, "Log to write")->required()->type_name("FILE");
  CLI::App* cat =
      add_part(*log, "cat", "Print measurements as JSON lines, by time.", options, run_cat, action);
  add_times(*cat, *options);
}

}  // namespace groma::cli
