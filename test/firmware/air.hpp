// A small simulated channel for the MAC state machines: nodes with drifting clocks, without chip and driver.
// Frames may be lost, collide or be replayed by an attacker. True times are in ticks. If two frames of a
// keyed site share a nonce, the test fails.
#pragma once

#include <cmath>
#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <random>
#include <span>
#include <variant>
#include <vector>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/mac/anchor.hpp"
#include "firmware/core/mac/tag.hpp"
#include "firmware/sim/aes.hpp"
#include "test/firmware/other_radio.hpp"
#include "test/support/frames.hpp"
#include "test/support/nonce_witness.hpp"

namespace groma::testing {

using mac::Action;
using mac::Step;
using ranging::ClockTime;
using ranging::Ticks;

inline constexpr double kTicksPerSecond = 63'897'600'000.0;
inline constexpr double kMetresPerTick = 299'792'458.0 / kTicksPerSecond;

inline groma_Schedule schedule_of(std::size_t tags, std::size_t anchors, groma_RangingMethod method,
                                  std::uint32_t turnaround_us = 650, std::uint32_t gap_us = 290) {
  groma_Schedule schedule = groma_Schedule_init_zero;
  schedule.epoch = 7;
  schedule.master_id = 101;
  schedule.tag_ids_count = static_cast<pb_size_t>(tags);
  for (std::size_t i = 0; i < tags; ++i) schedule.tag_ids[i] = static_cast<std::uint16_t>(1 + i);
  schedule.anchor_ids_count = static_cast<pb_size_t>(anchors);
  for (std::size_t i = 0; i < anchors; ++i) schedule.anchor_ids[i] = static_cast<std::uint16_t>(101 + i);
  schedule.method = method;
  schedule.turn_round_us = turnaround_us;
  schedule.response_gap_us = gap_us;
  schedule.guard_us = 20;
  return schedule;
}

// What the MAC sees of a radio.
struct RadioModel {
  radio::Phy (*phy_of)(radio::Preamble) = dw1000::phy_of;
  std::int64_t tick = 1;  // in network ticks; its readings, timestamps and transmissions are whole ones
  bool carrier = true;    // it measures the offset of a sender's clock
};
inline constexpr RadioModel kDw1000{};
inline constexpr RadioModel kOtherRadio{.phy_of = other_phy_of, .tick = kOtherTick, .carrier = false};

struct NodeSettings {
  std::uint16_t id = 0;
  double x_m = 0.0;
  double offset_ppm = 0.0;
  double phase_ticks = 0.0;  // clock reading at time 0
  Ticks antenna_delay{16436};
};

struct RangeSeen {
  std::uint16_t tag = 0;
  std::uint16_t anchor = 0;
  std::uint32_t superframe = 0;
  mac::Range range{};
  double truth_m = 0.0;
};

class Air {
 public:
  struct Frame {
    std::size_t source = 0;  // a node's index, or kGhost
    double rmarker = 0.0;    // true time, ticks
    double x_m = 0.0;
    std::vector<std::uint8_t> bytes;
  };
  static constexpr std::size_t kGhost = ~std::size_t{0};

  Air(const groma_Schedule& schedule, radio::Preamble preamble, const RadioModel& radio = kDw1000)
      : schedule_(schedule), radio_(radio), phy_(radio.phy_of(preamble)) {}

  std::size_t add(const NodeSettings& settings) { return add(settings, schedule_); }
  // A node with its own schedule.
  std::size_t add(const NodeSettings& settings, const groma_Schedule& schedule);

  // Anchors 101.. and tags 1.. at random positions up to `spread_m`, with clock offsets up to +-`ppm`.
  void add_all(double spread_m, double ppm, std::uint64_t seed);

  void start(std::size_t node);
  // An anchor starts again and surveys: it polls in the slot of the tag `lender`.
  void survey(std::size_t node, std::uint16_t lender);
  void attach(std::size_t node, mac::ControlChannel& channel);
  void start_all() {
    for (std::size_t i = 0; i < nodes_.size(); ++i) start(i);
  }
  // Switches a node off and resets it: it keeps the count of its boots only, and its channels are detached.
  void reset(std::size_t node);
  // The radio is on again after a pause; the node keeps its state.
  void resume(std::size_t node);
  void stop(std::size_t node) {
    nodes_[node]->on = false;
    nodes_[node]->action = {};
  }

  void run(double seconds);

  // Sends a frame from outside the site, its RMARKER at true time `rmarker`.
  void inject(double rmarker, double x_m, std::span<const std::uint8_t> bytes) {
    ghosts_.push_back({kGhost, rmarker, x_m, {bytes.begin(), bytes.end()}});
  }

