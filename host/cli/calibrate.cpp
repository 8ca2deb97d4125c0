// groma calibrate: anchor positions and pair biases from one drive.
#include "host/calibration/calibrate.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/calibration/comparison.hpp"
#include "host/cli/clock_fix.hpp"
#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/diagnosis/diagnose.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"
#include "host/io/version.hpp"
#include "host/report/calibration_report.hpp"
#include "host/report/page.hpp"

namespace groma::cli {

namespace {

struct CalibrateOptions {
  std::filesystem::path dataset;
  std::optional<std::filesystem::path> poses;
  std::optional<std::filesystem::path> survey;
  Selection selection;
  bool known_anchors = false;
  bool fix = false;
  std::optional<std::filesystem::path> update;
  ReportFolder report;
  std::filesystem::path output;
  bool json = false;
};

std::string format_table(const model::Calibration& calibration) {
  Table table({"anchor", "x m", "y m", "z m", "sigma xy m", "sigma z m", "ranges", "held out m", "mirror",
               "verdict"});
  const auto number = [](double value) { return std::isfinite(value) ? fmt::format("{:.3f}", value) : "-"; };
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    const bool known = anchor.covariance.rows() >= 3;
    const double nan = std::nan("");
    const double sigma_xy_m =
        known ? std::sqrt(std::max(anchor.covariance(0, 0), anchor.covariance(1, 1))) : nan;
    const double sigma_z_m = known ? std::sqrt(anchor.covariance(2, 2)) : nan;
    std::string verdict(io::word(anchor.verdict));
    if (!anchor.advice.empty()) verdict += ": " + anchor.advice;
    table.add({fmt::format("{}", anchor.id), number(anchor.position_m.x()), number(anchor.position_m.y()),
               number(anchor.position_m.z()), number(sigma_xy_m), number(sigma_z_m),
               fmt::format("{}", anchor.ranges_used), number(anchor.held_out_rms_m.value_or(nan)),
               number(anchor.mirror_ratio.value_or(nan)), verdict});
  }
  return table.format(true);
}

void write_report(const std::filesystem::path& folder, const io::Dataset& dataset,
                  const calibration::Drive& drive, const calibration::Result& result) {
  report::Page page(
      fmt::format("Calibration from {}", dataset.name),
      fmt::format("Anchor positions and range biases, estimated from one {} drive.", dataset.origin));
  report::add_calibration(page, drive, result);
  write_page(folder, std::move(page), versions_of(dataset, {}));
}

// Takes over the updated calibration and reorders the fitted ranges; anchors that were only kept have none.
void adopt(const calibration::Update& update, calibration::Result& result) {
  std::map<model::NodeId, std::vector<calibration::FittedRange>> fitted;
  for (std::size_t i = 0; i < result.fitted.size(); ++i) {
    fitted[result.calibration.anchors[i].id] = std::move(result.fitted[i]);
  }
  result.calibration = update.calibration;
  result.fitted.clear();
  for (const model::AnchorCalibration& anchor : update.calibration.anchors) {
    result.fitted.push_back(std::move(fitted[anchor.id]));
  }
}

Json update_json(const calibration::Update& update) {
  Json json{{"moved", Json::array()}, {"added", update.added}, {"kept", update.kept}};
  for (const calibration::AnchorChange& change : update.comparison.anchors) {
    if (!change.moved) continue;
    const Eigen::Vector3d& d = change.displacement_m;
    json["moved"].push_back({{"id", change.id},
                             {"displacement_m", {d.x(), d.y(), d.z()}},
                             {"distance_m", d.norm()},
                             {"chi2", change.chi2}});
  }
  return json;
}

std::string format_update(const calibration::Update& update) {
  std::string text;
  for (const calibration::AnchorChange& change : update.comparison.anchors) {
    if (change.moved)
      text += fmt::format("anchor {} moved by {:.2f} m\n", change.id, change.displacement_m.norm());
  }
  if (!update.added.empty()) text += fmt::format("new: {}\n", fmt::join(update.added, ", "));
  if (!update.kept.empty()) text += fmt::format("kept without a range: {}\n", fmt::join(update.kept, ", "));
  return text;
}

// A prior of the biases that all pairs together contradict: it pulls the anchors' positions, or with
// --known-anchors the biases, by more than their sigmas say.
void note_contradicted_priors(const model::Calibration& calibration, const model::RangePriors& priors) {
  // Statistics: within the prior the rms is 1 at most; by hand: leaves room for an anchor with a bias of its
  // own.
  constexpr double kMostSigmas = 3.0;
  for (const model::PairTerm& term : model::kPairTerms) {
    const model::ScalarPrior& prior = priors.*term.prior;
    double sum = 0.0;
    double off = 0.0;
    double count = 0.0;
    for (const model::AnchorCalibration& anchor : calibration.anchors) {
      for (const model::PairBias& pair : anchor.pairs) {
        // The ranges of the others say less of the term than the prior does.
        if (!(pair.*term.sigma < 0.7 * prior.sigma)) continue;
        off += pair.*term.value - prior.mean;
        sum += std::pow((pair.*term.value - prior.mean) / prior.sigma, 2);
        count += 1.0;
      }
    }
    const double rms = count > 0.0 ? std::sqrt(sum / count) : 0.0;
    if (rms < kMostSigmas) continue;
    Warnings::note(fmt::format(
        "{0} of the pairs is {1:.1f} sigmas from its prior [{2:g}, {3:g}], on average {4:.4g}; if the prior "
        "is too narrow for these radios, write {0}: [{2:g}, {5:g}] in dataset.yaml and calibrate again",
        term.key.value, rms, prior.mean, prior.sigma, prior.mean + off / count, 10.0 * prior.sigma));
  }
}

int run(const CalibrateOptions& options) {
  const auto begin = std::chrono::steady_clock::now();
  if (options.update && options.known_anchors) {
    throw CLI::ValidationError("--update", "cannot be combined with --known-anchors");
  }
  io::expect_writable(options.output);
  prepare_report(options.report);
  io::ReadOptions read;
  read.surveyed_anchors = options.known_anchors;
  read.odometry = !std::filesystem::is_directory(options.dataset);  // a folder's is for the diagnosis alone
  read.ground_truth = false;
  read.pose_file = options.poses;
  read.log_section = options.selection.section();
  std::optional<model::Calibration> earlier;
  if (options.update) earlier = io::read_calibration(*options.update);
  io::Dataset dataset = io::read_dataset(options.dataset, read);
  Warnings warnings;
  std::vector<model::AnchorRange> survey;
  if (options.survey) survey = io::read_survey(*options.survey, dataset.dropped);
  if (!read.odometry) dataset.odometry = io::read_odometry(options.dataset, dataset.dropped);
  warnings.add(dataset);
  if (options.known_anchors && dataset.surveyed_anchors.empty()) {
    throw io::DataError({options.dataset / "anchors.csv"}, "there are no surveyed anchors",
                        "add them, or calibrate without --known-anchors");
  }
  options.selection.apply(dataset);
  const std::vector<diagnosis::Finding> findings = diagnosis::diagnose(diagnosis::data_of(dataset));
  for (const diagnosis::Finding& finding : findings) warnings.add(finding);
  const std::optional<model::ClockError> range_clock =
      options.fix ? fix_clock(findings, dataset.ranges, warnings) : std::nullopt;

  calibration::Drive drive;
  drive.ranges = dataset.ranges;
  drive.poses = dataset.pose_prior;
  drive.tags = dataset.tags;
  drive.surface = &dataset.surface;
  drive.priors = dataset.range_priors;
  drive.anchor_ranges = survey;
  if (options.known_anchors) drive.known_anchors = dataset.surveyed_anchors;
  calibration::Options how;
  if (earlier) how.earlier = &*earlier;
  calibration::Result result = calibration::calibrate(drive, how);
  result.calibration.range_clock = range_clock;
  note_contradicted_priors(result.calibration, dataset.range_priors);
  const auto unfixed = findings.begin() + (range_clock ? 1 : 0);
  const std::vector<diagnosis::Finding> left(unfixed, findings.end());
  const diagnosis::Finding* contradiction = diagnosis::find_contradiction(left);
  if (contradiction != nullptr) diagnosis::mark_contradicted(*contradiction, result.calibration);
  std::optional<calibration::Update> update;
  if (earlier) {
    update = calibration::update(*earlier, result.calibration, dataset.range_priors);
    adopt(*update, result);
  }
  result.calibration.input_sha256 = dataset.sha256;
  result.calibration.program_version = io::program_version();
  io::write_file(options.output, io::format_calibration(result.calibration));
  if (options.report) write_report(*options.report, dataset, drive, result);
  const double wall_s = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();

  if (options.json) {
    Json json{{"verdict", io::word(result.calibration.verdict)}, {"wall_s", wall_s}};
    json["diagnosis"] = diagnosis::to_json(findings);
    json.update(cli::to_json(result));
    if (update) json["update"] = update_json(*update);
    json["dropped"] = cli::to_json(dataset.dropped);
    say_json(json);
  } else {
    say(format_table(result.calibration));
    if (update) say(format_update(*update));
    say(fmt::format("{}: {} ranges used, {} rejected, {:.2f} s; written to {}\n",
                    io::word(result.calibration.verdict), result.ranges_used, result.ranges_rejected, wall_s,
                    options.output.string()));
  }
  switch (result.calibration.verdict) {
    case model::Verdict::kUsable:
      break;
    case model::Verdict::kWarnings:
      warnings.add(
          fmt::format("{}: some anchors are not as good as they should be; see their verdicts and advice",
                      options.output.string()));
      break;
    case model::Verdict::kUnusable:
      complain(fmt::format(
          "{}: the calibration is not usable; see the anchors' verdicts and advice, and drive again",
          options.output.string()));
      return io::kBadData;
  }
  return warnings.exit_code();
}

}  // namespace

