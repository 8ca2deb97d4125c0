// groma surface fit: fits the surface of a site to measured heights.
#include <fmt/format.h>

#include <filesystem>
#include <iomanip>
#include <memory>
#include <optional>
#include <sstream>
#include <string>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/json.hpp"
#include "host/cli/terminal.hpp"
#include "host/help/help.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/input_file.hpp"
#include "host/io/output_file.hpp"
#include "host/io/site_description.hpp"

namespace groma::cli {

namespace {

struct FitCommand {
  std::string heights;
  std::string output;
  std::optional<double> spacing_m;
  std::optional<double> smoothing;
  bool json = false;
};

// As a description names it, in quotes: relative to its own folder where the file is beside it.
std::string described(const std::filesystem::path& file) {
  const std::filesystem::path path = std::filesystem::absolute(file).lexically_normal();
  std::ostringstream text;
  text << std::quoted(std::filesystem::exists(path.parent_path() / "dataset.yaml") ? path.filename().string()
                                                                                   : path.string());
  return text.str();
}

int run(const FitCommand& options) {
  io::expect_writable(options.output);
  const model::SurfaceFit fit = io::fit_heights(options.heights, io::read_file(options.heights),
                                                {options.spacing_m, options.smoothing});
  io::write_file(options.output, io::format_spline(fit.spline));
  const model::SurfaceMismatch& mismatch = fit.mismatch;
  if (options.json) {
    say_json(Json{{"points", fit.points},
                  {"spacing_m", fit.spacing_m},
                  {"smoothing", fit.smoothing},
                  {"nx", fit.spline.grid().nx},
                  {"ny", fit.spline.grid().ny},
                  {"rms_m", fit.rms_m},
                  {"max_m", fit.max_m},
                  {"held_out_rms_m", fit.held_out_rms_m},
                  {"empty_share", fit.empty_share},
                  {"gap_m", fit.gap_m},
                  {"gap_at_m", {fit.gap_at_m.x(), fit.gap_at_m.y()}},
                  {"mismatch",
                   {{"sigma_m", mismatch.sigma_m},
                    {"slope_sigma", mismatch.slope_sigma},
                    {"length_m", mismatch.length_m}}}});
    return io::kGood;
  }
  say(fmt::format("{} heights, a knot every {:.2f} m, smoothing {:g}: {} x {} control heights in {}\n",
                  fit.points, fit.spacing_m, fit.smoothing, fit.spline.grid().nx, fit.spline.grid().ny,
                  options.output));
  say(fmt::format("residuals: rms {:.4f} m, largest {:.3f} m; held out {:.4f} m\n", fit.rms_m, fit.max_m,
                  fit.held_out_rms_m));
  say(fmt::format("gaps: {:.0f} % of the cells have no height; ({:.1f}, {:.1f}) is {:.1f} m from any\n",
                  100.0 * fit.empty_share, fit.gap_at_m.x(), fit.gap_at_m.y(), fit.gap_m));
  say(
      fmt::format("surface: {{type: bspline, file: {}, mismatch: {{sigma_m: {:.4f}, slope_sigma: {:.4f}, "
                  "length_m: {:.2f}}}}}\n",
                  described(options.output), mismatch.sigma_m, mismatch.slope_sigma, mismatch.length_m));
  return io::kGood;
}

}  // namespace

void add_surface(CLI::App& app, Action& action) {
  CLI::App* surface = app.add_subcommand("surface", "The ground that the robot drives on.");
  surface->require_subcommand(1);
  const auto options = std::make_shared<FitCommand>();
  CLI::App* fit = surface->add_subcommand("fit",
                                          "Fit a smooth surface to heights that were measured, by a survey, "
                                          "a LiDAR or the robot's own poses, and "
                                          "print how far they differ from it.");
  fit->add_option("HEIGHTS", options->heights,
                  "Table with the columns x_m,y_m,z_m (such as groundtruth.csv), or a grid: a line "
                  "x0_m,y0_m,dx_m,dy_m,nx,ny, then nx rows of ny heights")
      ->required()
      ->type_name("FILE");
  fit->add_option("-o,--output", options->output,
                  "Spline to write, for 'surface: {type: bspline, file: ...}'")
      ->required()
      ->type_name("FILE");
  fit->add_option("--spacing", options->spacing_m,
                  "Metres between knots. Default: chosen by cross-validation")
      ->check(help::above_zero())
      ->type_name("M");
  fit->add_option("--smoothing", options->smoothing,
                  "Weight of the bending, without unit. Default: chosen by cross-validation")
      ->check(help::above_zero())
      ->type_name("W");
  fit->add_flag("--json", options->json, "Print one JSON object");
  fit->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
