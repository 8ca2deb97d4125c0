#include "host/cli/warnings.hpp"

#include <fmt/format.h>

#include "host/cli/terminal.hpp"

namespace groma::cli {

void Warnings::add(const std::string& text) {
  complain(fmt::format("warning: {}", text));
  any_ = true;
}

void Warnings::note(const std::string& text) {
  complain(fmt::format("note: {}", text));
}

void Warnings::add(const diagnosis::Finding& finding) {
  add(fmt::format("{}: {}\n  {}", finding.cause, finding.evidence, finding.remedy));
}

void Warnings::add(const io::DroppedRows& dropped) {
  std::string list;
  const auto count = [&](std::size_t rows, const std::string& what) {
    if (rows > 0) list += fmt::format("{}{} {}", list.empty() ? "" : ", ", rows, what);
  };
  count(dropped.range_out_of_bounds, fmt::format("with a range not within 0 to {} m", io::kMaxRange_m));
  count(dropped.unknown_tag, "of an unknown tag");
  count(dropped.unknown_anchor, "of an unknown anchor");
  count(dropped.late, fmt::format("out of order by over {} s (odometry: over {} samples)", io::kMaxDelay_s,
                                  io::kMaxOdometryOutOfOrder));
  count(dropped.repeated, "repeated");
  count(dropped.implausible, "with a pose that no robot has, or an invalid covariance");
  if (!list.empty()) add(fmt::format("{} rows dropped: {}", dropped.total(), list));
}

void Warnings::add(const io::Dataset& dataset) {
  add(dataset.dropped);
  if (dataset.log && dataset.log->damaged_bytes > 0) {
    add(fmt::format("{} bytes of the log are damaged and were skipped", dataset.log->damaged_bytes));
  }
}

}  // namespace groma::cli
