// The fault campaign: a site runs through phases, each a fault and the requirements after it.
//
// Requirements: within the given number of superframes after the fault each pair of a live tag and a live
// anchor ranges once per superframe again, without a gap while it is watched. While frames are lost, the
// share of good ranges is as the frames' success rates allow. No range is ever off by more than 6 sigma.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <functional>
#include <limits>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "test/sim/fault_site.hpp"

namespace groma::sim {

struct FaultPhase {
  std::string name;
  std::function<void(FaultSite&)> begin{};
  double lasts_s = 0.0;
  std::function<void(FaultSite&)> end{};
  // Bounds of the share of all pairs' ranges during the fault; least 0: not checked.
  double least_share = 0.0;
  double most_share = 1.0;
  // least_share is 75 % of what the overlaps on the air left possible, exchange by exchange: a frame is lost
  // without an overlap while its receiver's node handles a foreign one.
  bool share_by_overlaps = false;
  // Nodes that die or start in this phase.
  std::set<std::uint16_t> die{};
  std::set<std::uint16_t> rise{};
  // These nodes do not hear the others during this phase.
  std::set<std::uint16_t> apart{};
  // Superframes within which pairs range again: pairs that were alive throughout, and pairs with a node that
  // started.
  double within = 3.0;
  double newcomers_within = 10.0;
  double watched_s = 0.8;
};

struct PhaseOutcome {
  std::string name;
  double began_s = 0.0;
  double over_s = 0.0;
  double ended_s = 0.0;
  double least_share = 0.0;            // required; 0: not checked
  double share = 0.0;                  // during the fault; NaN if it had no duration
  double survivors_superframes = 0.0;  // until all pairs range
  double newcomers_superframes = 0.0;  // NaN: there were none
  std::size_t late_pairs = 0;
  std::string slowest{};  // the pair that recovered last
  std::size_t good = 0;
  double worst_sigmas = 0.0;
  std::vector<std::string> faults{};
};

class FaultCampaign {
 public:
  explicit FaultCampaign(FaultSite& site) : site_(site) {}

  // The superframe's length, from one range of a pair to the next.
  [[nodiscard]] double superframe_s() const { return site_.superframe_s(); }

  void run(const std::vector<FaultPhase>& phases) {
    struct Times {
      double began_s, over_s, ended_s, least_share;
    };
    std::vector<Times> times;
    for (const FaultPhase& phase : phases) {
      Times at{.began_s = site_.now_s(), .over_s = 0.0, .ended_s = 0.0, .least_share = phase.least_share};
      if (phase.share_by_overlaps) site_.air.count_exchanges(true);
      if (phase.begin) phase.begin(site_);
      if (phase.lasts_s > 0.0) site_.run_until(std::max(at.began_s + phase.lasts_s, site_.now_s()));
      if (phase.share_by_overlaps) {
        at.least_share = 0.75 * site_.air.possible_share((site_.now_s() - at.began_s) / superframe_s());
        site_.air.count_exchanges(false);
      }
      if (phase.end) phase.end(site_);
      at.over_s = site_.now_s();
      site_.run_for(phase.watched_s);
      // A range also needs the next superframe, which may belong to the next phase.
      at.ended_s = site_.now_s() - 3.0 * superframe_s();
      times.push_back(at);
    }
    // By then all ranges before the last end are reported.
    site_.run_for(5.0 * superframe_s());
    index();
    std::set<std::uint16_t> alive;
    for (std::size_t i = 0; i < phases.size(); ++i) {
      const FaultPhase& phase = phases[i];
      const std::set<std::uint16_t> before = alive;
      for (const std::uint16_t id : phase.die) alive.erase(id);
      alive.insert(phase.rise.begin(), phase.rise.end());
      outcomes_.push_back(judge(phase, times[i].began_s, times[i].over_s, times[i].ended_s,
                                times[i].least_share, alive, before));
    }
  }

  [[nodiscard]] const std::vector<PhaseOutcome>& outcomes() const { return outcomes_; }
  [[nodiscard]] double worst_sigmas() const { return worst_sigmas_; }
  [[nodiscard]] std::size_t good() const { return good_; }
  [[nodiscard]] bool sound() const {
    return std::all_of(outcomes_.begin(), outcomes_.end(),
                       [](const PhaseOutcome& outcome) { return outcome.faults.empty(); });
  }

