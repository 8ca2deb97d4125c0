#include "host/daemon/reload.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <set>
#include <utility>

#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"

namespace groma::daemon {
namespace {

bool is_from_file(const CalibrationSource& source) {
  return source.file && !source.learn;
}

bool has_same_tags(const Config& a, const Config& b) {
  return std::equal(a.tags.begin(), a.tags.end(), b.tags.begin(), b.tags.end(),
                    [](const model::Tag& one, const model::Tag& other) { return one.id == other.id; });
}

// Whether this top-level key, which has changed, may change while gromad runs.
bool is_live(const std::string& key, const Config& current, const Config& next) {
  if (!is_from_file(current.calibration) || !is_from_file(next.calibration)) return false;
  return key == "calibration" || (key == "tags" && has_same_tags(current, next));
}

// The configuration's place comes first where the error has no line.
std::string placed(const io::Error& error, const io::FilePlace& place) {
  return error.place().line > 0 ? error.what() : fmt::format("{}: {}", io::to_string(place), error.what());
}

std::vector<std::string> texts_of(const std::vector<ConfigProblem>& problems) {
  std::vector<std::string> texts;
  texts.reserve(problems.size());
  for (const ConfigProblem& problem : problems) texts.push_back(problem.text);
  return texts;
}

// Adds the error to `problems` instead of throwing it.
std::optional<model::Calibration> load_calibration(const ConfigReading& reading,
                                                   std::vector<std::string>& problems) {
  const auto place = reading.places.find("calibration");
  if (place == reading.places.end()) return std::nullopt;
  try {
    return load_calibration(reading.config.calibration);
  } catch (const io::Error& error) {
    problems.push_back(placed(error, place->second));
    return std::nullopt;
  }
}

}  // namespace

std::optional<model::Calibration> load_calibration(const CalibrationSource& source) {
  // With `learn`, the same path for `file` and `output` need not exist at the first start.
  const bool starts_without =
      source.learn && source.file == source.output && source.file && !std::filesystem::exists(*source.file);
  if (!source.file || starts_without) return std::nullopt;
  model::Calibration calibration = io::read_calibration(*source.file);
  if (calibration.verdict == model::Verdict::kUnusable) {
    throw io::DataError({*source.file}, "its verdict is 'unusable'", "drive and calibrate again");
  }
  return calibration;
}

std::vector<std::string> check_config(const std::filesystem::path& path) {
  const ConfigReading reading = parse_config(path);
  std::vector<std::string> problems = texts_of(reading.problems);
  static_cast<void>(load_calibration(reading, problems));
  if (reading.config.web) {
    try {
      static_cast<void>(read_secrets(*reading.config.web));
    } catch (const io::Error& error) {
      problems.push_back(fmt::format("{}: {}", io::to_string(reading.places.at("web")), error.what()));
    }
  }
  return problems;
}

Reload prepare_reload(const Config& current, const std::string& frame) {
  ConfigReading reading = parse_config(current.path);
  Reload out;
  out.problems = texts_of(reading.problems);
  if (!out.problems.empty()) return out;
  std::set<std::string> keys;
  for (const auto& values : {current.values, reading.config.values}) {
    for (const auto& [key, value] : values) keys.insert(key);
  }
  const auto value_in = [](const Config& config, const std::string& key) {
    const auto found = config.values.find(key);
    return found == config.values.end() ? std::string() : found->second;
  };
  for (const std::string& key : keys) {
    if (value_in(current, key) == value_in(reading.config, key) || is_live(key, current, reading.config))
      continue;
    const auto place = reading.places.find(key);
    out.problems.push_back(fmt::format(
        "{}: {} has changed; restart gromad for it, or restore its value",
        io::to_string(place == reading.places.end() ? io::FilePlace{current.path} : place->second), key));
  }
  if (!is_from_file(current.calibration)) return out;
  out.calibration = load_calibration(reading, out.problems);
  if (out.calibration && out.calibration->frame != frame) {
    out.problems.push_back(fmt::format("{}: its frame is {}, not {}; restart gromad to change the map",
                                       reading.config.calibration.file->string(),
                                       io::shown(out.calibration->frame), io::shown(frame)));
  }
  out.config = std::move(reading.config);
  return out;
}

}  // namespace groma::daemon
