#include "host/cli/clock_fix.hpp"

#include <fmt/format.h>

#include <CLI/CLI.hpp>

#include "host/model/samples.hpp"

namespace groma::cli {

void add_clock_fix(CLI::App& command, bool& fix) {
  command.add_flag(
      "--fix", fix,
      "If the diagnosis first names clock-offset or clock-drift: correct the times of the ranges by "
      "it, in memory; no file of the data set changes");
}

std::optional<model::ClockError> fix_clock(std::span<const diagnosis::Finding> findings,
                                           std::vector<model::RangeSample>& ranges, Warnings& warnings) {
  if (findings.empty() || !findings.front().clock) return std::nullopt;
  const model::ClockError clock = *findings.front().clock;
  correct_clock(clock, ranges);
  warnings.add(
      fmt::format("--fix: the times of the ranges were corrected by {:+.4f} s, and {:+.3g} s a second",
                  -clock.offset_s, -clock.drift));
  return clock;
}

void correct_clock(const model::ClockError& clock, std::vector<model::RangeSample>& ranges) {
  for (model::RangeSample& range : ranges) range.t_s = clock.corrected_s(range.t_s);
  model::sort_ranges(ranges);
}

}  // namespace groma::cli
