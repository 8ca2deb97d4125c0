// groma convert: writes a recorded drive as an MCAP file.
#include "host/convert/convert.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <filesystem>
#include <limits>
#include <memory>
#include <string_view>
#include <utility>

#include <CLI/CLI.hpp>

#include "host/cli/command.hpp"
#include "host/cli/filter_input.hpp"
#include "host/cli/replay_summary.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/daemon/capture.hpp"
#include "host/daemon/ros2_status.hpp"
#include "host/filter/replay.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"
#include "host/io/output_file.hpp"

namespace groma::cli {

namespace {

struct ConvertOptions {
  FilterInput input;
  bool ros2 = false;
};

convert::Converted convert_drive(const ConvertOptions& options, convert::Recording recording) {
  const Selection& selection = options.input.selection();
  recording.from_s = selection.from_s().value_or(-std::numeric_limits<double>::infinity());
  recording.to_s = selection.to_s().value_or(std::numeric_limits<double>::infinity());
  return convert::to_mcap(recording, options.ros2 ? convert::Format::kRos2 : convert::Format::kFoxglove);
}

// With the estimates of the filter, as groma replay computes them.
convert::Converted convert_with_estimates(const ConvertOptions& options, Warnings& warnings) {
  FilterInput::Drive drive = options.input.read("convert", FilterInput::StartIs::kFoundOtherwise, warnings);
  filter::set_unknown_delays(drive.options.config);
  const filter::ReplayResult result = filter::replay(drive.run(), drive.options);
  options.input.expect_finite(result.rows, result.spatial);
  FilterInput::warn_of_mismatch(result, warnings);
  FilterInput::warn_of_ranges(result.counters, warnings);
  FilterInput::warn_of_samples(result.counters, warnings);
  warn_of(summarize(result, drive.options.config.model), warnings);
  if (result.rows.empty()) {
    warnings.add("there are no poses: no start was found from priors, ranges and motion");
  } else if (result.counters.ranges[filter::RangeOutcome::kUsed] == 0) {
    FilterInput::warn_without_ranges(result.ranges_seen, warnings);
  }
  return convert_drive(options,
                       {.dataset = &drive.dataset, .calibration = &drive.calibration, .result = &result});
}

// The poses that gromad sent, if the input is a capture.
void add_sent(const ConvertOptions& options, convert::Recording& recording, Warnings& warnings) {
  const std::filesystem::path& path = options.input.dataset();
  if (!std::filesystem::is_regular_file(path)) return;
  const daemon::StreamReplay replay = daemon::replay_stream(
      io::read_file(path), options.input.selection().section(),
      {.on_pose =
           [&](const daemon::PoseEstimate& pose, std::string_view) {
             recording.sent.push_back(
                 {daemon::localization_of(pose), pose.roll_rad, pose.pitch_rad, pose.yaw_rad});
           },
       .on_calibration =
           [&](const model::Calibration& calibration) { recording.used.push_back(calibration); }});
  const auto is_foreign = [](const daemon::ReplayedSection& section) { return !section.is_of_this_build; };
  if (std::any_of(replay.sections.begin(), replay.sections.end(), is_foreign))
    warnings.add("poses were left out: another build of gromad recorded them; give --calibration");
}

convert::Converted convert_input(const ConvertOptions& options, Warnings& warnings) {
  const io::Dataset dataset = options.input.read_drive(warnings);
  convert::Recording recording{.dataset = &dataset};
  add_sent(options, recording, warnings);
  return convert_drive(options, std::move(recording));
}

int run(const ConvertOptions& options) {
  io::expect_writable(options.input.output());
  Warnings warnings;
  const convert::Converted converted = options.input.has_calibration()
                                           ? convert_with_estimates(options, warnings)
                                           : convert_input(options, warnings);
  if (converted.without_timestamp > 0) {
    warnings.add(fmt::format("{} samples were left out: their t_s is not within 0 to 2147483647 s",
                             converted.without_timestamp));
  }
  if (converted.messages == 0) {
    throw io::DataError({options.input.dataset()}, "there are no samples in the chosen time",
                        "choose another --from and --to");
  }
  io::write_file(options.input.output(), converted.bytes);
  say(fmt::format("{} messages of {} topics, written to {}\n", converted.messages, converted.topics,
                  options.input.output().string()));
  return warnings.exit_code();
}

}  // namespace

void add_convert(CLI::App& app, Action& action) {
  const auto options = std::make_shared<ConvertOptions>();
  CLI::App* command = app.add_subcommand(
      "convert",
      "Write a recorded drive as an MCAP file: for Foxglove and Lichtblick, or with --ros2 for ROS 2. With a "
      "calibration it contains the poses that groma replay computes; a capture without one, those that "
      "gromad "
      "sent.");
  options->input.add_options(*command);
  options->input.add_relocation(*command);
  command->add_flag("--ros2", options->ros2,
                    "Messages of ROS 2 (CDR), for 'ros2 bag play', instead of those of Foxglove (protobuf)");
  options->input.add_output_file(*command, "MCAP file to write");
  command->callback([options, &action] { action = [options] { return run(*options); }; });
}

}  // namespace groma::cli
