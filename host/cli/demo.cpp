// groma demo: the complete system on a simulated site.
#include "host/simulation/demo.hpp"

#include <fmt/format.h>

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>

#include <CLI/CLI.hpp>

#include "firmware/sim/world/built_in_scenarios.hpp"
#include "firmware/sim/world/scenario_file.hpp"
#include "host/cli/command.hpp"
#include "host/cli/demo_report.hpp"
#include "host/cli/emulation_option.hpp"
#include "host/cli/json.hpp"
#include "host/cli/live_site.hpp"
#include "host/cli/report_output.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/error.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"

namespace groma::cli {

namespace {

struct DemoOptions {
  std::uint64_t seed = 1;
  std::optional<std::filesystem::path> scenario;  // none: the source paper's hall
  EmulationChoice emulation;
  std::optional<std::filesystem::path> report;
  bool json = false;
  bool live = false;
  std::uint16_t port = kLivePort;
};

// A folder of its own for the time of the program.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::string name = (std::filesystem::temp_directory_path() / "groma-XXXXXX").string();
    if (::mkdtemp(name.data()) == nullptr)
      throw io::PathError({name}, "cannot be made", "name a folder with 'TMPDIR' that you may write to");
    path_ = name;
  }
  ~TemporaryFolder() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }
  TemporaryFolder(const TemporaryFolder&) = delete;
  TemporaryFolder& operator=(const TemporaryFolder&) = delete;

  [[nodiscard]] const std::filesystem::path& path() const noexcept { return path_; }

 private:
  std::filesystem::path path_;
};

int show_live(const DemoOptions& options, const sim::Scenario& scenario) {
  const TemporaryFolder folder;
  return run_live(
      endless(scenario),
      {.site = {.seed = options.seed, .image = chosen_image(options.emulation)}, .folder = folder.path()},
      options.port);
}

Json to_json(const simulation::DemoResult& result, std::uint64_t seed) {
  Json json{{"seed", seed}};
  Json calibration{{"verdict", nullptr}, {"wall_s", result.calibration_wall_s}};
  calibration.update(cli::to_json(result.calibration));
  for (std::size_t i = 0; i < result.anchor_errors_m.size(); ++i) {
    const double error_m = result.anchor_errors_m[i];
    calibration["anchors"][i]["error_m"] = std::isfinite(error_m) ? Json(error_m) : Json(nullptr);
  }
  json["calibration"] = std::move(calibration);
  for (const simulation::ModelRun& run : result.models) {
    json["evaluation"][std::string(filter::model_name(run.model))] = cli::to_json(run.evaluation);
  }
  json["ranges_per_s"] = result.ranges_per_s;
  json["without_sight"] = result.nlos_share;
  json["frames_lost"] = result.frames_lost;
  json["simulated_s"] = result.simulated_s;
  json["wall_s"] = result.wall_s;
  json["realtime_factor"] = result.wall_s > 0.0 ? result.simulated_s / result.wall_s : 0.0;
  return json;
}

std::string format_text(const simulation::DemoResult& result) {
  const model::Calibration& calibration = result.calibration.calibration;
  Table anchors({"anchor", "x m", "y m", "z m", "error m", "sigma m", "verdict"});
  double sum_m = 0.0;
  for (std::size_t i = 0; i < calibration.anchors.size(); ++i) {
    const model::AnchorCalibration& anchor = calibration.anchors[i];
    const bool known = anchor.covariance.rows() >= 3;
    const double sigma_m = known ? std::sqrt(anchor.covariance.topLeftCorner<3, 3>().trace()) : std::nan("");
    anchors.add({fmt::format("{}", anchor.id), fmt::format("{:.3f}", anchor.position_m.x()),
                 fmt::format("{:.3f}", anchor.position_m.y()), fmt::format("{:.3f}", anchor.position_m.z()),
                 fmt::format("{:.3f}", result.anchor_errors_m[i]), fmt::format("{:.3f}", sigma_m),
                 std::string(io::word(anchor.verdict))});
    sum_m += result.anchor_errors_m[i];
  }
  Table models({"model", "ATE mean m", "max m", "heading mean rad", "NEES mean", "inside 95 %"});
  for (const simulation::ModelRun& run : result.models) {
    const evaluation::Evaluation& evaluation = run.evaluation;
    const bool consistent = evaluation.nees.has_value();
    models.add({std::string(filter::model_name(run.model)), fmt::format("{:.3f}", evaluation.ate_m.mean),
                fmt::format("{:.3f}", evaluation.ate_m.max), fmt::format("{:.4f}", evaluation.ate_rad.mean),
                consistent ? fmt::format("{:.2f}", evaluation.nees->mean) : "-",
                consistent ? fmt::format("{:.0f} %", 100.0 * evaluation.nees->inside_95) : "-"});
  }
  std::string text =
      fmt::format("Calibration from the first drive ({:.0f} s, {} ranges): {}\n\n",
                  result.first_drive.ground_truth.back().t_s - result.first_drive.ground_truth.front().t_s,
                  result.calibration.ranges_used, io::word(calibration.verdict));
  text += anchors.format(true);
  if (!calibration.anchors.empty()) {
    text += fmt::format("mean error {:.3f} m\n", sum_m / static_cast<double>(calibration.anchors.size()));
  }
  text +=
      fmt::format("\nLocalization on the second drive ({:.0f} s)\n\n",
                  result.second_drive.ground_truth.back().t_s - result.second_drive.ground_truth.front().t_s);
  text += models.format();
  text += fmt::format(
      "\n{:.0f} ranges/s, {:.0f} % of them NLOS; {} frames lost\n"
      "{:.0f} s simulated in {:.1f} s: {:.1f} times real time\n",
      result.ranges_per_s, 100.0 * result.nlos_share, result.frames_lost, result.simulated_s, result.wall_s,
      result.simulated_s / result.wall_s);
  return text;
}

