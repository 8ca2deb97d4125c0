// A site under injected faults, and all ranges that its tags report: each with its error against the geometry
// and the sigma that follows from its own intervals.
//
// Tags 1, 2, ... drive in circles; anchors 101, 102, ... are fixed around them: the first is the master, the
// next ones are the ranked back-ups. Strangers are nodes of other networks.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <map>
#include <numbers>
#include <optional>
#include <set>
#include <stdexcept>
#include <tuple>
#include <utility>
#include <variant>
#include <vector>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/native_node.hpp"
#include "firmware/sim/network.hpp"
#include "test/sim/site_bench.hpp"
#include "test/support/frames.hpp"

namespace groma::sim {

// Circular motion at constant speed; stationary if the radius is 0.
struct Motion {
  Place centre;
  double radius_m = 0.0;
  double turn_radps = 0.0;
  [[nodiscard]] Place at(double t_s) const {
    const double angle = turn_radps * t_s;
    return {centre.x_m + radius_m * std::cos(angle), centre.y_m + radius_m * std::sin(angle), centre.z_m};
  }
};

class Hall final : public PropagationModel {
 public:
  void put(std::uint16_t id, const Motion& motion) { motions_[id] = motion; }
  [[nodiscard]] double distance_m(std::uint16_t a, std::uint16_t b, double t_s) const {
    const Place p = motions_.at(a).at(t_s);
    const Place q = motions_.at(b).at(t_s);
    return std::hypot(p.x_m - q.x_m, p.y_m - q.y_m, p.z_m - q.z_m);
  }
  [[nodiscard]] Propagation between(std::uint16_t a, std::uint16_t b, double t_s) const override {
    const double d_m = distance_m(a, b, t_s);
    const double power_dbm = -59.0 - 20.0 * std::log10(std::max(d_m, 0.1));
    return {.audible = power_dbm > -100.0,
            .flight_m = d_m,
            .receive_power_dbm = power_dbm,
            .first_path_power_dbm = power_dbm - 2.0};
  }

 private:
  std::map<std::uint16_t, Motion> motions_;
};

inline std::optional<mac::Frame> parsed(const AirFrame& frame) {
  return mac::parse(std::span(frame.data).first(frame.length - 2U)).frame;
}

// A predicate for Fade::hits.
template <class BodyType>
bool is_a(const AirFrame& frame, std::uint16_t /*from*/ = 0, std::uint16_t /*to*/ = 0) {
  const auto content = parsed(frame);
  return content && std::holds_alternative<BodyType>(content->body);
}

inline constexpr std::uint16_t kFirstStranger = 1000;  // ids from here on belong to other networks

// Ground truth of what was on the air and how receptions ended.
class AirLog final : public Witness {
 public:
  explicit AirLog(const Medium& medium) : medium_(medium) {}

  struct Sent {
    std::uint16_t transmitter;
    AirFrame frame;
  };
  void announced(const AirFrame& frame) override {
    if (keep_sent) sent.push_back({medium_.id_of(frame.source), frame});
    if (!counting_ || medium_.id_of(frame.source) >= kFirstStranger) return;
    const auto content = parsed(frame);
    if (!content) return;
    if (const auto* poll = std::get_if<mac::Poll>(&content->body)) {
      exchanges_[{content->source, poll->exchange}].polled = poll->count;
    } else if (const auto* response = std::get_if<mac::Response>(&content->body)) {
      exchanges_[{content->destination, response->exchange}].answers.insert(content->source);
    }
  }
  void overlapped(const AirFrame& lost, const AirFrame& /*by*/, std::uint16_t receiver) override {
    if (!wants(receiver, lost)) return;
    if (!lost_frames_.emplace(receiver, lost.source, lost.number).second) return;
    ++collisions;
    if (!counting_ || receiver >= kFirstStranger) return;
    const auto content = parsed(lost);
    if (const auto* response = std::get_if<mac::Response>(&content->body))
      exchanges_[{receiver, response->exchange}].answers.erase(content->source);
    if (const auto* final = std::get_if<mac::Final>(&content->body))
      exchanges_[{content->source, final->exchange}].unclosed.insert(receiver);
  }
  void reception_ended(std::uint16_t receiver, std::uint64_t event) override {
    groma_Counters& seen = endings[receiver];
    switch (event) {
      case status::kRxfcg:
        ++seen.frames_received;
        break;
      case status::kRxfce:
        ++seen.crc_errors;
        break;
      case status::kRxphe:
      case status::kRxrfsl:
        ++seen.header_errors;
        break;
      case status::kRxsfdto:
        ++seen.sfd_timeouts;
        break;
      case status::kRxpto:
        ++seen.preamble_timeouts;
        break;
      case status::kRxrfto:
        ++seen.frame_timeouts;
        break;
      default:
        throw std::logic_error("no such end of a reception");
    }
  }

