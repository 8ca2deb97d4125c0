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
  std::size_t add(const NodeSettings& settings, const groma_Schedule& schedule) {
    auto node = std::make_unique<Node>();
    node->settings = settings;
    node->schedule = schedule;
    build(*node);
    nodes_.push_back(std::move(node));
    return nodes_.size() - 1;
  }

  // Anchors 101.. and tags 1.. at random positions up to `spread_m`, with clock offsets up to +-`ppm`.
  void add_all(double spread_m, double ppm, std::uint64_t seed) {
    std::mt19937_64 random(seed);
    const auto uniform = [&](double low, double high) {
      return low + (high - low) * static_cast<double>(random() >> 11) * 0x1p-53;
    };
    for (std::size_t i = 0; i < schedule_.anchor_ids_count; ++i) {
      add({.id = schedule_.anchor_ids[i],
           .x_m = uniform(0.0, spread_m),
           .offset_ppm = uniform(-ppm, ppm),
           .phase_ticks = uniform(0.0, 1e12)});
    }
    for (std::size_t i = 0; i < schedule_.tag_ids_count; ++i) {
      add({.id = schedule_.tag_ids[i],
           .x_m = uniform(0.0, spread_m),
           .offset_ppm = uniform(-ppm, ppm),
           .phase_ticks = uniform(0.0, 1e12)});
    }
  }

  void start(std::size_t node) {
    Node& n = *nodes_[node];
    n.on = true;
    arm(node, dispatch(n, [&](auto& machine) { return machine.start(local(n, now_)); }));
  }
  // An anchor starts again and surveys: it polls in the slot of the tag `lender`.
  void survey(std::size_t node, std::uint16_t lender) {
    Node& n = *nodes_[node];
    mac::Site site = site_of(n);
    site.lender = lender;
    n.machine.emplace<mac::Tag>(site, n.counters);
    start(node);
  }
  void attach(std::size_t node, mac::ControlChannel& channel) {
    auto& machine = nodes_[node]->machine;
    if (auto* tag = std::get_if<mac::Tag>(&machine)) return tag->attach(channel);
    std::get<mac::Anchor>(machine).attach(channel);
  }
  void start_all() {
    for (std::size_t i = 0; i < nodes_.size(); ++i) start(i);
  }
  // Switches a node off and resets it: it keeps the count of its boots only, and its channels are detached.
  void reset(std::size_t node) {
    Node& n = *nodes_[node];
    stop(node);
    ++n.boots;
    n.sessions = 0;
    n.nonces = 0;
    n.signed_places = {};
    build(n);
  }
  // The radio is on again after a pause; the node keeps its state.
  void resume(std::size_t node) {
    Node& n = *nodes_[node];
    n.on = true;
    arm(node, dispatch(n, [&](auto& machine) { return machine.resume(local(n, now_)); }));
  }
  void stop(std::size_t node) {
    nodes_[node]->on = false;
    nodes_[node]->action = {};
  }

  void run(double seconds) {
    const double end = now_ + seconds * kTicksPerSecond;
    while (step(end)) {
    }
    now_ = end;
  }

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
  [[nodiscard]] const mac::Station& station(std::size_t node) const {
    const auto& machine = nodes_[node]->machine;
    if (const auto* tag = std::get_if<mac::Tag>(&machine)) return *tag;
    return std::get<mac::Anchor>(machine);
  }
  [[nodiscard]] double offset_ppm(std::size_t node) const { return nodes_[node]->settings.offset_ppm; }
  // Its clock reading now.
  [[nodiscard]] double local_ticks_of(std::size_t node) const { return local_ticks(*nodes_[node], now_); }
  void set_offset_ppm(std::size_t node, double ppm) {
    Node& n = *nodes_[node];
    const double local_now = local_ticks(n, now_);
    n.settings.offset_ppm = ppm;
    n.settings.phase_ticks = local_now - now_ * (1.0 + ppm * 1e-6);
  }

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

  mac::Site site_of(Node& node) {
    return {.id = node.settings.id,
            .network_id = 0x55AA,
            .phy = phy_,
            .schedule = &node.schedule,
            .transmit_antenna_delay = node.settings.antenna_delay,
            .boot_count = node.boots,
            .sessions = &node.sessions,
            .network_key = key ? std::span<const std::uint8_t>(*key) : std::span<const std::uint8_t>(),
            .cipher = &witness_,
            .nonces = &node.nonces,
            .signed_places = &node.signed_places};
  }
  void build(Node& node) {
    const mac::Site site = site_of(node);
    if (node.settings.id < 100) {
      node.machine.emplace<mac::Tag>(site, node.counters);
    } else {
      node.machine.emplace<mac::Anchor>(site, node.counters);
    }
  }
  [[nodiscard]] std::size_t index_of(const Node& n) const {
    std::size_t i = 0;
    while (nodes_[i].get() != &n) ++i;
    return i;
  }
  template <class F>
  static Step dispatch(Node& n, F&& f) {
    if (auto* tag = std::get_if<mac::Tag>(&n.machine)) return f(*tag);
    return f(std::get<mac::Anchor>(n.machine));
  }
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

  void arm(std::size_t index, Step step) {
    carry_out(index, step);
    (void)dispatch(*nodes_[index], [this](auto& machine) {
      if (!only_events) machine.precompute();
      return Step{};
    });
  }
  void carry_out(std::size_t index, Step step) {
    Node& n = *nodes_[index];
    for (;;) {
      if (step.completed != nullptr) record(index, *step.completed);
      n.action = step.action;
      n.ready = now_ + work_ticks;
      if (n.action.kind == Action::Kind::kTransmit) {
        (void)dispatch(n, [](auto& machine) {
          machine.finish_signing();
          return Step{};
        });
        n.outgoing.assign(n.action.frame.begin(), n.action.frame.end());
        if (true_time(n, n.action.at) - before() >= n.ready) return;
        step = dispatch(n, [&](auto& machine) { return machine.on_late(local(n, n.ready)); });
        continue;
      }
      const double from = n.action.kind == Action::Kind::kListen ? true_time(n, n.action.at) : n.ready;
      n.busy_from = std::max(from, n.ready);
      if (n.action.kind == Action::Kind::kNone || true_time(n, n.action.until) > n.busy_from) return;
      step = dispatch(n, [&](auto& machine) { return machine.on_timeout(local(n, n.ready)); });
    }
  }

  void record(std::size_t index, const mac::Exchange& exchange) {
    for (std::size_t i = 0; i < exchange.count; ++i) {
      double truth_m = 0.0;
      for (const auto& other : nodes_) {
        if (other->settings.id == exchange.legs[i].anchor) {
          truth_m = std::abs(other->settings.x_m - nodes_[index]->settings.x_m);
        }
      }
      ranges.push_back({nodes_[index]->settings.id, exchange.legs[i].anchor, exchange.superframe,
                        mac::evaluate(exchange, exchange.legs[i]), truth_m});
    }
  }

  // Processes one event: the end of a frame or of a listening period. False: there is none before `end`.
  bool step(double end) {
    double first = end;
    std::size_t actor = kGhost;
    const Frame* ghost = nullptr;
    for (std::size_t i = 0; i < nodes_.size(); ++i) {
      const Node& n = *nodes_[i];
      if (!n.on || n.action.kind == Action::Kind::kNone) continue;
      const bool sends = n.action.kind == Action::Kind::kTransmit;
      const double t =
          sends ? true_time(n, leaves_at(n.action)) + after(n.outgoing.size()) : true_time(n, n.action.until);
      if (t < first) {
        first = t;
        actor = i;
      }
    }
    for (const Frame& g : ghosts_) {
      if (g.rmarker + after(g.bytes.size()) < first) {
        first = g.rmarker + after(g.bytes.size());
        ghost = &g;
      }
    }
    if (ghost == nullptr && actor == kGhost) return false;
    now_ = first;
    if (ghost != nullptr) {
      const Frame frame = *ghost;
      ghosts_.erase(ghosts_.begin() + (ghost - ghosts_.data()));
      transmit(frame);
      return true;
    }
    Node& n = *nodes_[actor];
    if (n.action.kind != Action::Kind::kTransmit) {
      arm(actor, dispatch(n, [&](auto& machine) { return machine.on_timeout(local(n, now_)); }));
      return true;
    }
    const ClockTime timestamp = n.action.at;
    witness_.see(n.outgoing);
    transmit({actor, true_time(n, leaves_at(n.action)), n.settings.x_m, n.outgoing});
    arm(actor, dispatch(n, [&](auto& machine) { return machine.on_transmitted(timestamp); }));
    return true;
  }

  void transmit(const Frame& frame) {
    if (overheard) overheard(frame);
    if (jammed && jammed(frame)) return;
    const double start = frame.rmarker - before();
    const double end = frame.rmarker + after(frame.bytes.size());
    bool collided = false;
    std::vector<std::size_t> receivers;
    for (std::size_t i = 0; i < nodes_.size(); ++i) {
      if (i == frame.source || !nodes_[i]->on || !audible(frame.source, i)) continue;
      if (disturbed(i, frame.source, start, end)) {
        collided = true;
      } else {
        receivers.push_back(i);
      }
    }
    past_.push_back({frame.source, start, end});
    if (past_.size() > 64) past_.erase(past_.begin(), past_.begin() + 32);
    collisions += collided ? 1 : 0;
    for (const std::size_t i : receivers) hear(i, frame, start, end);
  }

  [[nodiscard]] bool audible(std::size_t source, std::size_t receiver) const {
    return !reach || source == kGhost || reach(source, receiver);
  }
  // Whether a frame other than that of `source` collides with it at `receiver`.
  [[nodiscard]] bool disturbed(std::size_t receiver, std::size_t source, double start, double end) const {
    for (const Past& past : past_) {
      if (past.source != receiver && past.end > start && past.start < end && audible(past.source, receiver)) {
        return true;
      }
    }
    for (std::size_t i = 0; i < nodes_.size(); ++i) {
      const Node& n = *nodes_[i];
      if (i == source || i == receiver || !n.on || n.action.kind != Action::Kind::kTransmit) continue;
      if (!audible(i, receiver)) continue;
      const double other = true_time(n, leaves_at(n.action));
      if (jammed && jammed({i, other, n.settings.x_m, n.outgoing})) continue;
      if (other - before() < end && other + after(n.outgoing.size()) > start) return true;
    }
    return false;
  }

  void hear(std::size_t index, const Frame& frame, double start, double end) {
    Node& n = *nodes_[index];
    if (!n.on || index == frame.source) return;
    if (n.action.kind != Action::Kind::kListen && n.action.kind != Action::Kind::kListenNow) return;
    const double flight = std::abs(frame.x_m - n.settings.x_m) / kMetresPerTick;
    if (n.busy_from > start + flight || true_time(n, n.action.until) < end + flight) return;
    if (lost && lost(frame, index)) return;
    const double sender_ppm =
        frame.source == kGhost ? n.settings.offset_ppm : nodes_[frame.source]->settings.offset_ppm;
    const double offset_ppb = (sender_ppm - n.settings.offset_ppm) * 1e3;
    mac::Reception reception{
        .timestamp = local(n, frame.rmarker + flight + timestamp_noise_ticks * gaussian()),
        .timestamp_valid = true,
        .frame = frame.bytes};
    if (radio_.carrier)
      reception.quality.clock_offset_ppb = static_cast<std::int32_t>(std::lround(offset_ppb));
    if (spoil) spoil(index, reception);
    (void)dispatch(n, [&](auto& machine) {
      if (!only_events) machine.begin_verify(reception.frame);
      return Step{};
    });
    arm(index, dispatch(n, [&](auto& machine) { return machine.on_received(reception); }));
  }

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
