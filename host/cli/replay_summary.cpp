#include "host/cli/replay_summary.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <map>
#include <utility>
#include <vector>

namespace groma::cli {

namespace {

constexpr double kSettling_s = 10.0;
constexpr double kMost = 0.5;

double share(std::size_t part, std::size_t whole) {
  return whole == 0 ? 0.0 : static_cast<double>(part) / static_cast<double>(whole);
}

// Sets the share of the rows after the first kSettling_s that are not TRACKING, and what they are instead.
void judge_states(const filter::ReplayResult& result, ReplaySummary& out) {
  std::size_t rows = 0;
  std::size_t other = 0;
  std::map<std::pair<std::string_view, std::string_view>, std::size_t> others;
  for (std::size_t i = 0; i < result.rows.size(); ++i) {
    if (result.rows[i].t_s < result.rows.front().t_s + kSettling_s) continue;
    ++rows;
    const auto& [state, reason] = result.states[i];
    if (state == filter::State::kTracking) continue;
    ++other;
    ++others[{filter::state_name(state), filter::reason_name(reason)}];
  }
  out.other_share = share(other, rows);
  if (others.empty()) return;
  const auto& [words, count] = *std::max_element(
      others.begin(), others.end(), [](const auto& a, const auto& b) { return a.second < b.second; });
  out.usual_other =
      words.second.empty() ? std::string(words.first) : fmt::format("{} ({})", words.first, words.second);
}

std::string counted(std::size_t count, const char* what) {
  return fmt::format("{} {}{}", count, what, count == 1 ? "" : "s");
}

}  // namespace

ReplaySummary summarize(const filter::ReplayResult& result, filter::Model model) {
  using Outcome = filter::RangeOutcome;
  ReplaySummary out{.ranges_seen = result.ranges_seen,
                    .ranges_used = result.counters.ranges[Outcome::kUsed],
                    .ranges_gated = result.counters.ranges[Outcome::kGated],
                    .slips = result.counters.slips,
                    .relocations = result.relocations};
  judge_states(result, out);
  for (const auto& of : result.states)
    out.state_shares[filter::state_name(of.state)] += 1.0 / static_cast<double>(result.states.size());
  if (model == filter::Model::kOdometry) return out;
  out.is_mostly_not_tracking = out.other_share > kMost;
  out.is_mostly_gated = share(out.ranges_gated, out.ranges_seen) > kMost;
  return out;
}

std::string states_text(const ReplaySummary& summary) {
  std::vector<std::pair<std::string_view, double>> shares(summary.state_shares.begin(),
                                                          summary.state_shares.end());
  std::stable_sort(shares.begin(), shares.end(),
                   [](const auto& a, const auto& b) { return a.second > b.second; });
  std::string list;
  for (const auto& [state, of] : shares)
    list += fmt::format("{}{} {:.1f} %", list.empty() ? "" : ", ", state, 100.0 * of);
  return fmt::format("{} of the poses{}; {}, {}\n", list,
                     summary.is_mostly_not_tracking ? ": mostly not TRACKING" : "",
                     counted(summary.slips, "slip"), counted(summary.relocations, "relocation"));
}

std::string ranges_text(const ReplaySummary& summary) {
  return fmt::format("{} ranges seen, {} used, {} ({:.1f} %) gated{}\n", summary.ranges_seen,
                     summary.ranges_used, summary.ranges_gated,
                     100.0 * share(summary.ranges_gated, summary.ranges_seen),
                     summary.is_mostly_gated ? ": mostly gated" : "");
}

void warn_of(const ReplaySummary& summary, Warnings& warnings) {
  if (summary.is_mostly_not_tracking) {
    warnings.add(
        fmt::format("mostly not TRACKING: {:.0f} % of the poses after the first {:.0f} s are in another "
                    "state, most often {}; "
                    "look at one of these times with groma explain",
                    100.0 * summary.other_share, kSettling_s, summary.usual_other));
  }
  if (summary.is_mostly_gated) {
    warnings.add(
        fmt::format("mostly gated: {:.0f} % of the ranges contradict the poses; check the calibration, the "
                    "lever arms in tags.csv, and the clocks",
                    100.0 * share(summary.ranges_gated, summary.ranges_seen)));
  }
}

}  // namespace groma::cli
