// groma explain: what happened to the pose at a moment of a recorded drive.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/filter_input.hpp"
#include "host/cli/json.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/filter/replay.hpp"
#include "host/io/error.hpp"

namespace groma::cli {

namespace {

struct ExplainOptions {
  FilterInput input;
  std::string model{filter::model_name(filter::Config{}.model)};
  double at_s = 0.0;
  double window_s = 0.5;
};

// A range and the filter's result for it.
struct Heard {
  double t_s = 0.0;
  double range_m = 0.0;
  filter::RangeResult result;
  double regained_sigma_m = 0.0;  // see Gate::regained_variance_m2()
  bool doubts = false;            // the gate's divergence flag is set
};

struct StateAt {
  double t_s = 0.0;
  filter::State state = filter::State::kUninitialized;
  filter::Reason reason = filter::Reason::kNone;
};

// The filter after one odometry sample.
struct Moment {
  StateAt state;
  filter::Estimate estimate;
  double white_sigma_m = 0.0;
  double slow_sigma_m = 0.0;
  Eigen::Vector3d row_sigmas = Eigen::Vector3d::Zero();  // of the sample's vx, vy, yaw rate
  bool doubts = false;                                   // the gate's divergence flag
  // Counts up to this sample:
  std::size_t jumps = 0;  // samples that jumped
  std::size_t slips = 0;  // slips that the ranges showed
  std::size_t relocations = 0;
};

using Pair = std::pair<model::NodeId, model::NodeId>;  // tag, anchor

// All samples and ranges within the window.
struct Story {
  std::vector<Moment> rows;
  std::map<Pair, std::vector<Heard>> pairs;
  filter::Config told;
};

const char* outcome_word(filter::RangeOutcome outcome) {
  switch (outcome) {
    case filter::RangeOutcome::kUsed:
      return "used";
    case filter::RangeOutcome::kGated:
      return "gated";
    case filter::RangeOutcome::kUnknownTag:
      return "unknown-tag";
    case filter::RangeOutcome::kUnknownAnchor:
      return "unknown-anchor";
    case filter::RangeOutcome::kBadValue:
      return "bad-value";
    case filter::RangeOutcome::kOutOfOrder:
      return "out-of-order";
    case filter::RangeOutcome::kNotStarted:
      return "not-started";
    case filter::RangeOutcome::kNotActive:
      return "not-active";
    case filter::RangeOutcome::kNotModelled:
      break;
  }
  return "not-modelled";
}

bool was_judged(const Heard& heard) {
  return heard.result.outcome == filter::RangeOutcome::kUsed ||
         heard.result.outcome == filter::RangeOutcome::kGated;
}

// An innovation within kNear sigmas is no reason to reject a range; received powers that are kTelling times
// as likely under NLOS as under LOS are.
constexpr double kNear = 2.0;
constexpr double kTelling = 1.5;

// Why the gate accepted or rejected a range.
const char* why(const Heard& heard) {
  if (!was_judged(heard)) return outcome_word(heard.result.outcome);
  const double sigma_m = std::sqrt(heard.result.innovation_variance_m2);
  if (heard.result.weight >= 0.5) return heard.regained_sigma_m > sigma_m ? "heard-again" : "in-sight";
  if (heard.doubts) return "state-doubted";
  if (heard.result.hint_ratio > kTelling && std::abs(heard.result.innovation_m) < kNear * sigma_m)
    return "by-powers";
  return heard.result.innovation_m > 0.0 ? "blocked" : "too-short";
}

Eigen::Vector3d pull(const std::vector<Heard>& ranges) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const Heard& heard : ranges) sum += heard.result.pull;
  return sum;
}

std::size_t used(const std::vector<Heard>& ranges) {
  return static_cast<std::size_t>(std::count_if(ranges.begin(), ranges.end(), [](const Heard& heard) {
    return heard.result.outcome == filter::RangeOutcome::kUsed;
  }));
}

const Heard& nearest(const std::vector<Heard>& ranges, double t_s) {
  return *std::min_element(ranges.begin(), ranges.end(), [t_s](const Heard& a, const Heard& b) {
    return std::abs(a.t_s - t_s) < std::abs(b.t_s - t_s);
  });
}

// The last moment at or before t_s, else the first.
const Moment& moment_at(const Story& story, double t_s) {
  auto after = std::find_if(story.rows.begin(), story.rows.end(),
                            [t_s](const Moment& row) { return row.state.t_s > t_s; });
  return after == story.rows.begin() ? *after : *std::prev(after);
}

