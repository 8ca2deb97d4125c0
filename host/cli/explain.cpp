// groma explain: what happened to the pose at a moment of a recorded drive.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/filter_input.hpp"
#include "host/cli/json.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/filter/replay.hpp"
#include "host/help/help.hpp"
#include "host/io/error.hpp"

namespace groma::cli {

namespace {

struct ExplainOptions {
  FilterInput input;
  std::string model{filter::model_name(filter::Config{}.model)};
  double at_s = 0.0;
  double window_s = 0.5;
  ReportFolder report;
};

// A range and the filter's result for it.
struct RangeRecord {
  double t_s = 0.0;
  double range_m = 0.0;
  filter::RangeResult result;
  double regained_sigma_m = 0.0;  // see RangeResult
  bool diverged = false;          // the gate's divergence flag is set
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
  double bias_sigma_m = 0.0;
  Eigen::Vector3d sample_sigmas = Eigen::Vector3d::Zero();  // of the sample's vx, vy, yaw rate
  bool diverged = false;                                    // the gate's divergence flag
  // Counts up to this sample:
  std::size_t jumps = 0;  // samples that jumped
  std::size_t slips = 0;  // slips that the ranges showed
  std::size_t relocations = 0;
};

using Pair = std::pair<model::NodeId, model::NodeId>;  // tag, anchor

// All samples and ranges within the window.
struct History {
  std::vector<Moment> moments;
  std::map<Pair, std::vector<RangeRecord>> pairs;
  filter::Config configured;
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

bool reached_gate(const RangeRecord& record) {
  return record.result.outcome == filter::RangeOutcome::kUsed ||
         record.result.outcome == filter::RangeOutcome::kGated;
}

// An innovation within kNearSigmas sigmas is no reason to reject a range; received powers that are
// kNlosHintRatio times as likely under NLOS as under LOS are.
constexpr double kNearSigmas = 2.0;
constexpr double kNlosHintRatio = 1.5;

// Why the gate accepted or rejected a range.
const char* why(const RangeRecord& record) {
  if (!reached_gate(record)) return outcome_word(record.result.outcome);
  const double sigma_m = std::sqrt(record.result.innovation_variance_m2);
  if (record.result.weight >= 0.5) return record.regained_sigma_m > sigma_m ? "heard-again" : "in-sight";
  if (record.diverged) return "state-doubted";
  if (record.result.hint_ratio > kNlosHintRatio &&
      std::abs(record.result.innovation_m) < kNearSigmas * sigma_m)
    return "by-powers";
  return record.result.innovation_m > 0.0 ? "blocked" : "too-short";
}

Eigen::Vector3d correction(const std::vector<RangeRecord>& ranges) {
  Eigen::Vector3d sum = Eigen::Vector3d::Zero();
  for (const RangeRecord& record : ranges) sum += record.result.correction;
  return sum;
}

std::size_t used(const std::vector<RangeRecord>& ranges) {
  return static_cast<std::size_t>(std::count_if(ranges.begin(), ranges.end(), [](const RangeRecord& record) {
    return record.result.outcome == filter::RangeOutcome::kUsed;
  }));
}

const RangeRecord& nearest(const std::vector<RangeRecord>& ranges, double t_s) {
  return *std::min_element(ranges.begin(), ranges.end(), [t_s](const RangeRecord& a, const RangeRecord& b) {
    return std::abs(a.t_s - t_s) < std::abs(b.t_s - t_s);
  });
}

// The last moment at or before t_s, else the first.
const Moment& moment_at(const History& history, double t_s) {
  auto after = std::find_if(history.moments.begin(), history.moments.end(),
                            [t_s](const Moment& moment) { return moment.state.t_s > t_s; });
  return after == history.moments.begin() ? *after : *std::prev(after);
}

Moment moment_of(const filter::Tracker& tracker, const model::OdometrySample& sample) {
  const filter::Filter& filter = tracker.filter().filter();
  const filter::Filter::Snapshot& now = filter.snapshot();
  return {.state = {sample.t_s, tracker.state(), tracker.reason()},
          .estimate = filter.estimate(),
          .white_sigma_m = now.tuning.white_sigma_m(),
          .bias_sigma_m = std::sqrt(filter.site().range_bias_variance_m2),
          .sample_sigmas = filter.covariance().core().diagonal().segment<3>(filter::kOdometryVx).cwiseSqrt(),
          .diverged = now.gate.suspects_divergence(now.t_s),
          .jumps = now.watch.jumps(),
          .slips = now.counters.slips,
          .relocations = tracker.relocations()};
}

History replay(const ExplainOptions& options, FilterInput::Drive& drive) {
  const double from_s = options.at_s - options.window_s;
  const double to_s = options.at_s + options.window_s;
  History history;
  filter::ReplayOptions& replay = drive.options;
  replay.config.model = *filter::model_from_name(options.model);
  filter::set_unknown_delays(replay.config);
  replay.to_s = replay.to_s ? std::min(*replay.to_s, to_s) : to_s;
  replay.on_range = [&](const filter::Tracker& tracker, const model::RangeSample& range,
                        const filter::RangeResult& result) {
    if (range.t_s < from_s) return;
    RangeRecord record{.t_s = range.t_s, .range_m = range.range_m, .result = result};
    const filter::Filter& filter = tracker.filter().filter();
    if (reached_gate(record)) {
      record.regained_sigma_m = std::sqrt(result.regained_variance_m2);
      record.diverged = filter.snapshot().gate.suspects_divergence(range.t_s);
    }
    history.pairs[{range.tag_id, range.anchor_id}].push_back(record);
  };
  replay.on_odometry = [&](const filter::Tracker& tracker, const model::OdometrySample& sample) {
    if (sample.t_s >= from_s && tracker.started()) history.moments.push_back(moment_of(tracker, sample));
  };
  history.configured = replay.config;
  if (filter::replay(drive.run(), replay).rows.empty() || history.moments.empty()) {
    throw io::DataError({options.input.dataset()},
                        fmt::format("there is no odometry, or no pose was known yet, within {} s of {}",
                                    options.window_s, options.at_s),
                        "choose another --at, or a wider --window");
  }
  return history;
}

std::vector<StateAt> changes(const History& history) {
  std::vector<StateAt> out;
  for (const Moment& moment : history.moments) {
    if (!out.empty() && out.back().state == moment.state.state && out.back().reason == moment.state.reason)
      continue;
    out.push_back(moment.state);
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

Json to_json(const RangeRecord& record) {
  Json json{{"t_s", record.t_s},
            {"range_m", record.range_m},
            {"outcome", outcome_word(record.result.outcome)},
            {"why", why(record)}};
  if (!reached_gate(record)) return json;
  json["predicted_m"] = record.range_m - record.result.innovation_m;
  json["innovation_m"] = record.result.innovation_m;
  json["innovation_sigma_m"] = std::sqrt(record.result.innovation_variance_m2);
  json["weight"] = record.result.weight;
  json["pair_in_sight"] = 1.0 - record.result.nlos;
  json["hint_ratio"] = record.result.hint_ratio;
  json["heard_again_sigma_m"] = record.regained_sigma_m;
  json["pull"] = pose_json(record.result.correction);
  return json;
}

Json to_json(const ExplainOptions& options, const History& history) {
  const Moment& moment = moment_at(history, options.at_s);
  const filter::Estimate& estimate = moment.estimate;
  Json covariance = Json::array();
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) covariance.push_back(estimate.covariance(i, j));
  }
  Json states = Json::array();
  for (const StateAt& at : changes(history)) states.push_back(to_json(at));
  Json pairs = Json::array();
  Eigen::Vector3d moved = Eigen::Vector3d::Zero();
  for (const auto& [pair, ranges] : history.pairs) {
    Json list = Json::array();
    for (const RangeRecord& record : ranges) list.push_back(to_json(record));
    const Eigen::Vector3d by = correction(ranges);
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
  json["state_doubted"] = moment.diverged;
  json["states"] = std::move(states);
  json["relocations"] = history.moments.back().relocations - history.moments.front().relocations;
  json["odometry"] = {{"scale_error", estimate.scale_error},
                      {"yaw_rate_bias_radps", estimate.yaw_rate_bias_radps},
                      {"delay_s", estimate.odometry_delay_s},
                      {"jumps", history.moments.back().jumps - history.moments.front().jumps},
                      {"slips", history.moments.back().slips - history.moments.front().slips},
                      {"row_sigma_vx_mps", moment.sample_sigmas.x()},
                      {"row_sigma_vy_mps", moment.sample_sigmas.y()},
                      {"row_sigma_omega_radps", moment.sample_sigmas.z()}};
  json["ranges"] = {{"white_sigma_m", moment.white_sigma_m},
                    {"slow_error_sigma_m", moment.bias_sigma_m},
                    {"delay_s", estimate.range_delay_s}};
  json["pull"] = pose_json(moved);
  json["pairs"] = std::move(pairs);
  return json;
}

// The pairs in order of their correction, the largest first.
std::string table_of(const ExplainOptions& options, const History& history) {
  using Entry = std::pair<Pair, const std::vector<RangeRecord>*>;
  std::vector<Entry> entries;
  entries.reserve(history.pairs.size());
  for (const auto& [pair, ranges] : history.pairs) entries.emplace_back(pair, &ranges);
  std::stable_sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) {
    return correction(*a.second).head<2>().norm() > correction(*b.second).head<2>().norm();
  });
  Table table({"tag", "anchor", "used", "range m", "predicted", "innovation", "sigma", "weight", "LOS",
               "hint", "correction x cm", "y cm", "heading mrad", "why"});
  for (const auto& [pair, ranges] : entries) {
    const RangeRecord& record = nearest(*ranges, options.at_s);
    const Eigen::Vector3d by = correction(*ranges);
    const bool judged = reached_gate(record);
    const auto number = [judged](const char* format, double value) {
      return judged ? fmt::format(fmt::runtime(format), value) : std::string("-");
    };
    table.add({fmt::format("{}", pair.first), fmt::format("{}", pair.second),
               fmt::format("{}/{}", used(*ranges), ranges->size()), fmt::format("{:.3f}", record.range_m),
               number("{:.3f}", record.range_m - record.result.innovation_m),
               number("{:+.3f}", record.result.innovation_m),
               number("{:.3f}", std::sqrt(record.result.innovation_variance_m2)),
               number("{:.2f}", record.result.weight), number("{:.2f}", 1.0 - record.result.nlos),
               number("{:.1f}", record.result.hint_ratio), fmt::format("{:+.1f}", 100.0 * by.x()),
               fmt::format("{:+.1f}", 100.0 * by.y()), fmt::format("{:+.1f}", 1000.0 * by.z()), why(record)});
  }
  return table.format(true);
}

std::string text_of(const ExplainOptions& options, const History& history) {
  const Moment& moment = moment_at(history, options.at_s);
  const filter::Estimate& estimate = moment.estimate;
  const auto sigma = [&](int i) { return std::sqrt(estimate.covariance(i, i)); };
  std::string out =
      fmt::format("{} s, {}: {}{}\n", moment.state.t_s, options.model, words(moment.state),
                  moment.diverged ? "; the ranges contradict the pose, its covariance grows" : "");
  out += fmt::format("pose      x {:.3f} +- {:.3f} m, y {:.3f} +- {:.3f} m, heading {:.4f} +- {:.4f} rad\n",
                     estimate.pose.x_m, sigma(0), estimate.pose.y_m, sigma(1), estimate.pose.theta_rad,
                     sigma(2));
  const model::OdometryNoise& configured = history.configured.odometry;
  const std::size_t jumps = history.moments.back().jumps - history.moments.front().jumps;
  out += fmt::format(
      "odometry  sample +- {:.3f} m/s (configured {:.3f}), +- {:.4f} rad/s (configured {:.4f}); scale error "
      "{:+.4f}, yaw-rate bias {:+.5f} rad/s, delay {:.0f} ms{}\n",
      moment.sample_sigmas.head<2>().maxCoeff(), std::max(configured.sigma_vx_mps, configured.sigma_vy_mps),
      moment.sample_sigmas.z(), configured.sigma_omega_radps, estimate.scale_error,
      estimate.yaw_rate_bias_radps, 1000.0 * estimate.odometry_delay_s,
      jumps > 0 ? fmt::format("; {} samples jumped, their sigma is increased", jumps) : "");
  const std::size_t slips = history.moments.back().slips - history.moments.front().slips;
  if (slips > 0) {
    out += fmt::format(
        "          the ranges of several anchors contradict it ({} times): the wheels slip, or the robot is "
        "carried\n",
        slips);
  }
  out += fmt::format("ranges    white noise +- {:.3f} m, Gauss-Markov bias +- {:.3f} m, delay {:.0f} ms\n",
                     moment.white_sigma_m, moment.bias_sigma_m, 1000.0 * estimate.range_delay_s);
  const std::vector<StateAt> states = changes(history);
  for (std::size_t i = 1; i < states.size(); ++i)
    out += fmt::format("state     {} from {} s on\n", words(states[i]), states[i].t_s);
  if (history.moments.back().relocations > history.moments.front().relocations)
    out += "state     another place was found, and the filter re-initialized there\n";

  std::size_t seen = 0;
  std::size_t taken = 0;
  Eigen::Vector3d moved = Eigen::Vector3d::Zero();
  for (const auto& [pair, ranges] : history.pairs) {
    seen += ranges.size();
    taken += used(ranges);
    moved += correction(ranges);
  }
  out += fmt::format(
      "\nWithin {} s of {}: {} ranges, {} used; they corrected the pose by x {:+.1f} cm, y {:+.1f} cm, "
      "heading {:+.1f} mrad.\n",
      options.window_s, options.at_s, seen, taken, 100.0 * moved.x(), 100.0 * moved.y(), 1000.0 * moved.z());
  if (seen == 0) return out;
  out += "For each pair, the range nearest in time and the correction by all of its ranges:\n";
  return out + table_of(options, history);
}

void write_report(const ExplainOptions& options, const FilterInput::Drive& drive, const History& history) {
  filter::ReplayResult shown;
  for (const Moment& moment : history.moments) {
    const model::PlanarPose& pose = moment.estimate.pose;
    shown.rows.push_back({moment.state.t_s, pose.x_m, pose.y_m, pose.theta_rad, moment.estimate.covariance});
    shown.states.push_back({moment.state.state, moment.state.reason});
  }
  report::MomentView view{.at_s = options.at_s,
                          .rows = shown.rows,
                          .states = state_spans(shown),
                          .calibration = &drive.calibration};
  for (const auto& [pair, ranges] : history.pairs) {
    for (const RangeRecord& record : ranges) {
      const filter::RangeResult& result = record.result;
      view.ranges.push_back({.t_s = record.t_s,
                             .tag_id = pair.first,
                             .anchor_id = pair.second,
                             .range_m = record.range_m,
                             .innovation_m = result.innovation_m,
                             .sigma_m = reached_gate(record) ? std::sqrt(result.innovation_variance_m2)
                                                             : std::numeric_limits<double>::quiet_NaN(),
                             .weight = result.weight,
                             .correction = result.correction,
                             .why = why(record)});
    }
  }
  report::Page page(
      fmt::format("{} at {} s", drive.dataset.name, options.at_s),
      fmt::format("What the model {} did within {} s of that moment.", options.model, options.window_s));
  report::add_moment(page, view);
  write_page(*options.report, std::move(page), versions_of(drive.dataset, drive.calibration));
}

int run(const ExplainOptions& options) {
  prepare_report(options.report);
  Warnings warnings;
  FilterInput::Drive drive = options.input.read("explain", FilterInput::StartIs::kFoundOtherwise, warnings);
  const History history = replay(options, drive);
  if (options.report) write_report(options, drive, history);
  if (options.input.json()) {
    say_json(to_json(options, history));
  } else {
    say(text_of(options, history));
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
  command->add_option("--at", options->at_s, "The moment: t_s of the drive, in seconds")
      ->required()
      ->type_name("S");
  command
      ->add_option("--window", options->window_s,
                   "Use ranges at most this many seconds away from it. Default: 0.5")
      ->check(help::above_zero())
      ->type_name("S");
  std::vector<std::string> names;
  names.reserve(filter::kModels.size());
  for (const filter::Model model : filter::kModels) names.emplace_back(filter::model_name(model));
  command
      ->add_option("--model", options->model, fmt::format("As of groma replay. Default: {}", options->model))
      ->check(CLI::IsMember(std::move(names)))
      ->type_name("NAME");
  add_report_option(*command, options->report);
  options->input.add_json(*command);
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
