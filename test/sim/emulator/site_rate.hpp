// How many ranges a site completes per second, and the bounds of that.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <set>
#include <span>
#include <utility>

#include "firmware/sim/emulator/emulated_node.hpp"
#include "test/sim/site_bench.hpp"

namespace groma::sim {

constexpr double kPatience_s = 20.0;

struct SiteRate {
  std::optional<double>
      joined_s;                 // when each tag had ranged with each anchor; nothing: not within kPatience_s
  std::size_t pairs = 0;        // of a tag and an anchor that had ranged by then
  double ranges_per_s = 0.0;    // good ones, on the host
  double schedule_per_s = 0.0;  // one from each window of the schedule
  double bound_per_s = 0.0;     // no gaps, turnarounds, guards, shared slot: air time only
  int late_transmits = 0;
  int late_receives = 0;
  int reports_lost = 0;
  int recoveries = 0;
  // Of each kind of slot the least slack over all tags, and over all anchors, in us; nothing: none occurred.
  using Slacks = std::array<std::optional<std::int32_t>, 5>;
  Slacks tags_slack_us{};
  Slacks anchors_slack_us{};
  // Of the emulated nodes; zero if there are none.
  double instructions_per_range = 0.0;  // of all nodes together
  double tags_load = 0.0;               // mean share of the time in which the processor does not sleep
  double anchors_load = 0.0;
};

// The air time of one superframe with an empty shared slot, in seconds.
inline double air_time_s(const mac::Superframe& superframe, std::size_t tags, std::size_t anchors) {
  const radio::Phy phy = superframe.phy();
  const auto air_s = [&](std::size_t bytes) {
    return static_cast<double>(phy.air_time(superframe.on_air(bytes)).count()) /
           static_cast<double>(ranging::Ticks::kPerSecond);
  };
  const double slot_s = air_s(mac::poll_bytes(anchors)) +
                        static_cast<double>(anchors) * air_s(mac::kResponseBytes) +
                        (superframe.has_final() ? air_s(mac::kFinalBytes) : 0.0);
  return air_s(mac::beacon_bytes(tags, false)) + static_cast<double>(tags) * slot_s;
}

// Totals since the first power-on.
struct Processors {
  std::uint64_t instructions = 0;
  std::array<double, 2> busy_s{};  // of tags, of anchors
  std::array<double, 2> powered_s{};
};

inline Processors processors(SiteBench& site, std::size_t tags) {
  Processors out;
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    const auto* node = dynamic_cast<const EmulatedNode*>(&site.network.node(i));
    if (node == nullptr) continue;
    const EmulatorUsage usage = node->usage(site.network.now());
    const std::size_t kind = i < tags ? 0 : 1;
    out.instructions += usage.instructions;
    out.busy_s.at(kind) += usage.cpu_load * usage.powered_s;
    out.powered_s.at(kind) += usage.powered_s;
  }
  return out;
}

struct Join {
  std::optional<double> at_s;  // when each tag had ranged with each anchor
  std::size_t pairs = 0;       // that have ranged
};

// Runs the site until each tag has ranged with each anchor, at most for `within_s`.
inline Join join(SiteBench& site, const SiteSettings& settings, double within_s) {
  constexpr double kStep_s = 0.1;
  const auto pairs = static_cast<std::size_t>(settings.tags) * static_cast<std::size_t>(settings.anchors);
  Join out;
  for (double t_s = kStep_s; t_s <= within_s; t_s += kStep_s) {
    site.run_until(t_s);
    std::set<std::pair<std::uint32_t, std::uint32_t>> seen;
    double joined_s = 0.0;
    for (const Listener& listener : site.listeners) {
      for (const Listener::Report& report : listener.reports) {
        for (const groma_Range& range : std::span(report.body.ranges).first(report.body.ranges_count)) {
          if (range.status == groma_RangeStatus_RANGE_OK &&
              seen.insert({report.body.tag_id, range.anchor_id}).second)
            joined_s = std::max(joined_s, to_seconds(report.t));
        }
      }
    }
    out.pairs = seen.size();
    if (seen.size() == pairs) {
      out.at_s = joined_s;
      break;
    }
  }
  return out;
}