Moment moment_of(const filter::Tracker& tracker, const model::OdometrySample& row) {
  const filter::Filter& filter = tracker.filter().filter();
  const filter::Filter::Snapshot& now = filter.snapshot();
  return {.state = {row.t_s, tracker.state(), tracker.reason()},
          .estimate = filter.estimate(),
          .white_sigma_m = now.tuning.white_sigma_m(),
          .slow_sigma_m = std::sqrt(filter.site().slow_variance_m2()) * now.tuning.slow_scale(),
          .row_sigmas = filter.covariance().core().diagonal().segment<3>(filter::kRowVx).cwiseSqrt(),
          .doubts = now.gate.doubts(now.t_s),
          .jumps = now.watch.jumps(),
          .slips = now.counters.slips,
          .relocations = tracker.relocations()};
}

Story replay(const ExplainOptions& options, FilterInput::Drive& drive) {
  const double from_s = options.at_s - options.window_s;
  const double to_s = options.at_s + options.window_s;
  Story story;
  filter::ReplayOptions& replay = drive.options;
  replay.config.model = *filter::model_from_name(options.model);
  replay.config.range_delay_sigma_s = filter::kRangeDelaySigma_s;
  replay.config.odometry_delay_sigma_s = filter::kOdometryDelaySigma_s;
  replay.to_s = replay.to_s ? std::min(*replay.to_s, to_s) : to_s;
  replay.on_range = [&](const filter::Tracker& tracker, const model::RangeSample& range,
                        const filter::RangeResult& result) {
    if (range.t_s < from_s) return;
    Heard heard{.t_s = range.t_s, .range_m = range.range_m, .result = result};
    const filter::Filter& filter = tracker.filter().filter();
    const int anchor = filter.site().anchor_index(range.anchor_id);
    if (was_judged(heard) && filter.slot_of(anchor) >= 0) {
      const filter::Gate& gate = filter.snapshot().gate;
      heard.regained_sigma_m =
          std::sqrt(gate.regained_variance_m2(filter.slot_of(anchor), filter.site().tag_slot(range.tag_id)));
      heard.doubts = gate.doubts(range.t_s);
    }
    story.pairs[{range.tag_id, range.anchor_id}].push_back(heard);
  };
  replay.on_row = [&](const filter::Tracker& tracker, const model::OdometrySample& row) {
    if (row.t_s >= from_s && tracker.started()) story.rows.push_back(moment_of(tracker, row));
  };
  story.told = replay.config;
  if (filter::replay(drive.run(), replay).rows.empty() || story.rows.empty()) {
    throw io::DataError({options.input.dataset()},
                        fmt::format("there is no odometry, or no pose was known yet, within {} s of {}",
                                    options.window_s, options.at_s),
                        "choose another --at, or a wider --window");
  }
  return story;
}

std::vector<StateAt> changes(const Story& story) {
  std::vector<StateAt> out;
  for (const Moment& row : story.rows) {
    if (!out.empty() && out.back().state == row.state.state && out.back().reason == row.state.reason)
      continue;
    out.push_back(row.state);
  }
  return out;
}

std::string words(const StateAt& at) {
  const std::string_view reason = filter::reason_name(at.reason);
  return reason.empty() ? std::string(filter::state_name(at.state))
                        : fmt::format("{} ({})", filter::state_name(at.state), reason);
}

Json pose_json(const Eigen::Vector3d& pose) {
  return {{"x_m", pose.x()}, {"y_m", pose.y()}, {"yaw_rad", pose.z()}};
}

Json to_json(const StateAt& at) {
  const std::string_view reason = filter::reason_name(at.reason);
  return {{"t_s", at.t_s},
          {"state", filter::state_name(at.state)},
          {"reason", reason.empty() ? Json(nullptr) : Json(reason)}};
}

Json to_json(const Heard& heard) {
  Json json{{"t_s", heard.t_s},
            {"range_m", heard.range_m},
            {"outcome", outcome_word(heard.result.outcome)},
            {"why", why(heard)}};
  if (!was_judged(heard)) return json;
  json["predicted_m"] = heard.range_m - heard.result.innovation_m;
  json["innovation_m"] = heard.result.innovation_m;
  json["innovation_sigma_m"] = std::sqrt(heard.result.innovation_variance_m2);
  json["weight"] = heard.result.weight;
  json["pair_in_sight"] = 1.0 - heard.result.blocked;
  json["hint_ratio"] = heard.result.hint_ratio;
  json["heard_again_sigma_m"] = heard.regained_sigma_m;
  json["pull"] = pose_json(heard.result.pull);
  return json;
}