void add_calibrate(CLI::App& app, Action& action) {
  const auto options = std::make_shared<CalibrateOptions>();
  CLI::App* command = app.add_subcommand(
      "calibrate",
      "Estimate the anchors' positions and the pairs' range biases from one drive of a robot that knows its "
      "own poses. The last fifth of the drive is held out for the verdict; the final solution uses all of "
      "it.");
  command
      ->add_option(
          "DATASET_OR_LOG", options->dataset,
          "Folder of the drive (dataset.yaml, ranges.csv, tags.csv, poses), or the log that gromad recorded")
      ->required()
      ->type_name("DATASET_OR_LOG");
  command
      ->add_option("--poses", options->poses,
                   "Poses to calibrate from, instead of pose_prior.csv (or, without it, groundtruth.csv)")
      ->type_name("FILE");
  command
      ->add_option(
          "--survey", options->survey,
          "Ranges between the anchors, as groma survey prints them: all anchors are then solved in one "
          "problem")
      ->type_name("FILE");
  options->selection.add_options(*command);
  command->add_flag(
      "--known-anchors", options->known_anchors,
      "Take the positions of anchors.csv as surveyed (sigma 0.02 m) and estimate only the biases");
  add_clock_fix(*command, options->fix);
  command
      ->add_option(
          "--update", options->update,
          "Update this earlier calibration: anchors that did not move are combined with it, moved ones "
          "are reported, new ones added")
      ->type_name("FILE");
  command->add_option("-o,--output", options->output, "Calibration file to write (YAML)")
      ->required()
      ->type_name("FILE");
  add_report_option(*command, options->report);
  command->add_flag("--json", options->json, "Print one JSON object");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
