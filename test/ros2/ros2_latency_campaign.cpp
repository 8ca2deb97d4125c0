// ros2_latency_campaign [SECONDS]: gromad under full load for that time (default 120) without and with ROS 2,
// and the poses at a client of the pose stream beside those at a peer by Fast DDS. Prints a table; ends with
// 1 if a bound is missed.
#include <fmt/format.h>

#include <atomic>
#include <chrono>
#include <cmath>
#include <stdexcept>
#include <thread>

#include "host/dds/node.hpp"
#include "host/ros2/message.hpp"
#include "host/ros2/schemas.hpp"
#include "test/latency/campaign.hpp"
#include "test/latency/load_generator.hpp"
#include "test/latency/measurement.hpp"
#include "test/ros2/network_namespace.hpp"
#include "test/ros2/peer_process.hpp"

namespace groma::latency {
namespace {

constexpr const char* kPose = "geometry_msgs/msg/PoseWithCovarianceStamped";

// From the write of an odometry sample to the pose at the peer, s.
std::vector<double> latencies_of(const std::vector<test::PeerMessage>& poses, const Measurement& measured) {
  const ros2::MessageDefinition definition(kPose, ros2::schema_of(kPose));
  std::vector<double> out;
  for (const test::PeerMessage& message : poses) {
    const auto pose = definition.read(message.cdr);
    if (!pose) throw std::runtime_error("the peer received no pose");
    const auto whole = [&](const char* path) {
      return std::get<std::int64_t>(ros2::values_at(*pose, *ros2::FieldPath::parse(path)).at(0)->content);
    };
    const double t_s = static_cast<double>(whole("header.stamp.sec")) +
                       1e-9 * static_cast<double>(whole("header.stamp.nanosec"));
    const auto sample = std::llround((t_s - LoadGenerator::kRobotOrigin_s) * LoadGenerator::kOdometry_hz);
    if (sample < std::llround(kWarmUp_s * LoadGenerator::kOdometry_hz)) continue;
    const auto i = static_cast<std::size_t>(sample);
    if (i >= measured.odometry_written_ns.size()) continue;
    out.push_back(1e-9 * static_cast<double>(message.arrived_ns - measured.odometry_written_ns[i]));
  }
  return out;
}

int run(double duration_s) {
  if (!test::enter_network_namespace()) throw std::runtime_error("a network namespace cannot be made here");
  const Measurement without = measure(duration_s);
  test::Peer peer(
      41, "default",
      {{"read", "rt/groma/pose", dds::dds_type_name(kPose), "reliable", "volatile", "10"},
       {"read", "rt/tf", dds::dds_type_name("tf2_msgs/msg/TFMessage"), "reliable", "volatile", "100"}});
  std::atomic<bool> ends = false;
  std::thread reads([&] {
    while (!ends) {
      peer.read();
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
    }
  });
  Measurement with;
  try {
    with = measure(duration_s, "ros2: {domain_id: 41}\n");
  } catch (...) {
    ends = true;
    reads.join();
    throw;
  }
  ends = true;
  reads.join();
  const std::vector<double> at_peer_s = latencies_of(peer.of("rt/groma/pose"), with);
  const auto ms = [](const std::vector<double>& of, double share) { return 1e3 * percentile(of, share); };
  std::vector<Row> rows;
  const auto state = [&](std::string what, double value, const char* unit) {
    rows.push_back({std::move(what), fmt::format("{:.3f} {}", value, unit), ""});
  };
  const auto at_most = [&](std::string what, double value, double bound, const char* unit) {
    rows.push_back({std::move(what), fmt::format("{:.3f} {}", value, unit),
                    fmt::format("{:.3f} {}", bound, unit), value <= bound, true});
  };
  state("without ROS 2: odometry sample to POSE, p99.9", ms(without.pose_latencies_s, 0.999), "ms");
  state("without ROS 2: idle timer, p99.9", ms(without.timer_delays_s, 0.999), "ms");
  state("with ROS 2: idle timer, p99.9", ms(with.timer_delays_s, 0.999), "ms");
  at_most("with ROS 2: odometry sample to POSE, p99.9", ms(with.pose_latencies_s, 0.999),
          ms(without.pose_latencies_s, 0.999) + 0.2, "ms");
  state("with ROS 2: odometry sample to POSE, p99", ms(with.pose_latencies_s, 0.99), "ms");
  state("odometry sample to the pose at the peer, p50", ms(at_peer_s, 0.5), "ms");
  at_most("odometry sample to the pose at the peer, p99", ms(at_peer_s, 0.99),
          ms(with.pose_latencies_s, 0.99) + 1.0, "ms");
  state("CPU time without ROS 2", 100.0 * without.cpu_share, "% of a core");
  state("CPU time with ROS 2", 100.0 * with.cpu_share, "% of a core");
  at_most("allocations from a sample's bytes to its POSE sent",
          static_cast<double>(with.allocations_in_poses), 0.0, "");
  at_most("other allocations of the loop's thread", with.other_allocations_per_s,
          1.01 * without.other_allocations_per_s + 1.0, "a second");
  state("allocations of other threads", with.thread_allocations_per_s, "a second");
  const double expected = static_cast<double>(with.pose_latencies_s.size());
  at_most("poses that the peer lacks", expected - static_cast<double>(at_peer_s.size()), 0.0, "");
  return report(rows);
}

}  // namespace
}  // namespace groma::latency

int main(int argc, char** argv) {
  return groma::latency::campaign(argc, argv, "ros2_latency_campaign", {.usual_s = 120.0, .least_s = 10.0},
                                  groma::latency::run);
}