Json to_json(const ExplainOptions& options, const Story& story) {
  const Moment& moment = moment_at(story, options.at_s);
  const filter::Estimate& estimate = moment.estimate;
  Json covariance = Json::array();
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) covariance.push_back(estimate.covariance(i, j));
  }
  Json states = Json::array();
  for (const StateAt& at : changes(story)) states.push_back(to_json(at));
  Json pairs = Json::array();
  Eigen::Vector3d moved = Eigen::Vector3d::Zero();
  for (const auto& [pair, ranges] : story.pairs) {
    Json list = Json::array();
    for (const Heard& heard : ranges) list.push_back(to_json(heard));
    const Eigen::Vector3d by = pull(ranges);
    moved += by;
    pairs.push_back({{"tag", pair.first},
                     {"anchor", pair.second},
                     {"seen", ranges.size()},
                     {"used", used(ranges)},
                     {"why", why(nearest(ranges, options.at_s))},
                     {"pull", pose_json(by)},
                     {"ranges", std::move(list)}});
  }
  Json json = to_json(moment.state);
  json["model"] = options.model;
  json["window_s"] = options.window_s;
  json["pose"] = pose_json(Eigen::Vector3d(estimate.pose.x_m, estimate.pose.y_m, estimate.pose.theta_rad));
  json["pose"]["covariance"] = std::move(covariance);
  json["state_doubted"] = moment.doubts;
  json["states"] = std::move(states);
  json["relocations"] = story.rows.back().relocations - story.rows.front().relocations;
  json["odometry"] = {{"scale_error", estimate.scale_error},
                      {"yaw_rate_bias_radps", estimate.yaw_rate_bias_radps},
                      {"delay_s", estimate.odometry_delay_s},
                      {"jumps", story.rows.back().jumps - story.rows.front().jumps},
                      {"slips", story.rows.back().slips - story.rows.front().slips},
                      {"row_sigma_vx_mps", moment.row_sigmas.x()},
                      {"row_sigma_vy_mps", moment.row_sigmas.y()},
                      {"row_sigma_omega_radps", moment.row_sigmas.z()}};
  json["ranges"] = {{"white_sigma_m", moment.white_sigma_m},
                    {"slow_error_sigma_m", moment.slow_sigma_m},
                    {"delay_s", estimate.range_delay_s}};
  json["pull"] = pose_json(moved);
  json["pairs"] = std::move(pairs);
  return json;
}

// The pairs in order of their correction, the largest first.
std::string table_of(const ExplainOptions& options, const Story& story) {
  using Entry = std::pair<Pair, const std::vector<Heard>*>;
  std::vector<Entry> entries;
  entries.reserve(story.pairs.size());
  for (const auto& [pair, ranges] : story.pairs) entries.emplace_back(pair, &ranges);
  std::stable_sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) {
    return pull(*a.second).head<2>().norm() > pull(*b.second).head<2>().norm();
  });
  Table table({"tag", "anchor", "used", "range m", "predicted", "innovation", "sigma", "weight", "LOS",
               "hint", "correction x cm", "y cm", "heading mrad", "why"});
  for (const auto& [pair, ranges] : entries) {
    const Heard& heard = nearest(*ranges, options.at_s);
    const Eigen::Vector3d by = pull(*ranges);
    const bool judged = was_judged(heard);
    const auto number = [judged](const char* format, double value) {
      return judged ? fmt::format(fmt::runtime(format), value) : std::string("-");
    };
    table.add({fmt::format("{}", pair.first), fmt::format("{}", pair.second),
               fmt::format("{}/{}", used(*ranges), ranges->size()), fmt::format("{:.3f}", heard.range_m),
               number("{:.3f}", heard.range_m - heard.result.innovation_m),
               number("{:+.3f}", heard.result.innovation_m),
               number("{:.3f}", std::sqrt(heard.result.innovation_variance_m2)),
               number("{:.2f}", heard.result.weight), number("{:.2f}", 1.0 - heard.result.blocked),
               number("{:.1f}", heard.result.hint_ratio), fmt::format("{:+.1f}", 100.0 * by.x()),
               fmt::format("{:+.1f}", 100.0 * by.y()), fmt::format("{:+.1f}", 1000.0 * by.z()), why(heard)});
  }
  return table.format(true);
}