  // A beacon addresses every listener, a POLL the anchors that it names, any other frame its destination.
  static bool wants(std::uint16_t receiver, const AirFrame& frame) {
    const auto content = parsed(frame);
    if (!content) return false;
    if (const auto* poll = std::get_if<mac::Poll>(&content->body))
      return std::count(poll->anchors.begin(), poll->anchors.begin() + poll->count, receiver) > 0;
    return content->destination == receiver || content->destination == mac::kBroadcast;
  }

  // Starts or stops counting the exchanges of the site's tags.
  void count_exchanges(bool on) {
    counting_ = on;
    if (on) exchanges_.clear();
  }
  // The share of all ranges due in so many superframes that the overlaps left possible: a range needs a POLL,
  // its RESPONSE, a FINAL if the method has one, and the next POLL and its RESPONSE. An anchor that missed
  // the POLL did not answer; a tag may have skipped its turn.
  [[nodiscard]] double possible_share(double superframes) const {
    std::map<std::uint16_t, std::size_t> polled;
    std::size_t possible = 0;
    for (const auto& [key, exchange] : exchanges_) {
      polled[key.first] = std::max(polled[key.first], exchange.polled);
      const auto next = exchanges_.find({key.first, static_cast<std::uint16_t>(key.second + 1)});
      if (next == exchanges_.end()) continue;
      for (const std::uint16_t anchor : exchange.answers) {
        if (!exchange.unclosed.contains(anchor) && next->second.answers.contains(anchor)) ++possible;
      }
    }
    double due = 0.0;
    for (const auto& [tag, anchors] : polled) due += static_cast<double>(anchors) * superframes;
    return due == 0.0 ? 0.0 : static_cast<double>(possible) / due;
  }

  bool keep_sent = false;
  std::vector<Sent> sent;
  // Frames that an overlap corrupted or masked at a receiver that listened for them.
  std::uint64_t collisions = 0;
  std::map<std::uint16_t, groma_Counters> endings;  // only the counters of how receptions end

 private:
  struct Counted {
    std::size_t polled = 0;
    std::set<std::uint16_t> answers;   // anchors whose RESPONSE was sent and not overlapped at the tag
    std::set<std::uint16_t> unclosed;  // anchors at which the FINAL was overlapped
  };
  const Medium& medium_;
  bool counting_ = false;
  std::map<std::pair<std::uint16_t, std::uint16_t>, Counted> exchanges_;  // by tag and number
  std::set<std::tuple<std::uint16_t, std::size_t, std::uint32_t>> lost_frames_;
};

struct FaultSiteSettings {
  int tags = 3;  // in the schedule
  int anchors = 12;
  int backups = 3;
  int slots = 4;
  int responses = 0;
  groma_RangingMethod method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  groma_Preamble preamble = groma_Preamble_PREAMBLE_128;
  std::uint32_t turn_round_us = mac::kUsualTurnaround_us;
  std::uint32_t response_gap_us = 0;  // 0: mac::usual_gap_us()
  std::uint32_t guard_us = mac::kUsualGuard_us;
  bool arm_ahead = false;
  std::optional<security::Key> network_key{};  // each frame carries a MIC
  MediumSettings medium{.timestamp_noise_s = 1e-10};
  std::uint64_t seed = 1;
  double crystals_ppm = 10.0;  // offsets lie within +- this
  double drift_ppm = 10.0;     // amplitude of a periodic drift, up or down from the offset
  double drift_rate_ppm_per_s = 1.0;
  double until_s = 200.0;  // the longest that the run may last
  std::function<std::unique_ptr<NodeHost>(const NodeSpec&, Medium&)> make_node = make_native_node;
};

// A range, good or not.
struct SeenRange {
  double at_s = 0.0;  // world time of the range, or of its report if it is not good
  std::uint16_t tag = 0;
  std::uint16_t anchor = 0;
  bool good = false;
  double error_m = 0.0;
  double sigma_m = 0.0;
};

class FaultSite {
 public:
  explicit FaultSite(const FaultSiteSettings& settings)
      : settings_(settings), network(hall, settings.medium, settings.seed), air(network.medium()) {
    network.medium().set_witness(&air);
    for (int i = 0; i < settings.tags; ++i)
      add(nth_tag(i), groma_Role_ROLE_TAG, from_seconds(0.011 * i),
          config_of(nth_tag(i), groma_Role_ROLE_TAG));
    for (int i = 0; i < settings.anchors; ++i)
      add(nth_anchor(i), groma_Role_ROLE_ANCHOR, from_seconds(0.007 * i),
          config_of(nth_anchor(i), groma_Role_ROLE_ANCHOR));
  }
  FaultSite(const FaultSite&) = delete;
  FaultSite& operator=(const FaultSite&) = delete;
  ~FaultSite() { network.medium().set_witness(nullptr); }

