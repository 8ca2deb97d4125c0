// groma import: makes a data set of recordings of other programs.
#include "host/importer/import.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/error.hpp"

namespace groma::cli {

namespace {

struct ImportOptions {
  std::string format;
  std::vector<std::filesystem::path> inputs;
  std::filesystem::path map;
  std::filesystem::path output;
};

io::Dataset read_output(const std::filesystem::path& folder) {
  return io::read_dataset(folder, {.sensors = true,
                                   .pose_prior = std::filesystem::exists(folder / "pose_prior.csv"),
                                   .needs_pose_prior = false,
                                   .needs_tags = false});
}

// The data set that the folder already is, or an empty one.
io::Dataset base_of(const std::filesystem::path& folder) {
  if (std::filesystem::exists(folder / "dataset.yaml")) return read_output(folder);
  for (const std::string_view name : importer::kTableNames) {
    const std::filesystem::path path = folder / fmt::format("{}.csv", name);
    if (std::filesystem::exists(path))
      throw io::PathError({path}, "exists, and its folder is no data set", "give another folder");
  }
  io::Dataset dataset;
  dataset.name = std::filesystem::absolute(folder / ".").parent_path().filename();
  dataset.origin = "recorded";
  return dataset;
}

std::string list_of(const std::set<model::NodeId>& ids) {
  std::string list;
  for (const model::NodeId id : ids) list += fmt::format("{}{}", list.empty() ? "" : ",", id);
  return list;
}

std::string format_table(const importer::ImportedTable& imported, const io::Dataset& dataset) {
  std::string text =
      fmt::format("{}.csv: {} rows of {}", name_of(imported.table), imported.rows, imported.source);
  const std::vector<double> times_s = importer::times_of(imported.table, dataset);
  if (!times_s.empty()) {
    const auto [first, last] = std::minmax_element(times_s.begin(), times_s.end());
    text += fmt::format(", {:.3f} to {:.3f} s", *first, *last);
  }
  if (imported.table == importer::Table::kRanges) {
    std::set<model::NodeId> tags;
    std::set<model::NodeId> anchors;
    for (const model::RangeSample& range : dataset.ranges) {
      tags.insert(range.tag_id);
      anchors.insert(range.anchor_id);
    }
    text += fmt::format(", tags {}, anchors {}", list_of(tags), list_of(anchors));
  }
  return text + (imported.note.empty() ? "" : fmt::format(" ({})", imported.note)) + '\n';
}

std::string missing_tables(const io::Dataset& dataset) {
  std::string list;
  const auto add = [&](bool is_missing, std::string_view name) {
    if (is_missing) list += fmt::format("{}{}", list.empty() ? "" : ", ", name);
  };
  add(dataset.ranges.empty(), "ranges");
  add(dataset.tags.empty(), "tags");
  add(dataset.odometry.empty(), "odometry");
  add(dataset.ground_truth.empty() && dataset.pose_prior.empty(), "poses");
  return list;
}

int run(const ImportOptions& options) {
  const auto format = static_cast<importer::Format>(
      std::find(importer::kFormatNames.begin(), importer::kFormatNames.end(), options.format) -
      importer::kFormatNames.begin());
  const importer::ImportMap map =
      options.map.empty() ? importer::ImportMap() : importer::read_import_map(options.map, format);
  const importer::Imported imported =
      importer::import_files(format, options.inputs, map, base_of(options.output));
  io::write_dataset(options.output, imported.dataset);

  Warnings warnings;
  for (const std::string& warning : imported.warnings) warnings.add(warning);
  warnings.add(read_output(options.output).dropped);
  for (const importer::ImportedTable& table : imported.tables) say(format_table(table, imported.dataset));
  say(fmt::format("written to {}\n", options.output.string()));
  const std::string missing = missing_tables(imported.dataset);
  if (!missing.empty())
    say(fmt::format("not there yet: {}; import them into the same folder\n", missing));
  else
    say(fmt::format("next: groma check {}\n", options.output.string()));
  return warnings.exit_code();
}

}  // namespace

void add_import(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ImportOptions>();
  CLI::App* command = app.add_subcommand("import",
                                         "Make a data set of recordings of other programs: tables in any "
                                         "layout, trajectories, rosbag2, MAT files. What the "
                                         "inputs contain is added to the data set, if it exists.");
  command->add_option("FORMAT", options->format, "Format of the inputs")
      ->required()
      ->check(CLI::IsMember(
          std::vector<std::string>(importer::kFormatNames.begin(), importer::kFormatNames.end())));
  command
      ->add_option("INPUT", options->inputs,
                   "Files; of rosbag2 (MCAP or SQLite) also folders; of KITTI the poses, then their times")
      ->required()
      ->type_name("FILE");
  command
      ->add_option("--map", options->map,
                   "YAML file: which column or field is which, units, tags, surface; by default what the "
                   "names of columns and the types of messages say")
      ->type_name("FILE");
  command->add_option("-o,--output", options->output, "Data set folder to write")
      ->required()
      ->type_name("DIR");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