std::string text_of(const ExplainOptions& options, const Story& story) {
  const Moment& moment = moment_at(story, options.at_s);
  const filter::Estimate& estimate = moment.estimate;
  const auto sigma = [&](int i) { return std::sqrt(estimate.covariance(i, i)); };
  std::string out =
      fmt::format("{} s, {}: {}{}\n", moment.state.t_s, options.model, words(moment.state),
                  moment.doubts ? "; the ranges contradict the pose, its covariance grows" : "");
  out += fmt::format("pose      x {:.3f} +- {:.3f} m, y {:.3f} +- {:.3f} m, heading {:.4f} +- {:.4f} rad\n",
                     estimate.pose.x_m, sigma(0), estimate.pose.y_m, sigma(1), estimate.pose.theta_rad,
                     sigma(2));
  const std::size_t jumps = story.rows.back().jumps - story.rows.front().jumps;
  out += fmt::format(
      "odometry  sample +- {:.3f} m/s (configured {:.3f}), +- {:.4f} rad/s (configured {:.4f}); scale error "
      "{:+.4f}, yaw-rate bias {:+.5f} rad/s, delay {:.0f} ms{}\n",
      moment.row_sigmas.head<2>().maxCoeff(),
      std::max(story.told.odometry.sigma_vx_mps, story.told.odometry.sigma_vy_mps), moment.row_sigmas.z(),
      story.told.odometry.sigma_omega_radps, estimate.scale_error, estimate.yaw_rate_bias_radps,
      1000.0 * estimate.odometry_delay_s,
      jumps > 0 ? fmt::format("; {} samples jumped, their sigma is increased", jumps) : "");
  const std::size_t slips = story.rows.back().slips - story.rows.front().slips;
  if (slips > 0) {
    out += fmt::format(
        "          the ranges of several anchors contradict it ({} times): the wheels slip, or the robot is "
        "carried\n",
        slips);
  }
  out += fmt::format("ranges    white noise +- {:.3f} m, Gauss-Markov bias +- {:.3f} m, delay {:.0f} ms\n",
                     moment.white_sigma_m, moment.slow_sigma_m, 1000.0 * estimate.range_delay_s);
  const std::vector<StateAt> states = changes(story);
  for (std::size_t i = 1; i < states.size(); ++i)
    out += fmt::format("state     {} from {} s on\n", words(states[i]), states[i].t_s);
  if (story.rows.back().relocations > story.rows.front().relocations)
    out += "state     another place was found, and the filter re-initialized there\n";

  std::size_t seen = 0;
  std::size_t taken = 0;
  Eigen::Vector3d moved = Eigen::Vector3d::Zero();
  for (const auto& [pair, ranges] : story.pairs) {
    seen += ranges.size();
    taken += used(ranges);
    moved += pull(ranges);
  }
  out += fmt::format(
      "\nWithin {} s of {}: {} ranges, {} used; they corrected the pose by x {:+.1f} cm, y {:+.1f} cm, "
      "heading {:+.1f} mrad.\n",
      options.window_s, options.at_s, seen, taken, 100.0 * moved.x(), 100.0 * moved.y(), 1000.0 * moved.z());
  if (seen == 0) return out;
  out += "For each pair, the range nearest in time and the correction by all of its ranges:\n";
  return out + table_of(options, story);
}

int run(const ExplainOptions& options) {
  Warnings warnings;
  FilterInput::Drive drive = options.input.read("explain", FilterInput::StartIs::kFoundOtherwise, warnings);
  const Story story = replay(options, drive);
  if (options.input.json()) {
    say_json(to_json(options, story));
  } else {
    say(text_of(options, story));
  }
  return warnings.exit_code();
}

}  // namespace

void add_explain(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ExplainOptions>();
  CLI::App* command = app.add_subcommand(
      "explain",
      "Show what happened at a moment of a recorded drive: the filter's state and, for each tag and anchor, "
      "the measured and predicted range, its weight and its correction of the pose.");
  options->input.add_options(*command);
  options->input.add_relocation(*command);
  command->add_option("--at", options->at_s, "The moment, t_s of the drive")->required()->type_name("S");
  command->add_option("--window", options->window_s, "Use ranges within this time of it. Default: 0.5")
      ->check(CLI::PositiveNumber)
      ->type_name("S");
  std::vector<std::string> names;
  names.reserve(filter::kModels.size());
  for (const filter::Model model : filter::kModels) names.emplace_back(filter::model_name(model));
  command
      ->add_option("--model", options->model, fmt::format("As of groma replay. Default: {}", options->model))
      ->check(CLI::IsMember(std::move(names)))
      ->type_name("NAME");
  options->input.add_json(*command);
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