  [[nodiscard]] groma_Config config_of(std::uint16_t id, groma_Role role) const {
    groma_Config config = config_by(settings_, id, role, 2);
    groma_Schedule& schedule = config.schedule;
    for (int i = 0; i < settings_.backups; ++i)
      schedule.backup_ids[schedule.backup_ids_count++] = nth_anchor(1 + i);
    schedule.slots = static_cast<std::uint32_t>(settings_.slots);
    schedule.responses = static_cast<std::uint32_t>(settings_.responses);
    return config;
  }

  [[nodiscard]] mac::Superframe superframe() const {
    return superframe(config_of(nth_tag(0), groma_Role_ROLE_TAG));
  }
  [[nodiscard]] mac::Superframe superframe(const groma_Config& config) const {
    return {config.schedule, dw1000::phy_of(node::radio_settings(config).preamble),
            settings_.network_key.has_value()};
  }
  [[nodiscard]] double superframe_s() const { return seconds_of(superframe()); }

  // Adds a node that the schedule does not list, or one of another network. Call before `power_on`.
  void add(std::uint16_t id, groma_Role role, SimTime power_on, const groma_Config& config) {
    const auto index = static_cast<int>(network.size());
    const KeyedRandom draw = KeyedRandom(settings_.seed).of(0xC10C, id);
    hall.put(id, place_of(id, role));
    NodeSpec spec;
    spec.chip.id = id;
    spec.chip.clock.offset_ppm = draw.of(1).uniform(-settings_.crystals_ppm, settings_.crystals_ppm);
    spec.chip.clock.first_tick = draw.of(2).bits() & ((std::uint64_t{1} << 40) - 1);
    if (settings_.drift_rate_ppm_per_s > 0.0)
      spec.chip.clock.more_ramps =
          up_and_down(index % 2 == 0 ? settings_.drift_rate_ppm_per_s : -settings_.drift_rate_ppm_per_s,
                      settings_.drift_ppm, draw.of(3).uniform(0.0, 3.0), settings_.until_s);
    spec.power_on = power_on;
    std::array<std::uint8_t, node::kMaxConfigBytes> blob{};
    const std::size_t size = node::encode_config(config, blob);
    spec.stored_config.assign(blob.begin(), blob.begin() + static_cast<std::ptrdiff_t>(size));
    nodes_[id] = network.add(settings_.make_node(spec, network.medium()));
    ids_.push_back(id);
    listeners_.emplace_back();
  }

  [[nodiscard]] double now_s() const { return to_seconds(network.now()); }
  void run_until(double t_s) {
    for (const SimTime end = from_seconds(t_s); network.now() < end;) {
      network.run_until(std::min(end, network.now() + from_seconds(0.5)));
      collect();
    }
  }
  void run_for(double duration_s) { run_until(now_s() + duration_s); }

  // ---- faults --------------------------------------------------------------------------------------------
  void set_power(std::uint16_t id, bool on) { network.set_power(nodes_.at(id), on); }
  void lose(double probability, double for_s,
            std::function<bool(const AirFrame&, std::uint16_t, std::uint16_t)> hits = {}) {
    network.medium().add_fade({.from = network.now(),
                               .until = network.now() + from_seconds(for_s),
                               .probability = probability,
                               .hits = std::move(hits)},
                              network.now());
  }
  // No frame passes between these nodes and the others.
  void cut_off(std::set<std::uint16_t> ids, double for_s) {
    network.medium().add_fade(
        {.from = network.now(),
         .until = network.now() + from_seconds(for_s),
         .silent = true,
         .hits = [ids = std::move(ids)](const AirFrame&, std::uint16_t a,
                                        std::uint16_t b) { return ids.contains(a) != ids.contains(b); }},
        network.now());
  }
  // Cuts the node's power at `fraction` of its next frame of that type, for `for_s`.
  template <class BodyType>
  void brown_out(std::uint16_t id, double fraction, double for_s) {
    const AirFrame frame = next_frame<BodyType>(id);
    network.run_until(frame.preamble_start +
                      static_cast<SimTime>(fraction * static_cast<double>(frame.end - frame.preamble_start)));
    set_power(id, false);
    run_for(for_s);
    set_power(id, true);
  }

