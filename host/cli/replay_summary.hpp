// Whether a replay as a whole can be trusted: its states, and the ranges that the gate refused.
#pragma once

#include <cstddef>
#include <map>
#include <string>
#include <string_view>

#include "host/cli/warnings.hpp"
#include "host/filter/config.hpp"
#include "host/filter/replay.hpp"

namespace groma::cli {

struct ReplaySummary {
  std::map<std::string_view, double> state_shares;  // share of the rows by state
  double other_share = 0.0;                         // of the rows after the first 10 s: not TRACKING
  std::string usual_other;                          // the most frequent state of these, with its reason
  std::size_t ranges_seen = 0;
  std::size_t ranges_used = 0;
  std::size_t ranges_gated = 0;
  std::size_t slips = 0;
  std::size_t relocations = 0;
  // Over half of the rows after the first 10 s are not TRACKING; over half of the ranges were gated. Never
  // for the model odometry.
  bool is_mostly_not_tracking = false;
  bool is_mostly_gated = false;
};

[[nodiscard]] ReplaySummary summarize(const filter::ReplayResult& result, filter::Model model);

// One line each; the first has the states, the second the ranges.
[[nodiscard]] std::string states_text(const ReplaySummary& summary);
[[nodiscard]] std::string ranges_text(const ReplaySummary& summary);

void warn_of(const ReplaySummary& summary, Warnings& warnings);

}  // namespace groma::cli
