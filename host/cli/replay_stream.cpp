#include "host/cli/replay_stream.hpp"

#include <fmt/chrono.h>
#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cstddef>
#include <ctime>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "host/cli/json.hpp"
#include "host/cli/terminal.hpp"
#include "host/cli/warnings.hpp"
#include "host/daemon/capture.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/input_file.hpp"
#include "host/io/output_file.hpp"
#include "host/io/version.hpp"

namespace groma::cli {

namespace {

using daemon::ReplayedSection;

Json to_json(const ReplayedSection& section) {
  return {{"program_version", section.program_version},
          {"build", section.build.empty() ? Json(nullptr) : Json(section.build)},
          {"unix_time_s", static_cast<double>(section.unix_time_ns) * 1e-9},
          {"duration_s", section.duration_s},
          {"poses", section.poses},
          {"digests", section.digests},
          {"same", section.digests > 0 && !section.differs_from_s},
          {"differs_from_s", section.differs_from_s ? Json(*section.differs_from_s) : Json(nullptr)}};
}

std::string result_of(const ReplayedSection& section) {
  if (!section.has_snapshot) return "no snapshot, not replayed";
  if (!section.is_of_this_build) return "of another build, not replayed";
  if (section.differs_from_s) return fmt::format("differs from second {:.0f} on", *section.differs_from_s);
  return section.digests > 0 ? "same" : "no digest";
}

void list(std::size_t number, const ReplayedSection& section) {
  const auto time = static_cast<std::time_t>(section.unix_time_ns / 1'000'000'000U);
  say(fmt::format("section {}: {:%Y-%m-%d %H:%M:%S} UTC, {:.1f} s, version {}, {} poses: {}\n", number,
                  fmt::gmtime(time), section.duration_s, section.program_version, section.poses,
                  result_of(section)));
}

void expect_replayed(const StreamOptions& options, const std::vector<ReplayedSection>& sections) {
  if (options.section && (*options.section < 1 || *options.section > sections.size())) {
    throw io::DataError({options.capture}, fmt::format("has no section {}", *options.section),
                        fmt::format("its sections are 1 to {}", sections.size()));
  }
  const auto replayed = [](const ReplayedSection& of) { return of.has_snapshot && of.is_of_this_build; };
  if (std::any_of(sections.begin(), sections.end(), replayed)) return;
  const bool has_other = std::any_of(sections.begin(), sections.end(),
                                     [](const ReplayedSection& of) { return !of.is_of_this_build; });
  if (!has_other) {
    throw io::DataError({options.capture}, "has no snapshot of gromad's state",
                        "replay it with --calibration FILE and -o FILE");
  }
  throw io::DataError({options.capture},
                      fmt::format("was recorded by the build {}, and this is {}",
                                  io::shown(sections.back().build), io::build_name()),
                      "replay it with the same build, or with --calibration FILE and -o FILE");
}

}  // namespace

int replay_stream(const StreamOptions& options) {
  io::expect_writable(options.output);
  const std::string capture = io::read_file(options.capture);
  std::string lines;
  daemon::StreamReplay replay = daemon::replay_stream(
      capture, options.section,
      {.on_pose = [&lines](const daemon::PoseEstimate&, std::string_view line) { lines += line; }});
  expect_replayed(options, replay.sections);
  io::write_file(options.output, lines);

  Warnings warnings;
  if (replay.damaged_bytes > 0)
    warnings.add(fmt::format("{} bytes of the capture are damaged", replay.damaged_bytes));
  Json listed = Json::array();
  bool differs = false;
  std::map<std::string, std::vector<std::size_t>> left_out;  // numbers of sections by the reason
  for (std::size_t i = 0; i < replay.sections.size(); ++i) {
    if (options.section && i + 1 != *options.section) continue;
    const ReplayedSection& section = replay.sections[i];
    differs = differs || section.differs_from_s.has_value();
    listed.push_back(to_json(section));
    listed.back()["section"] = i + 1;
    if (!options.json) list(i + 1, section);
    if (!section.has_snapshot || !section.is_of_this_build) left_out[result_of(section)].push_back(i + 1);
  }
  for (const auto& [why, numbers] : left_out)
    warnings.add(
        fmt::format("section{} {}: {}", numbers.size() > 1 ? "s" : "", fmt::join(numbers, ", "), why));
  const auto poses = std::count(lines.begin(), lines.end(), '\n');
  if (options.json) {
    say_json(Json{{"poses", poses}, {"same", !differs}, {"sections", listed}});
  } else {
    say(fmt::format("{} POSE lines, written to {}: {}\n", poses, options.output.string(),
                    differs ? "not those that went out" : "same as those that went out"));
  }
  return differs ? io::kBadData : warnings.exit_code();
}

}  // namespace groma::cli
