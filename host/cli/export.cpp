// groma export: writes an estimate or a calibration in formats of other programs.
#include "host/convert/export.hpp"

#include <fmt/format.h>

#include <memory>
#include <optional>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"

namespace groma::cli {

namespace {

struct ExportOptions {
  std::filesystem::path input;
  std::string format;
  std::string datum;
  std::filesystem::path output;
};

std::optional<model::Datum> parse_datum(const ExportOptions& options) {
  if (options.datum.empty()) return std::nullopt;
  if (options.format != "geojson") throw CLI::ValidationError("--datum", "is for --format geojson");
  const std::vector<double> numbers = parse_numbers("--datum", options.datum, 3);
  const model::Datum datum{numbers[0], numbers[1], numbers[2]};
  if (!model::is_on_earth(datum))
    throw CLI::ValidationError("--datum", "has a latitude or longitude that does not exist");
  return datum;
}

std::string export_calibration(const ExportOptions& options, const std::optional<model::Datum>& datum) {
  const model::Calibration calibration = io::read_calibration(options.input);
  if (options.format == "csv") return convert::to_csv(calibration);
  if (options.format == "geojson") return convert::to_geojson(calibration, datum);
  throw io::DataError({options.input}, "is a calibration, and tum is a format of poses",
                      "give an estimate, or --format csv or geojson");
}

std::string export_poses(const ExportOptions& options, const std::optional<model::Datum>& datum) {
  const std::vector<convert::ExportPose> poses = convert::read_export_poses(options.input);
  if (options.format == "tum") return convert::to_tum(poses);
  if (options.format == "csv") return convert::to_csv(poses);
  return convert::to_geojson(poses, datum);
}

int run(const ExportOptions& options) {
  const std::optional<model::Datum> datum = parse_datum(options);
  io::expect_writable(options.output);
  const std::string extension = options.input.extension();
  const bool is_calibration = extension == ".yaml" || extension == ".yml";
  io::write_file(options.output,
                 is_calibration ? export_calibration(options, datum) : export_poses(options, datum));
  say(fmt::format("written to {}\n", options.output.string()));
  return io::kGood;
}

}  // namespace

void add_export(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ExportOptions>();
  CLI::App* command = app.add_subcommand(
      "export",
      "Write an estimate, another table of poses, or the anchors of a calibration for other programs.");
  command
      ->add_option(
          "ESTIMATE_OR_CALIBRATION", options->input,
          "Table that groma replay has written, table such as groundtruth.csv, or calibration (.yaml)")
      ->required()
      ->type_name("FILE");
  command
      ->add_option("--format", options->format,
                   "tum: lines of time, position and quaternion, for evo and others (poses alone); csv; "
                   "geojson: the path, or the anchors")
      ->required()
      ->check(CLI::IsMember(std::vector<std::string>{"tum", "csv", "geojson"}))
      ->type_name("NAME");
  command
      ->add_option(
          "--datum", options->datum,
          "Latitude, longitude and height (degrees and metres, WGS84) of the map's origin, for geojson; "
          "the map's x axis points east. Without it coordinates are the map's metres")
      ->type_name("LAT,LON,HEIGHT");
  command->add_option("-o,--output", options->output, "File to write")->required()->type_name("FILE");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