void write_report(const std::filesystem::path& folder, const sim::Scenario& scenario,
                  const simulation::DemoResult& result, std::uint64_t seed) {
  io::make_folder(folder);
  io::write_dataset(folder / "first_drive", result.first_drive);
  io::write_dataset(folder / "second_drive", result.second_drive);
  io::write_file(folder / "calibration.yaml", io::format_calibration(result.calibration.calibration));
  for (const simulation::ModelRun& run : result.models) {
    io::write_file(folder / fmt::format("estimate_{}.csv", filter::model_name(run.model)),
                   io::format_estimate(run.estimate));
  }
  write_page(folder, demo_report(scenario, result, seed), {});
}

int run(const DemoOptions& options) {
  if (options.report) io::make_folder(*options.report);
  const sim::Scenario scenario = options.scenario ? sim::read_scenario(*options.scenario) : sim::paper_hall();
  if (options.live) return show_live(options, scenario);
  if (scenario.drives.size() < 2) {
    throw io::DataError({*options.scenario}, "has one drive: there is none to calibrate on",
                        "describe two: the first calibrates, the second is localized");
  }
  simulation::DemoOptions demo;
  demo.site.seed = options.seed;
  demo.site.image = chosen_image(options.emulation);
  demo.progress = [](std::string_view phase, double done) { show_progress(phase, done); };
  simulation::DemoResult result = simulation::run_demo(scenario, demo);
  if (options.report) write_report(*options.report, scenario, result, options.seed);
  if (options.json) {
    say_json(to_json(result, options.seed));
  } else {
    say(format_text(result));
    if (options.report) say(fmt::format("report: {}\n", (*options.report / "report.html").string()));
  }
  return result.calibration.calibration.verdict == model::Verdict::kUnusable ? io::kBadData : io::kGood;
}

}  // namespace

void add_demo(CLI::App& app, Action& action) {
  const auto options = std::make_shared<DemoOptions>();
  CLI::App* command = app.add_subcommand("demo",
                                         "Run the complete system on a simulated site: tags and anchors run "
                                         "the "
                                         "firmware on a modelled radio and stream "
                                         "over pseudo-terminals; a first drive calibrates the anchors, a "
                                         "second is localized by every model and scored.");
  command->add_option("--seed", options->seed, "Determines every result except wall times")
      ->capture_default_str()
      ->type_name("N");
  command
      ->add_option("--scenario", options->scenario,
                   "Site, nodes, robot and radio as YAML, with two drives. Default: the source paper's hall")
      ->type_name("FILE");
  add_emulation_options(*command, options->emulation);
  CLI::Option* const report =
      command
          ->add_option("--report", options->report,
                       "Folder for report.html, the calibration, the estimates and both drives as data sets")
          ->type_name("DIR");
  CLI::Option* const json = command->add_flag("--json", options->json, "Print one JSON object");
  CLI::Option* const live =
      command
          ->add_flag("--live", options->live,
                     "Run the site in real time instead, with a gromad that serves its live page")
          ->excludes(report)
          ->excludes(json);
  command->add_option("--port", options->port, "TCP port of the live page")
      ->needs(live)
      ->check(CLI::Range(1, 65535))
      ->capture_default_str()
      ->type_name("N");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
