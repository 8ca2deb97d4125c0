// How many ranges a site completes per second, and the bounds of that.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

#include "test/sim/site_bench.hpp"

namespace groma::sim {

struct SiteRate {
  double ranges_per_s = 0.0;    // good ones, on the host
  double schedule_per_s = 0.0;  // one from each window of the schedule
  double bound_per_s = 0.0;     // no gaps, turnarounds, guards, shared slot: air time only
  int late_transmits = 0;
  int late_receives = 0;
  int reports_lost = 0;
  int recoveries = 0;
};

// The air time of one superframe with an empty shared slot, in seconds.
inline double air_time_s(const mac::Superframe& superframe, std::size_t tags, std::size_t anchors) {
  const dw1000::Phy phy = superframe.phy();
  const auto air_s = [&](std::size_t bytes) {
    return static_cast<double>(phy.air_time(superframe.on_air(bytes)).count()) /
           static_cast<double>(ranging::Ticks::kPerSecond);
  };
  const double slot_s = air_s(mac::poll_bytes(anchors)) +
                        static_cast<double>(anchors) * air_s(mac::kResponseBytes) +
                        (superframe.has_final() ? air_s(mac::kFinalBytes) : 0.0);
  return air_s(mac::beacon_bytes(tags, false)) + static_cast<double>(tags) * slot_s;
}

// Runs the site for `settle_s`, then for `seconds` rounded up to whole superframes, then until the nodes have
// reported their counters.
inline SiteRate measure_rate(const SiteSettings& settings, double seconds, double settle_s = 1.0,
                             unsigned threads = 1) {
  SiteBench site(settings);
  site.network.set_threads(threads);
  const mac::Superframe superframe = site.superframe();
  const double superframe_s = seconds_of(superframe);
  const double span_s = std::ceil(seconds / superframe_s) * superframe_s;
  const double end_s = settle_s + span_s;
  constexpr double kTelemetry_s = 1.3;
  for (double t_s = 0.5; t_s < end_s + kTelemetry_s; t_s += 0.5) site.run_until(t_s);
  site.run_until(end_s + kTelemetry_s);

  SiteRate out;
  const auto tags = static_cast<std::size_t>(settings.tags);
  int good = 0;
  for (std::size_t i = 0; i < tags; ++i) {
    std::uint32_t expected = 0;
    bool first = true;
    for (const Listener::Report& report : site.listeners[i].reports) {
      if (!first) out.reports_lost += static_cast<int>(report.body.sequence - expected);
      first = false;
      expected = report.body.sequence + 1;
      if (to_seconds(report.t) < settle_s || to_seconds(report.t) >= end_s) continue;
      for (pb_size_t k = 0; k < report.body.ranges_count; ++k)
        good += report.body.ranges[k].status == groma_RangeStatus_RANGE_OK ? 1 : 0;
    }
  }
  for (const Listener& listener : site.listeners) {
    out.late_transmits += static_cast<int>(listener.counters.late_transmits);
    out.late_receives += static_cast<int>(listener.counters.late_receives);
    out.recoveries += static_cast<int>(listener.counters.radio_recoveries);
  }
  const double ranges = static_cast<double>(settings.tags) * settings.anchors;
  out.ranges_per_s = good / span_s;
  out.schedule_per_s = ranges / superframe_s;
  out.bound_per_s = ranges / air_time_s(superframe, tags, static_cast<std::size_t>(settings.anchors));
  return out;
}

}  // namespace groma::sim