  [[nodiscard]] std::string table() const {
    std::string text =
        "phase                              from s  over s  share   least   recovered in   worst  ranges\n"
        "                                                           old   new (sf)    sigma        \n";
    for (const PhaseOutcome& o : outcomes_) {
      std::array<char, 200> line{};
      std::snprintf(line.data(), line.size(),
                    "%-34s %6.2f  %6.2f  %5.3f  %5.3f  %5.1f  %6.1f  %8.2f  %6zu  %s\n", o.name.c_str(),
                    o.began_s, o.over_s, o.share, o.least_share, o.survivors_superframes,
                    o.newcomers_superframes, o.worst_sigmas, o.good, o.slowest.c_str());
      text += line.data();
      for (const std::string& fault : o.faults) text += "    ! " + fault + "\n";
    }
    return text;
  }

 private:
  using Pair = std::pair<std::uint16_t, std::uint16_t>;

  static bool is_tag(std::uint16_t id) { return id < 100; }

  void index() {
    for (const SeenRange& range : site_.ranges()) {
      if (!range.good) continue;
      instants_[{range.tag, range.anchor}].push_back(range.at_s);
      worst_sigmas_ = std::max(worst_sigmas_, std::abs(range.error_m) / range.sigma_m);
      ++good_;
    }
    for (auto& [pair, at] : instants_) std::sort(at.begin(), at.end());
  }

  // Time from which the pair ranges in each superframe until `ended_s`; infinity: not at all.
  [[nodiscard]] double ranging_since_s(const Pair& pair, double over_s, double ended_s) const {
    const double longest_gap_s = 1.5 * superframe_s();
    const auto found = instants_.find(pair);
    if (found == instants_.end()) return std::numeric_limits<double>::infinity();
    const std::vector<double>& at = found->second;
    auto after = std::upper_bound(at.begin(), at.end(), ended_s);
    double next_s = after == at.end() ? std::numeric_limits<double>::infinity() : *after;
    if (next_s > ended_s + longest_gap_s) next_s = std::numeric_limits<double>::infinity();
    double since_s = next_s;
    while (after != at.begin()) {
      const double here_s = *--after;
      if (here_s < over_s - superframe_s()) break;
      if (std::isfinite(next_s) && next_s - here_s > longest_gap_s) break;
      if (!std::isfinite(next_s) && ended_s - here_s > longest_gap_s) break;
      since_s = here_s;
      next_s = here_s;
    }
    return std::max(since_s, over_s);
  }