  // The network key of nodes that are added from now on.
  std::optional<security::Key> key{};
  // Whether two nodes (indices) hear and disturb each other. Unset: all do.
  std::function<bool(std::size_t a, std::size_t b)> reach;
  // True: this receiver does not hear this frame.
  std::function<bool(const Frame&, std::size_t receiver)> lost;
  // True: nobody hears this frame, and it disturbs no other.
  std::function<bool(const Frame&)> jammed;
  // Called with each frame at its end.
  std::function<void(const Frame&)> overheard;
  // May change a reception before its receiver gets it.
  std::function<void(std::size_t receiver, mac::Reception&)> spoil;
  // True: omits the calls to a machine that only save time (step.hpp).
  bool only_events = false;
  double timestamp_noise_ticks = 0.0;
  double work_ticks = 100e-6 * kTicksPerSecond;  // from an event until the next action is armed

  std::vector<RangeSeen> ranges;
  std::size_t collisions = 0;

  [[nodiscard]] const NonceWitness& nonces() const { return witness_; }
  [[nodiscard]] double now() const { return now_; }
  [[nodiscard]] const radio::Phy& phy() const { return phy_; }
  [[nodiscard]] std::size_t size() const { return nodes_.size(); }
  [[nodiscard]] std::uint16_t id(std::size_t node) const { return nodes_[node]->settings.id; }
  [[nodiscard]] double x_m(std::size_t node) const { return nodes_[node]->settings.x_m; }
  [[nodiscard]] const groma_Counters& counters(std::size_t node) const { return nodes_[node]->counters; }
  [[nodiscard]] const mac::Station& station(std::size_t node) const;
  [[nodiscard]] double offset_ppm(std::size_t node) const { return nodes_[node]->settings.offset_ppm; }
  // Its clock reading now.
  [[nodiscard]] double local_ticks_of(std::size_t node) const { return local_ticks(*nodes_[node], now_); }
  void set_offset_ppm(std::size_t node, double ppm);

 private:
  struct Node {
    NodeSettings settings;
    groma_Schedule schedule = groma_Schedule_init_zero;
    std::uint32_t boots = 1;
    std::uint16_t sessions = 0;
    std::uint32_t nonces = 0;
    mac::SignedPlaces signed_places;
    groma_Counters counters = groma_Counters_init_zero;
    std::variant<std::monostate, mac::Tag, mac::Anchor> machine;
    bool on = false;
    Action action;
    std::vector<std::uint8_t> outgoing;
    double ready = 0.0;      // true time from which the action is in force
    double busy_from = 0.0;  // true time at which the receiver is on
  };

  mac::Site site_of(Node& node);
  void build(Node& node);
  template <class F>
  static Step dispatch(Node& n, F&& f);
  static double local_ticks(const Node& n, double t) {
    return n.settings.phase_ticks + t * (1.0 + n.settings.offset_ppm * 1e-6);
  }
  [[nodiscard]] ClockTime local(const Node& n, double t) const {
    return ClockTime(std::llround(local_ticks(n, t) / static_cast<double>(radio_.tick)) * radio_.tick);
  }
  // When a transmission leaves that the action requests; the radio reports what was requested.
  [[nodiscard]] ClockTime leaves_at(const Action& action) const {
    const auto ticks = static_cast<double>(action.at.count()) / static_cast<double>(radio_.tick);
    return ClockTime(std::llround(ticks) * radio_.tick);
  }
  static double true_time(const Node& n, ClockTime t) {
    return (static_cast<double>(t.count()) - n.settings.phase_ticks) / (1.0 + n.settings.offset_ppm * 1e-6);
  }
  [[nodiscard]] double before() const { return static_cast<double>(phy_.before_rmarker().count()); }
  [[nodiscard]] double after(std::size_t bytes) const {
    return static_cast<double>(phy_.after_rmarker(bytes + radio::kFrameCheckBytes).count());
  }

  void arm(std::size_t index, Step step);
  void carry_out(std::size_t index, Step step);

  void record(std::size_t index, const mac::Exchange& exchange);

  // Processes one event: the end of a frame or of a listening period. False: there is none before `end`.
  bool step(double end);

  void transmit(const Frame& frame);

  [[nodiscard]] bool audible(std::size_t source, std::size_t receiver) const {
    return !reach || source == kGhost || reach(source, receiver);
  }
  // Whether a frame other than that of `source` collides with it at `receiver`.
  [[nodiscard]] bool disturbed(std::size_t receiver, std::size_t source, double start, double end) const;

  void hear(std::size_t index, const Frame& frame, double start, double end);

  double gaussian() {
    double sum = -6.0;
    for (int i = 0; i < 12; ++i) sum += static_cast<double>(random_() >> 11) * 0x1p-53;
    return sum;
  }

  struct Past {
    std::size_t source;
    double start;
    double end;
  };
  groma_Schedule schedule_;
  RadioModel radio_;
  radio::Phy phy_;
  std::vector<std::unique_ptr<Node>> nodes_;
  std::vector<Frame> ghosts_;
  NonceWitness witness_;
  std::vector<Past> past_;
  std::mt19937_64 random_{42};
  double now_ = 0.0;
};

}  // namespace groma::testing
