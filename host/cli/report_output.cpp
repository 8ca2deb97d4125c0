#include "host/cli/report_output.hpp"

#include <fmt/chrono.h>
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <ctime>
#include <iterator>
#include <limits>
#include <string_view>
#include <utility>

#include "host/io/output_file.hpp"
#include "host/model/pose.hpp"
#include "host/model/range_model.hpp"

namespace groma::cli {

namespace {

constexpr const char* kReportName = "report.html";
constexpr std::size_t kDigits = 12;  // of a digest

std::string& command_line() {
  static std::string line;
  return line;
}

// As a shell needs it.
std::string quoted(std::string_view argument) {
  constexpr std::string_view kPlain =
      "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789_-+=.,:/@%";
  if (!argument.empty() && argument.find_first_not_of(kPlain) == std::string_view::npos)
    return std::string(argument);
  std::string text = "'";
  for (const char c : argument) text += c == '\'' ? std::string("'\\''") : std::string(1, c);
  return text + "'";
}

// Interpolated at t_s, which is within the poses' times.
model::PlanarPose pose_at(std::span<const model::PlanarEstimate> poses, double t_s) {
  const auto next =
      std::lower_bound(poses.begin(), poses.end(), t_s,
                       [](const model::PlanarEstimate& pose, double t) { return pose.t_s < t; });
  if (next == poses.begin()) return {next->x_m, next->y_m, next->yaw_rad};
  const model::PlanarEstimate& before = *std::prev(next);
  const double share = (t_s - before.t_s) / (next->t_s - before.t_s);
  return {before.x_m + share * (next->x_m - before.x_m), before.y_m + share * (next->y_m - before.y_m),
          before.yaw_rad + share * model::wrap_angle(next->yaw_rad - before.yaw_rad)};
}

// As calibrated, else as configured; null: unknown.
const Eigen::Vector3d* lever_arm_of(const filter::Run& run, model::NodeId tag) {
  for (const model::TagCalibration& of : run.calibration->tags) {
    if (of.id == tag && of.lever_arm) return &of.lever_arm->position_m;
  }
  const auto found =
      std::find_if(run.tags.begin(), run.tags.end(), [tag](const model::Tag& of) { return of.id == tag; });
  return found == run.tags.end() ? nullptr : &found->lever_arm_m;
}

const model::PairBias* pair_of(const model::AnchorCalibration& anchor, model::NodeId tag) {
  const auto found = std::find_if(anchor.pairs.begin(), anchor.pairs.end(),
                                  [tag](const model::PairBias& pair) { return pair.tag_id == tag; });
  return found == anchor.pairs.end() ? nullptr : &*found;
}

}  // namespace

void note_command_line(std::span<char* const> arguments) {
  std::string& line = command_line();
  line = "groma";
  for (const char* argument : arguments.subspan(std::min<std::size_t>(1, arguments.size())))
    line += " " + quoted(argument);
}

void add_report_option(CLI::App& command, ReportFolder& folder) {
  command.add_option("--report", folder, "Folder for a report, report.html, to open in a browser")
      ->type_name("DIR");
}

void prepare_report(const ReportFolder& folder) {
  if (!folder) return;
  io::make_folder(*folder);
  io::expect_writable(*folder / kReportName);
}

void write_page(const std::filesystem::path& folder, report::Page page,
                std::vector<std::pair<std::string, std::string>> versions) {
  page.set_provenance({.command = command_line(),
                       .date = fmt::format("{:%Y-%m-%d %H:%M} UTC", fmt::gmtime(std::time(nullptr))),
                       .versions = std::move(versions)});
  io::write_file(folder / kReportName, page.html());
}

std::string version_of(const model::Calibration& calibration) {
  return fmt::format("by groma {} from input {}", calibration.program_version,
                     calibration.input_sha256.substr(0, kDigits));
}

std::vector<std::pair<std::string, std::string>> versions_of(const io::Dataset& dataset,
                                                             const model::Calibration& calibration) {
  std::vector<std::pair<std::string, std::string>> versions{
      {"input", fmt::format("{}, SHA-256 {}", dataset.name, dataset.sha256.substr(0, kDigits))}};
  if (!calibration.program_version.empty()) versions.emplace_back("calibration", version_of(calibration));
  return versions;
}

void record_ranges(filter::ReplayOptions& options, std::vector<report::RangeRow>& rows) {
  options.on_range = [&rows, first = std::move(options.on_range)](const filter::Tracker& tracker,
                                                                  const model::RangeSample& range,
                                                                  const filter::RangeResult& result) {
    if (first) first(tracker, range, result);
    if (result.outcome != filter::RangeOutcome::kUsed && result.outcome != filter::RangeOutcome::kGated)
      return;
    rows.push_back({.t_s = range.t_s,
                    .tag_id = range.tag_id,
                    .anchor_id = range.anchor_id,
                    .range_m = range.range_m,
                    .innovation_m = result.innovation_m,
                    .sigma_m = std::sqrt(result.innovation_variance_m2),
                    .weight = result.weight,
                    .correction = result.correction});
  };
}

std::vector<report::StateSpan> state_spans(const filter::ReplayResult& result) {
  std::vector<report::StateSpan> spans;
  for (std::size_t i = 0; i < result.rows.size(); ++i) {
    const double t_s = result.rows[i].t_s;
    const std::string_view state = filter::state_name(result.states[i].state);
    const std::string_view reason = filter::reason_name(result.states[i].reason);
    if (!spans.empty()) spans.back().to_s = t_s;
    if (spans.empty() || spans.back().state != state || spans.back().reason != reason)
      spans.push_back({t_s, t_s, std::string(state), std::string(reason)});
  }
  return spans;
}

std::vector<model::PoseSample> truth_of(const std::filesystem::path& dataset) {
  const std::filesystem::path path = dataset / "groundtruth.csv";
  if (!std::filesystem::exists(path)) return {};
  io::DroppedRows dropped;
  return io::read_poses(path, dropped);
}

std::vector<report::RangeRow> residuals(const filter::Run& run, const smoother::Result& result) {
  const std::span<const model::PlanarEstimate> poses = result.rows;
  std::vector<report::RangeRow> rows;
  if (run.surface->chart_count() > 1 || poses.empty()) return rows;
  for (const auto& [range, weight] : result.ranges) {
    const double t_s = range.t_s - result.range_delay_s;
    const model::AnchorCalibration* anchor = model::find_anchor(*run.calibration, range.anchor_id);
    const Eigen::Vector3d* lever_arm_m = lever_arm_of(run, range.tag_id);
    if (t_s < poses.front().t_s || t_s > poses.back().t_s || anchor == nullptr || lever_arm_m == nullptr)
      continue;
    const model::PairBias* pair = pair_of(*anchor, range.tag_id);
    if (pair == nullptr || !model::has_position(*anchor)) continue;
    const model::RangePrediction predicted =
        model::predict_range(model::pose_on_surface(*run.surface, pose_at(poses, t_s)).pose, *lever_arm_m,
                             anchor->position_m, model::values_of(*pair));
    rows.push_back({.t_s = range.t_s,
                    .tag_id = range.tag_id,
                    .anchor_id = range.anchor_id,
                    .range_m = range.range_m,
                    .innovation_m = range.range_m - predicted.range_m,
                    .sigma_m = std::numeric_limits<double>::quiet_NaN(),
                    .weight = weight});
  }
  return rows;
}

}  // namespace groma::cli
