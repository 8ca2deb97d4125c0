// gromad under full load: how late its poses are, and what it needs for them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

namespace groma::latency {

// The first seconds do not count: gromad finds its pose.
inline constexpr double kWarmUp_s = 3.0;

struct Measurement {
  double duration_s = 0.0;               // of the load, with the warm-up
  std::vector<double> timer_delays_s;    // wake-up delays of an idle thread's timer
  std::vector<double> pose_latencies_s;  // from the write of an odometry sample's last byte to its POSE
  std::vector<std::int64_t> odometry_written_ns;  // of all samples (CLOCK_MONOTONIC)
  std::vector<double> write_delays_s;             // of the load
  double cpu_share = 0.0;                         // of a core
  double early_s = 0.0;                           // when memory was measured first
  double early_mib = 0.0;                         // resident memory
  double late_mib = 0.0;                          // at the end

  std::uint64_t overflows = 0;  // of ports and socket: the load itself lost bytes
  std::uint64_t reports_lost = 0;
  std::uint64_t dropped = 0;  // measurements, mostly because the load came too late for their times
  std::uint64_t ranges_sent = 0;
  std::uint64_t ranges_taken = 0;
  std::uint64_t ranges_recorded = 0;
  std::uint64_t odometry_taken = 0;
  std::uint64_t odometry_recorded = 0;
  std::uint64_t poses_missing = 0;       // odometry samples without one, after the first
  std::uint64_t poses_out_of_order = 0;  // or given twice
  std::uint64_t poses_not_tracking = 0;  // after the warm-up

  std::uint64_t poses = 0;                 // after the warm-up, as are the allocations
  std::uint64_t allocations_in_poses = 0;  // of the loop's thread, from the sample's bytes to the POSE sent
  double other_allocations_per_s = 0.0;    // of the loop's thread
  double thread_allocations_per_s = 0.0;   // of other threads
  bool same_scheduling_class = false;      // of gromad and of the idle thread
  int exit_code = -1;
  std::string log;
};

// more_config: keys that are added to gromad's configuration. on_web: called with the port of gromad's web
// server, if it has one, before the load begins. Throws std::runtime_error, with gromad's log, if it does not
// run to the end.
[[nodiscard]] Measurement measure(double duration_s, const std::string& more_config = "",
                                  const std::function<void(std::uint16_t port)>& on_web = {});

// One row of the table.
struct Row {
  std::string what;
  std::string value;
  std::string bound;  // empty: none
  bool met = true;
  bool of_times = false;  // depends on the machine and its other load
};
// The smallest value that is not below this share of all.
[[nodiscard]] double percentile(std::vector<double> values, double share);
[[nodiscard]] std::vector<Row> judge(const Measurement& of);
[[nodiscard]] std::string format_table(const std::vector<Row>& rows);

}  // namespace groma::latency