  PhaseOutcome judge(const FaultPhase& phase, double began_s, double over_s, double ended_s,
                     double least_share, const std::set<std::uint16_t>& alive,
                     const std::set<std::uint16_t>& before) {
    PhaseOutcome out{.name = phase.name,
                     .began_s = began_s,
                     .over_s = over_s,
                     .ended_s = ended_s,
                     .least_share = least_share};
    const double superframe = superframe_s();
    out.newcomers_superframes = std::numeric_limits<double>::quiet_NaN();
    out.share = std::numeric_limits<double>::quiet_NaN();
    std::size_t pairs = 0;
    std::size_t ranged = 0;
    const double inner_from_s = began_s + 3.0 * superframe;
    const double inner_to_s = over_s - 3.0 * superframe;
    double slowest = -1.0;
    for (const std::uint16_t tag : alive) {
      if (!is_tag(tag)) continue;
      for (const std::uint16_t anchor : alive) {
        if (is_tag(anchor)) continue;
        if (phase.apart.contains(tag) != phase.apart.contains(anchor)) continue;
        const Pair pair{tag, anchor};
        const double took = (ranging_since_s(pair, over_s, ended_s) - over_s) / superframe;
        const bool newcomer = phase.rise.contains(tag) || phase.rise.contains(anchor);
        double& worst = newcomer ? out.newcomers_superframes : out.survivors_superframes;
        worst = std::isnan(worst) ? took : std::max(worst, took);
        if (took > (newcomer ? phase.newcomers_within : phase.within)) ++out.late_pairs;
        if (took > slowest) {
          slowest = took;
          out.slowest = std::to_string(tag) + "-" + std::to_string(anchor);
        }
        if (!before.contains(tag) || !before.contains(anchor)) continue;
        ++pairs;
        const auto found = instants_.find(pair);
        if (found == instants_.end()) continue;
        const auto& at = found->second;
        ranged += static_cast<std::size_t>(
            std::max<std::ptrdiff_t>(std::upper_bound(at.begin(), at.end(), inner_to_s) -
                                         std::upper_bound(at.begin(), at.end(), inner_from_s),
                                     0));
      }
    }
    const double due = static_cast<double>(pairs) * (inner_to_s - inner_from_s) / superframe;
    if (phase.lasts_s > 0.0 && due > 0.0) out.share = static_cast<double>(ranged) / due;
    for (const SeenRange& range : site_.ranges()) {
      if (!range.good || range.at_s < began_s || range.at_s >= ended_s) continue;
      ++out.good;
      out.worst_sigmas = std::max(out.worst_sigmas, std::abs(range.error_m) / range.sigma_m);
      if (std::abs(range.error_m) > 6.0 * range.sigma_m)
        out.faults.push_back(std::to_string(range.tag) + "-" + std::to_string(range.anchor) + " at " +
                             std::to_string(range.at_s) + " s: off by " + std::to_string(range.error_m) +
                             " m, " + std::to_string(range.error_m / range.sigma_m) + " sigma");
    }
    if (out.survivors_superframes > phase.within)
      out.faults.push_back(std::to_string(out.late_pairs) + " pairs do not range again within " +
                           std::to_string(phase.within) + " superframes");
    if (out.newcomers_superframes > phase.newcomers_within)
      out.faults.push_back("newcomers do not range within " + std::to_string(phase.newcomers_within) +
                           " superframes");
    if (least_share > 0.0 && !(out.share >= least_share && out.share <= phase.most_share))
      out.faults.push_back("share not between " + std::to_string(least_share) + " and " +
                           std::to_string(phase.most_share));
    return out;
  }

