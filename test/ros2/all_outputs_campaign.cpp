// all_outputs_campaign [SECONDS]: gromad under full load for that time (default 600) with all its outputs at
// once: a capture, the pose stream, ROS 2 with a peer by Fast DDS, the live page and Foxglove, each with a
// client that reads. The bounds are those of latency_campaign. Prints a table; ends with 1 if a bound is
// missed.
#include <fmt/format.h>

#include <atomic>
#include <chrono>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "host/dds/node.hpp"
#include "test/host/web/web_socket.hpp"
#include "test/latency/campaign.hpp"
#include "test/latency/load_generator.hpp"
#include "test/latency/measurement.hpp"
#include "test/ros2/network_namespace.hpp"
#include "test/ros2/peer_process.hpp"

namespace groma::latency {
namespace {

using web::test::WebSocketClient;

// Clients that read all that comes, on a thread of their own.
class Readers {
 public:
  ~Readers() { stop(); }

  void add(std::function<void()> read) {
    threads_.emplace_back([this, read = std::move(read)] {
      while (!ends_) {
        read();
        std::this_thread::sleep_for(std::chrono::milliseconds(10));
      }
    });
  }
  void stop() {
    ends_ = true;
    for (std::thread& thread : threads_) {
      if (thread.joinable()) thread.join();
    }
  }

 private:
  std::atomic<bool> ends_ = false;
  std::vector<std::thread> threads_;
};

struct Counts {
  std::atomic<std::uint64_t> page_poses = 0;
  std::atomic<std::uint64_t> foxglove_messages = 0;
};

void read_the_page(std::uint16_t port, Readers& readers, Counts& counts) {
  const auto client = std::make_shared<WebSocketClient>(
      port, [] { std::this_thread::sleep_for(std::chrono::milliseconds(1)); });
  if (client->open("/live").find(" 101 ") == std::string::npos)
    throw std::runtime_error("no WebSocket at /live");
  readers.add([client, &counts] {
    while (const auto frame = client->next(0)) {
      if (frame->opcode == WebSocketClient::kPing) client->send(WebSocketClient::kPong, frame->payload);
      if (frame->payload.starts_with(R"({"class":"POSE")")) ++counts.page_poses;
    }
    client->poll();
  });
}

void read_as_foxglove(std::uint16_t port, Readers& readers, Counts& counts) {
  const auto client = std::make_shared<WebSocketClient>(
      port, [] { std::this_thread::sleep_for(std::chrono::milliseconds(1)); });
  if (client->open("/foxglove", "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n").find(" 101 ") ==
      std::string::npos)
    throw std::runtime_error("no WebSocket at /foxglove");
  std::string subscriptions;
  constexpr int kChannels = 7;
  for (int id = 1; id <= kChannels; ++id)
    subscriptions += fmt::format("{}{{\"id\":{},\"channelId\":{}}}", id > 1 ? "," : "", id, id);
  client->send(WebSocketClient::kText, R"({"op":"subscribe","subscriptions":[)" + subscriptions + "]}");
  readers.add([client, &counts] {
    while (const auto frame = client->next(0)) {
      if (frame->opcode == WebSocketClient::kPing) client->send(WebSocketClient::kPong, frame->payload);
      ++counts.foxglove_messages;
    }
    client->poll();
  });
}

int run(double duration_s) {
  if (!test::enter_network_namespace()) throw std::runtime_error("a network namespace cannot be made here");
  test::Peer peer(
      41, "default",
      {{"read", "rt/groma/pose", dds::dds_type_name("geometry_msgs/msg/PoseWithCovarianceStamped"),
        "reliable", "volatile", "10"}});
  Counts counts;
  Readers readers;
  readers.add([&] { peer.read(); });
  const Measurement measured =
      measure(duration_s, "ros2: {domain_id: 41}\nweb: {port: 0}\n", [&](std::uint16_t port) {
        read_the_page(port, readers, counts);
        read_as_foxglove(port, readers, counts);
      });
  readers.stop();
  std::vector<Row> rows = judge(measured);
  const auto at_least = [&](std::string what, double value, double bound) {
    rows.push_back({std::move(what), fmt::format("{:.0f}", value), fmt::format("at least {:.0f}", bound),
                    value >= bound});
  };
  at_least("poses at the peer of ROS 2", static_cast<double>(peer.of("rt/groma/pose").size()),
           static_cast<double>(measured.pose_latencies_s.size()));
  at_least("poses at the live page, of 20 a second", static_cast<double>(counts.page_poses),
           18.0 * duration_s);
  at_least("messages at Foxglove", static_cast<double>(counts.foxglove_messages), 5.0 * 18.0 * duration_s);
  return report(rows);
}

}  // namespace
}  // namespace groma::latency

int main(int argc, char** argv) {
  return groma::latency::campaign(argc, argv, "all_outputs_campaign", {.usual_s = 600.0, .least_s = 10.0},
                                  groma::latency::run);
}