  // Adds another network of two tags and four anchors in the same hall, with its own schedule and timeline.
  void second_network(std::uint32_t network_id, int serial) {
    constexpr int kTags = 2;
    constexpr int kAnchors = 4;
    const auto first = static_cast<std::uint16_t>(kFirstStranger + 100 * serial);
    groma_Config config = config_of(nth_tag(0), groma_Role_ROLE_TAG);
    config.network_id = network_id;
    groma_Schedule& schedule = config.schedule;
    schedule.epoch = 1;
    schedule.tag_ids_count = 0;
    schedule.anchor_ids_count = 0;
    schedule.backup_ids_count = 0;
    schedule.slots = 0;
    for (int i = 0; i < kTags; ++i)
      schedule.tag_ids[schedule.tag_ids_count++] = static_cast<std::uint16_t>(first + i);
    for (int i = 0; i < kAnchors; ++i)
      schedule.anchor_ids[schedule.anchor_ids_count++] = static_cast<std::uint16_t>(first + 10 + i);
    schedule.master_id = schedule.anchor_ids[0];
    schedule.response_gap_us = gap_out_of_step(config);
    for (int i = 0; i < kTags + kAnchors; ++i) {
      config.role = i < kTags ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR;
      config.id = static_cast<std::uint32_t>(i < kTags ? first + i : first + 10 + i - kTags);
      const auto id = static_cast<std::uint16_t>(config.id);
      add(id, config.role, network.now() + from_seconds(0.003 * i), config);
      strangers_.insert(id);
    }
  }
  // The response gap at which the other network's frames spread evenly over the site's superframe: the ratio
  // of the two superframes has the fractional part 0.382 (golden section). If the two are nearly
  // commensurate, the same frames collide every time, and the product of the frame successes does not give
  // the share of ranges.
  [[nodiscard]] std::uint32_t gap_out_of_step(groma_Config config) const {
    constexpr double kStep = 0.382;
    const std::uint32_t shortest = config.schedule.response_gap_us;
    std::uint32_t best = shortest;
    double least_off = 1.0;
    for (std::uint32_t gap_us = shortest; gap_us < shortest + 100U; ++gap_us) {
      config.schedule.response_gap_us = gap_us;
      const double ratio = superframe_s() / seconds_of(superframe(config));
      const double off = std::abs(ratio - std::floor(ratio) - kStep);
      if (off < least_off) {
        least_off = off;
        best = gap_us;
      }
    }
    return best;
  }
  void end_second_network() {
    for (const std::uint16_t id : strangers_) set_power(id, false);
    strangers_.clear();
  }

  // ---- what was seen -------------------------------------------------------------------------------------
  [[nodiscard]] const std::vector<SeenRange>& ranges() const { return ranges_; }
  [[nodiscard]] Listener& listener(std::uint16_t id) { return listeners_.at(nodes_.at(id)); }
  [[nodiscard]] Dw1000Chip& chip(std::uint16_t id) { return network.node(nodes_.at(id)).chip(); }
  [[nodiscard]] const std::vector<std::uint16_t>& ids() const { return ids_; }
  [[nodiscard]] bool powered(std::uint16_t id) { return chip(id).powered(); }

  // Sends a command over the node's serial line.
  void send(std::uint16_t id, const groma_HostToNode& command) {
    if (!network.send(nodes_.at(id), frame_of(command))) throw std::logic_error("the line is full");
  }
  // Requests the node's current counters.
  groma_Counters counters(std::uint16_t id) {
    groma_HostToNode command = groma_HostToNode_init_zero;
    command.request_id = ++requests_;
    command.which_body = groma_HostToNode_get_counters_tag;
    send(id, command);
    for (int i = 0; i < 100; ++i) {
      run_for(0.001);
      const auto& replies = listener(id).replies;
      if (replies.empty() || replies.back().request_id != requests_) continue;
      run_for(0.005);  // the counters follow
      return listener(id).counters;
    }
    throw std::runtime_error("node " + std::to_string(id) + " does not answer");
  }