  FaultSite& site_;
  std::map<Pair, std::vector<double>> instants_;
  std::vector<PhaseOutcome> outcomes_;
  double worst_sigmas_ = 0.0;
  std::size_t good_ = 0;
};

// The nodes' counters match what happened to their radios, and each leg of each exchange is a completed or a
// lost range. Only for nodes that did not restart.
inline void expect_counters_account(FaultSite& site, const std::vector<std::uint16_t>& ids) {
  for (const std::uint16_t id : ids) {
    const groma_Counters counted = site.counters(id);
    const groma_Counters& seen = site.air.endings.at(id);
    EXPECT_EQ(counted.crc_errors, seen.crc_errors) << id;
    EXPECT_EQ(counted.header_errors, seen.header_errors) << id;
    EXPECT_EQ(counted.sfd_timeouts, seen.sfd_timeouts) << id;
    EXPECT_EQ(counted.frame_timeouts, seen.frame_timeouts) << id;
    EXPECT_GT(counted.crc_errors, 0U) << id;
    EXPECT_GT(counted.header_errors, 0U) << id;
    EXPECT_GT(counted.sfd_timeouts, 0U) << id;
    EXPECT_EQ(counted.radio_recoveries, 0U) << id;
    EXPECT_EQ(counted.reports_dropped, 0U) << id;
    // Events between the answer and now.
    constexpr double kSince = 40.0;
    EXPECT_NEAR(counted.frames_received, seen.frames_received, kSince) << id;
    EXPECT_NEAR(counted.preamble_timeouts, seen.preamble_timeouts, kSince) << id;
    if (id >= nth_anchor(0)) continue;
    double good = 0.0;
    double lost = 0.0;
    for (const SeenRange& range : site.ranges())
      if (range.tag == id) (range.good ? good : lost) += 1.0;
    EXPECT_NEAR(counted.ranges_completed, good, kSince) << id;
    EXPECT_NEAR(counted.ranges_lost, lost, kSince) << id;
  }
}

// Holds at the end of each campaign, whether the nodes are native or emulated.
inline void expect_no_harm(FaultSite& site, const FaultCampaign& campaign) {
  EXPECT_TRUE(campaign.sound()) << campaign.table();
  EXPECT_LT(campaign.worst_sigmas(), 6.0);
  for (const std::uint16_t id : site.ids()) {
    EXPECT_EQ(site.chip(id).garbled_transfers(), 0U) << id;
    EXPECT_EQ(site.listener(id).undecodable, 0) << id;
  }
}

// ---- the phases -----------------------------------------------------------------------------------------

inline std::set<std::uint16_t> all_of(int tags, int anchors) {
  std::set<std::uint16_t> ids;
  for (int i = 0; i < tags; ++i) ids.insert(nth_tag(i));
  for (int i = 0; i < anchors; ++i) ids.insert(nth_anchor(i));
  return ids;
}

// POLL, RESPONSE, the closing frame, and the RESPONSE that returns its timestamp. If a FINAL closes the
// exchange, also the next POLL, which requests that RESPONSE.
inline int frames_a_range_needs(groma_RangingMethod method) {
  return method == groma_RangingMethod_METHOD_DS_FINAL ? 5 : 4;
}

inline FaultPhase no_fault(double for_s) {
  return {.name = "no fault", .lasts_s = for_s, .least_share = 0.99, .most_share = 1.01};
}

inline FaultPhase loss(double probability, double for_s, groma_RangingMethod method) {
  const double due = std::pow(1.0 - probability, frames_a_range_needs(method));
  return {.name = "30 % of all frames lost",
          .begin = [=](FaultSite& site) { site.lose(probability, for_s); },
          .lasts_s = for_s,
          .least_share = 0.9 * due,
          .most_share = 1.1 * due};
}

inline FaultPhase beacons_lost(double superframes, double superframe_s) {
  return {.name = "only beacons lost, all of them",
          .begin = [=](FaultSite& site) { site.lose(1.0, superframes * superframe_s, &is_a<mac::Beacon>); },
          .lasts_s = superframes * superframe_s,
          .least_share = 0.99,
          .most_share = 1.3};  // one more superframe weighs much among so few
}

template <class BodyType>
FaultPhase brown_out(const char* name, std::uint16_t id, double fraction, double for_s) {
  return {.name = name,
          .begin = [=](FaultSite& site) { site.brown_out<BodyType>(id, fraction, for_s); },
          .rise = {id}};
}

inline FaultPhase another_network(const char* name, std::uint32_t network_id, int serial, double for_s) {
  return {.name = name,
          .begin = [=](FaultSite& site) { site.second_network(network_id, serial); },
          .lasts_s = for_s,
          .end = [](FaultSite& site) { site.end_second_network(); },
          .most_share = 1.02,
          .share_by_overlaps = true};
}

inline FaultPhase killed(const char* name, const std::set<std::uint16_t>& ids, double within = 3.0,
                         double watched_s = 0.8) {
  return {.name = name,
          .begin =
              [=](FaultSite& site) {
                for (const std::uint16_t id : ids) site.set_power(id, false);
              },
          .die = ids,
          .within = within,
          .watched_s = watched_s};
}

// Lasts as long as it is watched.
inline FaultPhase cut_off(const char* name, const std::set<std::uint16_t>& ids, double for_s) {
  return {.name = name,
          .begin = [=](FaultSite& site) { site.cut_off(ids, for_s); },
          .apart = ids,
          .within = 10.0,
          .watched_s = for_s};
}

inline FaultPhase meet_again(const char* name, double within = 10.0) {
  return {.name = name, .within = within};
}

// A tag that no schedule lists.
inline FaultPhase tag_joins(const char* name, std::uint16_t id) {
  return {.name = name,
          .begin =
              [=](FaultSite& site) {
                site.add(id, groma_Role_ROLE_TAG, site.network.now(),
                         site.config_of(id, groma_Role_ROLE_TAG));
              },
          .rise = {id}};
}

inline FaultPhase restarted(const char* name, std::uint16_t id, double within = 3.0) {
  return {.name = name,
          .begin = [=](FaultSite& site) { site.set_power(id, true); },
          .rise = {id},
          .within = within};
}

}  // namespace groma::sim
