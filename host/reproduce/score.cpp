#include "host/reproduce/score.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <utility>

#include "host/filter/replay.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/error.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"
#include "host/provision/process.hpp"

namespace groma::reproduce {

namespace {

bool contains(const std::vector<model::NodeId>& ids, model::NodeId id) {
  return ids.empty() || std::find(ids.begin(), ids.end(), id) != ids.end();
}

std::int64_t now_ns() {
  return std::chrono::duration_cast<std::chrono::nanoseconds>(
             std::chrono::steady_clock::now().time_since_epoch())
      .count();
}

Json to_json(double max, double mean, double std) {
  return {{"max", max}, {"mean", mean}, {"std", std}};
}

// Whether the next point of a curve is due at t_s.
class EachStep {
 public:
  explicit EachStep(double step_s) : step_s_(step_s) {}
  [[nodiscard]] bool is_due(double t_s) {
    if (t_s < next_s_) return false;
    next_s_ = t_s + step_s_ - 1e-9;
    return true;
  }

 private:
  double step_s_;
  double next_s_ = -std::numeric_limits<double>::infinity();
};

template <class Row, class ToJson>
Json points_of(const std::vector<Row>& rows, double step_s, const ToJson& to_json) {
  Json out = Json::array();
  EachStep step(step_s);
  for (const Row& row : rows) {
    if (step.is_due(row.t_s)) out.push_back(to_json(row));
  }
  return out;
}

}  // namespace

std::optional<filter::ReplayOptions> replay_options(const io::Dataset& drive, filter::Model model) {
  const auto start =
      filter::start_from_prior(drive.pose_prior, -std::numeric_limits<double>::infinity(), drive.surface);
  if (!start) return std::nullopt;
  filter::ReplayOptions options;
  options.start = *start;
  options.config.model = model;
  options.config.odometry = drive.odometry_noise;
  options.config.range_sigma_m = drive.range_priors.sigma_m;
  filter::set_unknown_delays(options.config);
  return options;
}

Localized localize(const io::Dataset& drive, const model::Calibration& calibration, filter::Model model,
                   const Subset& subset) {
  std::vector<model::RangeSample> ranges;
  std::copy_if(drive.ranges.begin(), drive.ranges.end(), std::back_inserter(ranges),
               [&](const model::RangeSample& range) {
                 return contains(subset.tags, range.tag_id) && contains(subset.anchors, range.anchor_id);
               });
  std::optional<filter::ReplayOptions> options = replay_options(drive, model);
  if (!options) return {};
  options->now_ns = now_ns;
  filter::ReplayResult result =
      filter::replay({drive.odometry, ranges, drive.tags, &drive.surface, &calibration, nullptr}, *options);
  return {.rows = std::move(result.rows),
          .ranges = result.counters.ranges[filter::RangeOutcome::kUsed],
          .update_ns = result.update_ns.p50,
          .propagate_ns = result.propagate_ns.p50};
}

Json score(const std::vector<model::PlanarEstimate>& rows, const std::vector<model::PoseSample>& truth) {
  const auto scored = evaluation::evaluate(evaluation::pose_errors(rows, truth));
  if (!scored) return nullptr;
  const auto of = [](const auto& statistics) {
    return to_json(statistics.max, statistics.mean, statistics.std);
  };
  return {{"ate_m", of(scored->ate_m)},
          {"ate_rad", of(scored->ate_rad)},
          {"nees", scored->nees ? of(*scored->nees) : Json(nullptr)}};
}

Json error_curve(const std::vector<model::PlanarEstimate>& rows, const std::vector<model::PoseSample>& truth,
                 double step_s) {
  Json out = Json::array();
  EachStep step(step_s);
  for (const evaluation::PoseError& error : evaluation::pose_errors(rows, truth)) {
    if (!step.is_due(error.t_s)) continue;
    out.push_back({error.t_s, std::hypot(error.x_m, error.y_m), std::abs(error.yaw_rad),
                   error.nees ? Json(*error.nees) : Json(nullptr)});
  }
  return out;
}

Json path_of(const std::vector<model::PlanarEstimate>& rows, double step_s) {
  return points_of(rows, step_s, [](const auto& row) { return Json{row.x_m, row.y_m, row.t_s}; });
}

Json path_of(const std::vector<model::PoseSample>& rows, double step_s) {
  return points_of(rows, step_s, [](const auto& row) { return Json{row.x_m, row.y_m, row.t_s}; });
}

Json ellipses_of(const std::vector<model::PlanarEstimate>& rows, double step_s) {
  return points_of(rows, step_s, [](const auto& row) {
    return Json{row.x_m, row.y_m, row.covariance(0, 0), row.covariance(0, 1), row.covariance(1, 1)};
  });
}

Baselines::Baselines() {
  std::error_code error;
  const std::filesystem::path own = std::filesystem::read_symlink("/proc/self/exe", error);
  program_ = provision::find_program((own.parent_path() / "groma-baselines").string());
}

std::vector<Baselines::Estimate> Baselines::run(const io::Dataset& drive,
                                                const model::Calibration& calibration,
                                                const std::vector<std::string>& methods, const Subset& subset,
                                                bool is_tuned, const std::filesystem::path& scratch) const {
  const std::filesystem::path data = scratch / "drive";
  const std::filesystem::path file = scratch / "calibration.yaml";
  io::write_dataset(data, drive);
  io::write_file(file, io::format_calibration(calibration));
  std::vector<std::string> arguments{program_->string(),
                                     "run",
                                     data.string(),
                                     "--calibration",
                                     file.string(),
                                     "--methods",
                                     fmt::format("{}", fmt::join(methods, ",")),
                                     "--output",
                                     scratch.string(),
                                     "--plane",
                                     "0",
                                     "--json"};
  const auto add = [&](const char* option, const std::vector<model::NodeId>& ids) {
    if (!ids.empty()) arguments.insert(arguments.end(), {option, fmt::format("{}", fmt::join(ids, ","))});
  };
  add("--tags", subset.tags);
  add("--anchors", subset.anchors);
  if (is_tuned) arguments.emplace_back("--tuned");
  std::vector<Estimate> out;
  const provision::ProcessResult result = provision::run_process(arguments, [&](std::string_view line) {
    Json facts = Json::parse(line, nullptr, false);
    if (facts.is_object()) out.push_back({.rows = {}, .facts = std::move(facts)});
  });
  const bool has_run = result.exit_code == io::kGood || result.exit_code == io::kDoneWithWarnings;
  if (!has_run || out.size() != methods.size()) {
    throw io::DeviceError({*program_}, fmt::format("ended with {}: {}", result.exit_code, result.output),
                          "build groma and groma-baselines from one commit");
  }
  for (Estimate& estimate : out)
    estimate.rows = io::read_estimate(estimate.facts.at("estimate").get<std::string>());
  return out;
}

}  // namespace groma::reproduce
