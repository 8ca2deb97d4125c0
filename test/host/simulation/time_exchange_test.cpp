// Host and node exchange timestamps: the firmware's answers over a line with delay.
#include <gtest/gtest.h>

#include <cmath>
#include <deque>
#include <vector>

#include "host/link/report_decoder.hpp"
#include "host/simulation/simulated_site.hpp"
#include "test/host/simulation/small_site.hpp"

namespace groma::simulation {
namespace {

constexpr unsigned kBaud = 1'000'000;
constexpr double kStep_s = 0.0005;

class Instants : public link::NodeSink {
 public:
  void on_range(const model::RangeSample& range) override {
    last = range;
    ++count;
  }
  model::RangeSample last;
  int count = 0;
};

struct Outcome {
  model::RangeSample last;
  double round_trip_s = 0.0;
  std::uint64_t replies = 0;
};

// Eight seconds of tag 1, with these delays of its line in addition to the bit rate.
Outcome over_a_line(double to_host_s, double to_node_s) {
  SimulatedSite site(small_site(), {.seed = 3});
  link::ReportDecoder decoder(kBaud);
  Instants seen;
  struct Held {
    double due_s;
    std::vector<std::uint8_t> bytes;
  };
  std::deque<Held> to_node;
  double next_request_s = 1.0;
  std::vector<std::uint8_t> bytes;
  for (int i = 1; i <= 16'000; ++i) {
    const double now_s = kStep_s * i;
    if (now_s >= next_request_s) {
      next_request_s += 0.5;
      to_node.push_back({now_s + to_node_s, link::time_request(now_s)});
    }
    if (!to_node.empty() && to_node.front().due_s <= now_s) {
      EXPECT_TRUE(site.send(0, to_node.front().bytes));
      to_node.pop_front();
    }
    site.run_until(now_s + kStep_s);
    bytes.clear();
    site.take(0, bytes);
    if (!bytes.empty()) decoder.take(bytes, now_s + kStep_s + to_host_s, seen);
  }
  EXPECT_GT(seen.count, 200);
  return {.last = seen.last,
          .round_trip_s = decoder.time().round_trip_s().value_or(-1.0),
          .replies = decoder.counters().time_replies};
}

TEST(TimeExchange, EstimatesTheDelayOfASimulatedTagsLine) {
  const Outcome none = over_a_line(0.0, 0.0);
  EXPECT_NEAR(none.round_trip_s, 0.0, 1.5 * kStep_s);
  struct Line {
    double to_host_s;
    double to_node_s;
  };
  for (const Line& line : {Line{0.004, 0.004}, Line{0.008, 0.002}, Line{0.001, 0.009}}) {
    const Outcome out = over_a_line(line.to_host_s, line.to_node_s);
    EXPECT_GE(out.replies, 12U);
    EXPECT_NEAR(out.round_trip_s, line.to_host_s + line.to_node_s, 2.5 * kStep_s);
    ASSERT_NE(out.last.network_time_dtu, 0);
    ASSERT_EQ(out.last.network_time_dtu, none.last.network_time_dtu) << "the same range";
    const double late_s = out.last.t_s - none.last.t_s;
    EXPECT_NEAR(late_s, 0.5 * (line.to_host_s - line.to_node_s), 1.5 * kStep_s);
    EXPECT_LE(std::abs(late_s), 0.5 * out.round_trip_s);
  }
}

}  // namespace
}  // namespace groma::simulation
