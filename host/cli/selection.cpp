#include "host/cli/selection.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <limits>
#include <set>
#include <string_view>
#include <system_error>

#include <CLI/CLI.hpp>

#include "host/cli/warnings.hpp"

namespace groma::cli {

namespace {

template <typename Number>
std::vector<Number> parse_list(const std::string& option, const std::string& text, std::string_view wanted) {
  std::vector<Number> values;
  const char* begin = text.data();
  const char* const end = begin + text.size();
  for (;;) {
    Number value{};
    const auto [last, error] = std::from_chars(begin, end, value);
    if (error != std::errc() || (last != end && *last != ',')) {
      throw CLI::ValidationError(option, fmt::format("'{}' is not {}", text, wanted));
    }
    values.push_back(value);
    if (last == end) return values;
    begin = last + 1;
  }
}

template <typename Sample>
void keep_between(std::vector<Sample>& samples, double from_s, double to_s) {
  std::erase_if(samples, [&](const Sample& sample) { return sample.t_s < from_s || sample.t_s > to_s; });
}

// The ids of the anchors that the run knows.
std::set<model::NodeId> anchors_of(const io::Dataset& dataset,
                                   std::span<const model::AnchorCalibration> calibrated) {
  std::set<model::NodeId> ids;
  for (const model::RangeSample& range : dataset.ranges) ids.insert(range.anchor_id);
  for (const model::Anchor& anchor : dataset.surveyed_anchors) ids.insert(anchor.id);
  for (const model::AnchorCalibration& anchor : calibrated) ids.insert(anchor.id);
  return ids;
}

std::set<model::NodeId> tags_of(const io::Dataset& dataset) {
  std::set<model::NodeId> ids;
  for (const model::Tag& tag : dataset.tags) ids.insert(tag.id);
  return ids;
}

void expect_known(const char* option, const char* what, const std::vector<model::NodeId>& chosen,
                  const std::set<model::NodeId>& known) {
  for (const model::NodeId id : chosen) {
    if (known.contains(id)) continue;
    throw CLI::ValidationError(
        option, fmt::format("there is no {} {}; the run has {}", what, id, fmt::join(known, ", ")));
  }
}

bool chosen(const std::vector<model::NodeId>& ids, model::NodeId id) {
  return ids.empty() || std::find(ids.begin(), ids.end(), id) != ids.end();
}

}  // namespace

std::vector<model::NodeId> parse_ids(const std::string& option, const std::string& text) {
  return parse_list<model::NodeId>(option, text, "a list of ids such as 1,2");
}

double parse_number(const std::string& option, const std::string& text, std::string_view unit) {
  double value = 0.0;
  const auto [last, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || last != text.data() + text.size() || !std::isfinite(value))
    throw CLI::ValidationError(option, fmt::format("'{}' is not a number; give {}", text, unit));
  return value;
}

std::vector<double> parse_numbers(const std::string& option, const std::string& text, std::size_t count) {
  const std::string wanted = fmt::format("{} numbers separated by commas", count);
  std::vector<double> values = parse_list<double>(option, text, wanted);
  const bool finite =
      std::all_of(values.begin(), values.end(), [](double value) { return std::isfinite(value); });
  if (values.size() != count || !finite)
    throw CLI::ValidationError(option, fmt::format("'{}' is not {}", text, wanted));
  return values;
}

void Selection::add_options(CLI::App& command) {
  const auto add_time = [&](const std::string& name, std::optional<double>& value, const std::string& help) {
    command
        .add_option_function<std::string>(
            name,
            [&value, name](const std::string& text) {
              value = parse_number(name, text, "seconds without a unit, such as 12.5");
            },
            help)
        ->type_name("S");
  };
  add_time("--from", from_s_, "Use the run from this t_s of the files on, in seconds");
  add_time("--to", to_s_, "Use the run up to this t_s of the files, in seconds");
  const auto add_ids = [&](const std::string& name, std::vector<model::NodeId>& ids,
                           const std::string& help) {
    command
        .add_option_function<std::string>(
            name, [&ids, name](const std::string& text) { ids = parse_ids(name, text); }, help)
        ->type_name("IDS");
  };
  add_ids("--tags", tags_, "Use only the ranges of these tags, such as 1,2");
  add_ids("--anchors", anchors_, "Use only the ranges to these anchors, such as 5,8,12,14");
  command.add_option("--section", section_, "Section of a log, from 1. Default: the last")->type_name("N");
}

void Selection::apply(io::Dataset& dataset, std::span<const model::AnchorCalibration> calibrated) const {
  if (section_ && !dataset.log) throw CLI::ValidationError("--section", "a data set folder has no sections");
  if (!section_ && dataset.log && dataset.log->sections > 1) {
    Warnings::note(fmt::format("the log has {} sections, and the last is used; --section chooses another",
                               dataset.log->sections));
  }
  expect_known("--tags", "tag", tags_, tags_of(dataset));
  expect_known("--anchors", "anchor", anchors_, anchors_of(dataset, calibrated));
  const double from_s = from_s_.value_or(-std::numeric_limits<double>::infinity());
  const double to_s = to_s_.value_or(std::numeric_limits<double>::infinity());
  if (!(from_s < to_s))
    throw CLI::ValidationError("--to", fmt::format("{} is not after --from {}", to_s, from_s));
  keep_between(dataset.ranges, from_s, to_s);
  keep_between(dataset.pose_prior, from_s, to_s);
  std::erase_if(dataset.ranges, [&](const model::RangeSample& range) {
    return !chosen(tags_, range.tag_id) || !chosen(anchors_, range.anchor_id);
  });
  std::erase_if(dataset.tags, [&](const model::Tag& tag) { return !chosen(tags_, tag.id); });
}

}  // namespace groma::cli