// Runs the site until it has joined (at most kPatience_s) and each node has reported its counters, then for
// `seconds` rounded up to whole superframes, which are counted, then until the nodes have reported their
// counters again.
inline SiteRate measure_rate(const SiteSettings& settings, double seconds, unsigned threads = 1) {
  SiteBench site(settings);
  site.network.set_threads(threads);
  const mac::Superframe superframe = site.superframe();
  const double superframe_s = seconds_of(superframe);
  const auto tags = static_cast<std::size_t>(settings.tags);
  const double ranges = static_cast<double>(settings.tags) * settings.anchors;
  SiteRate out;
  out.schedule_per_s = ranges / superframe_s;
  out.bound_per_s = ranges / air_time_s(superframe, tags, static_cast<std::size_t>(settings.anchors));
  const Join joined = join(site, settings, kPatience_s);
  out.joined_s = joined.at_s;
  out.pairs = joined.pairs;

  constexpr double kTelemetry_s = 1.3;
  const auto run_for = [&](double span_s) {
    constexpr double kStep_s = 0.5;
    const double end_s = to_seconds(site.network.now()) + span_s;
    for (double t_s = end_s - span_s + kStep_s; t_s < end_s; t_s += kStep_s) site.run_until(t_s);
    site.run_until(end_s);
  };
  const auto count = [&](int sign) {
    for (const Listener& listener : site.listeners) {
      out.late_transmits += sign * static_cast<int>(listener.counters.late_transmits);
      out.late_receives += sign * static_cast<int>(listener.counters.late_receives);
      out.recoveries += sign * static_cast<int>(listener.counters.radio_recoveries);
    }
  };
  run_for(kTelemetry_s);
  count(-1);
  const Processors before = processors(site, tags);
  const double begin_s = to_seconds(site.network.now());
  const double span_s = std::ceil(seconds / superframe_s) * superframe_s;
  run_for(span_s + kTelemetry_s);
  const Processors after = processors(site, tags);
  count(1);
  groma_HostToNode ask = groma_HostToNode_init_zero;
  ask.which_body = groma_HostToNode_get_slack_tag;
  for (std::size_t i = 0; i < site.network.size(); ++i) site.network.send(i, frame_of(ask));
  run_for(0.1);
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    const groma_Slack& slack = site.listeners[i].slack;
    for (const groma_SlotSlack& slot : std::span(slack.slots).first(slack.slots_count)) {
      auto& least = (i < tags ? out.tags_slack_us : out.anchors_slack_us).at(slot.kind);
      least = std::min(least.value_or(slot.least_us), slot.least_us);
    }
  }

  int good = 0;
  for (std::size_t i = 0; i < tags; ++i) {
    std::uint32_t expected = 0;
    bool first = true;
    for (const Listener::Report& report : site.listeners[i].reports) {
      if (to_seconds(report.t) < begin_s) continue;
      if (!first) out.reports_lost += static_cast<int>(report.body.sequence - expected);
      first = false;
      expected = report.body.sequence + 1;
      if (to_seconds(report.t) >= begin_s + span_s) continue;
      for (pb_size_t k = 0; k < report.body.ranges_count; ++k)
        good += report.body.ranges[k].status == groma_RangeStatus_RANGE_OK ? 1 : 0;
    }
  }
  out.ranges_per_s = good / span_s;
  const auto load = [&](std::size_t kind) {
    const double powered_s = after.powered_s.at(kind) - before.powered_s.at(kind);
    return powered_s > 0.0 ? (after.busy_s.at(kind) - before.busy_s.at(kind)) / powered_s : 0.0;
  };
  out.tags_load = load(0);
  out.anchors_load = load(1);
  out.instructions_per_range = static_cast<double>(after.instructions - before.instructions) /
                               (span_s + kTelemetry_s) / std::max(1.0, out.ranges_per_s);
  return out;
}

}  // namespace groma::sim