  // Standard deviation of a range with these intervals, from the noise and rounding of its three receive
  // timestamps. See docs/explanation/ranging.md.
  [[nodiscard]] double sigma_m(const groma_RawStamps& raw) const {
    const auto ra = static_cast<double>(raw.tag_round_dtu);
    const auto db = static_cast<double>(raw.anchor_reply_dtu);
    const auto rb = static_cast<double>(raw.anchor_round_dtu);
    const auto da = static_cast<double>(raw.tag_reply_dtu);
    const double sum = ra + rb + da + db;
    const double timestamp_m =
        std::hypot(settings_.medium.timestamp_noise_s, 15.65e-12 / std::sqrt(12.0)) * 299'792'458.0;
    return timestamp_m * std::hypot(da / sum, (rb + db) / sum, ra / sum);
  }

 private:
  template <class BodyType>
  AirFrame next_frame(std::uint16_t id) {
    air.keep_sent = true;
    air.sent.clear();
    for (const double from_s = now_s(); now_s() < from_s + 5.0;) {
      network.run_until(network.now() + 20 * kUnitsPerMicrosecond);
      for (const AirLog::Sent& sent : air.sent) {
        if (sent.transmitter != id || sent.frame.preamble_start < network.now()) continue;
        if (!is_a<BodyType>(sent.frame)) continue;
        const AirFrame found = sent.frame;
        air.keep_sent = false;
        return found;
      }
      air.sent.clear();
    }
    throw std::runtime_error("node " + std::to_string(id) + " sends no such frame");
  }

  // Tags are near the floor, anchors around them under the ceiling; strangers likewise.
  [[nodiscard]] Motion place_of(std::uint16_t id, groma_Role role) const {
    const KeyedRandom draw = KeyedRandom(settings_.seed).of(0x91ACE, id);
    if (role == groma_Role_ROLE_TAG)
      return {.centre = {draw.of(1).uniform(-6.0, 6.0), draw.of(2).uniform(-4.0, 4.0), 0.5},
              .radius_m = 2.0,
              .turn_radps = 0.4};
    const double angle = 2.0 * std::numbers::pi * (draw.of(1).uniform(-0.3, 0.3) + id % 100) /
                         static_cast<double>(settings_.anchors);
    return {.centre = {14.0 * std::cos(angle), 9.0 * std::sin(angle), draw.of(2).uniform(2.5, 4.0)}};
  }

  void collect() {
    std::vector<TimedByte> bytes;
    for (std::size_t i = 0; i < network.size(); ++i) {
      bytes.clear();
      network.take(i, bytes);
      Listener& listener = listeners_[i];
      listener.take(bytes);
      for (const Listener::Report& report : listener.reports) note(report);
      listener.reports.clear();
    }
  }

  void note(const Listener::Report& report) {
    for (pb_size_t k = 0; k < report.body.ranges_count; ++k) {
      const groma_Range& range = report.body.ranges[k];
      SeenRange seen{.at_s = to_seconds(report.t),
                     .tag = static_cast<std::uint16_t>(report.body.tag_id),
                     .anchor = static_cast<std::uint16_t>(range.anchor_id),
                     .good = range.status == groma_RangeStatus_RANGE_OK};
      if (seen.good) {
        // The report's delay on the line, some milliseconds, is neglected: the tag moves as many millimetres.
        seen.at_s += static_cast<double>(range.instant_offset_dtu) / 63.8976e9;
        seen.error_m = static_cast<double>(range.range_m) - hall.distance_m(seen.tag, seen.anchor, seen.at_s);
        seen.sigma_m = sigma_m(range.raw);
      }
      ranges_.push_back(seen);
    }
  }

  FaultSiteSettings settings_;
  std::map<std::uint16_t, std::size_t> nodes_;
  std::vector<std::uint16_t> ids_;
  std::vector<Listener> listeners_;
  std::set<std::uint16_t> strangers_;
  std::vector<SeenRange> ranges_;
  std::uint32_t requests_ = 0;

 public:
  Hall hall;
  Network network;
  AirLog air;
};

}  // namespace groma::sim
