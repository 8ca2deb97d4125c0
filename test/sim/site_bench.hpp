// A whole site of native nodes in free space, and what its tags report.
#pragma once

#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <stdexcept>
#include <string>
#include <vector>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/core/ranging/device_time.hpp"
#include "firmware/core/security/block_cipher.hpp"
#include "firmware/sim/native_node.hpp"
#include "firmware/sim/network.hpp"
#include "groma.pb.h"
#include "proto/compact_report.hpp"
#include "proto/frame_codec.hpp"

namespace groma::sim {

inline double seconds_of(const mac::Superframe& superframe) {
  return static_cast<double>(superframe.duration().count()) / static_cast<double>(ranging::Ticks::kPerSecond);
}

struct Place {
  double x_m = 0.0;
  double y_m = 0.0;
  double z_m = 0.0;
};

class FreeSpace : public PropagationModel {
 public:
  void put(std::uint16_t id, const Place& place) { places_[id] = place; }
  [[nodiscard]] double distance_m(std::uint16_t a, std::uint16_t b) const {
    const Place& p = place(a);
    const Place& q = place(b);
    return std::hypot(p.x_m - q.x_m, p.y_m - q.y_m, p.z_m - q.z_m);
  }
  [[nodiscard]] Propagation between(std::uint16_t a, std::uint16_t b, double /*t_s*/) const override {
    const double d_m = distance_m(a, b);
    const double power_dbm = -59.0 - 20.0 * std::log10(d_m);
    return {.audible = power_dbm > -100.0,
            .flight_m = d_m,
            .receive_power_dbm = power_dbm,
            .first_path_power_dbm = power_dbm - hidden_db};
  }

  double hidden_db = 2.0;  // power outside the first path

 protected:
  [[nodiscard]] const Place& place(std::uint16_t id) const { return places_.at(id); }

 private:
  std::map<std::uint16_t, Place> places_;
};

// A command's frame as the host sends it.
inline std::vector<std::uint8_t> frame_of(const groma_HostToNode& command) {
  std::vector<std::uint8_t> payload(groma_HostToNode_size);
  pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
  if (!pb_encode(&stream, groma_HostToNode_fields, &command)) throw std::logic_error(PB_GET_ERROR(&stream));
  std::vector<std::uint8_t> frame(wire::max_encoded_size(stream.bytes_written));
  frame.resize(wire::encode_frame(std::span(payload).first(stream.bytes_written), frame));
  return frame;
}

// Decodes one node's bytes.
class Listener {
 public:
  struct Report {
    SimTime t = 0;  // of its last byte
    groma_SlotReport body;
  };

  void take(std::span<const TimedByte> bytes) {
    for (const TimedByte& byte : bytes) {
      if (!decoder_.push(byte.value)) continue;
      groma_NodeToHost message = groma_NodeToHost_init_zero;
      const auto payload = decoder_.payload();
      pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
      if (!pb_decode(&stream, groma_NodeToHost_fields, &message)) {
        ++undecodable;
        continue;
      }
      if (message.source_id != 0) {
        relayed.push_back(message);
        continue;
      }
      switch (message.which_body) {
        case groma_NodeToHost_slot_report_tag:
          reports.push_back({byte.t, message.body.slot_report});
          break;
        case groma_NodeToHost_compact_report_tag:
          ++compact_reports;
          if (groma_SlotReport report = groma_SlotReport_init_zero;
              wire::expand_report(message.body.compact_report, report)) {
            reports.push_back({byte.t, report});
          } else {
            ++undecodable;
          }
          break;
        case groma_NodeToHost_hello_tag:
          hellos.push_back(message.body.hello);
          break;
        case groma_NodeToHost_counters_tag:
          counters = message.body.counters;
          break;
        case groma_NodeToHost_network_status_tag:
          status = message.body.network_status;
          break;
        case groma_NodeToHost_slack_tag:
          slack = message.body.slack;
          break;
        case groma_NodeToHost_log_tag:
          logs.emplace_back(message.body.log.text);
          break;
        case groma_NodeToHost_time_reply_tag:
          time_replies.push_back(message.body.time_reply);
          break;
        case groma_NodeToHost_reply_tag:
          replies.push_back(message.body.reply);
          break;
        default:
          ++undecodable;
          break;
      }
    }
  }

  std::vector<Report> reports;
  std::vector<groma_Hello> hellos;
  std::vector<groma_Reply> replies;
  std::vector<groma_NodeToHost> relayed;  // from other nodes, received over the air
  std::vector<groma_TimeReply> time_replies;
  std::vector<std::string> logs;
  groma_Counters counters = groma_Counters_init_zero;
  groma_Slack slack = groma_Slack_init_zero;
  groma_NetworkStatus status = groma_NetworkStatus_init_zero;
  int undecodable = 0;
  int compact_reports = 0;

  [[nodiscard]] const wire::FrameCounters& frames() const noexcept { return decoder_.counters(); }

 private:
  wire::FrameDecoder decoder_;
};

struct SiteSettings {
  int tags = 1;
  int anchors = 3;
  groma_RangingMethod method = groma_RangingMethod_METHOD_DS_FINAL;
  groma_Preamble preamble = groma_Preamble_PREAMBLE_128;
  MediumSettings medium{.timestamp_noise_s = 0.0, .carrier_noise_ppm = 0.0};
  std::uint64_t seed = 1;
  double spread_ppm = 20.0;  // clock offsets are spread evenly over +- this
  std::uint32_t turn_round_us = mac::kUsualTurnaround_us;
  std::uint32_t response_gap_us = 0;  // 0: mac::usual_gap_us()
  std::uint32_t guard_us = mac::kUsualGuard_us;
  bool arm_ahead = false;
  std::optional<security::Key> network_key{};  // each frame carries a MIC
  double drift_ppm_per_s = 0.0;                // up on the odd nodes, down on the even ones, from 1 s to 11 s
  double spi_transaction_us = CpuSettings{}.spi_transaction_us;
  std::uint32_t uart_bits_per_s = 1'000'000;
  // Change a node's configuration and chip. Called for the tags first.
  std::function<void(groma_Config&)> configure = [](groma_Config&) {};
  std::function<void(ChipSpec&)> equip = [](ChipSpec&) {};
  bool raw_stamps = true;  // in the reports
  // Makes a node. Called for the tags first.
  std::function<std::unique_ptr<NodeHost>(const NodeSpec&, Medium&)> make_node = make_native_node;
};

inline std::uint16_t nth_tag(int i) {
  return static_cast<std::uint16_t>(1 + i);
}
inline std::uint16_t nth_anchor(int i) {
  return static_cast<std::uint16_t>(101 + i);
}

// Configuration of a node in a site of settings.tags tags and settings.anchors anchors, of which the first is
// the master.
template <class Settings>
groma_Config config_by(const Settings& settings, std::uint16_t id, groma_Role role, std::uint32_t epoch) {
  groma_Config config = groma_Config_init_zero;
  config.role = role;
  config.id = id;
  config.network_id = 7;
  config.has_schedule = true;
  config.preamble = settings.preamble;
  config.transmit_antenna_delay_dtu = 16436;
  config.receive_antenna_delay_dtu = 16436;
  config.report_raw_stamps = true;
  if (settings.network_key) {
    config.network_key.size = security::kBlockBytes;
    std::copy(settings.network_key->begin(), settings.network_key->end(), config.network_key.bytes);
  }
  groma_Schedule& schedule = config.schedule;
  schedule.epoch = epoch;
  schedule.master_id = nth_anchor(0);
  for (int i = 0; i < settings.tags; ++i) schedule.tag_ids[schedule.tag_ids_count++] = nth_tag(i);
  for (int i = 0; i < settings.anchors; ++i) schedule.anchor_ids[schedule.anchor_ids_count++] = nth_anchor(i);
  schedule.method = settings.method;
  schedule.turn_round_us = settings.turn_round_us;
  schedule.response_gap_us = settings.response_gap_us != 0
                                 ? settings.response_gap_us
                                 : mac::usual_gap_us(settings.arm_ahead, settings.network_key.has_value());
  schedule.guard_us = settings.guard_us;
  schedule.arm_ahead = settings.arm_ahead;
  return config;
}

// Tags 1, 2, ...; anchors 101, 102, ..., the first of them the master.
class SiteBench {
 public:
  explicit SiteBench(const SiteSettings& settings)
      : settings_(settings), network(space, settings.medium, settings.seed) {
    for (int i = 0; i < settings.tags; ++i) add(nth_tag(i), groma_Role_ROLE_TAG, i);
    for (int i = 0; i < settings.anchors; ++i) add(nth_anchor(i), groma_Role_ROLE_ANCHOR, settings.tags + i);
    listeners.resize(network.size());
    traces_.assign(network.size(), 0xCBF29CE484222325ULL);
  }

  [[nodiscard]] groma_Config config_of(std::uint16_t id, groma_Role role) const {
    groma_Config config = config_by(settings_, id, role, 1);
    config.report_raw_stamps = settings_.raw_stamps;
    settings_.configure(config);
    return config;
  }

  [[nodiscard]] mac::Superframe superframe() const {
    const groma_Config config = config_of(nth_tag(0), groma_Role_ROLE_TAG);
    return mac::Superframe(config.schedule, dw1000::phy_of(node::radio_settings(config).preamble),
                           settings_.network_key.has_value());
  }

  void run_until(double t_s) {
    network.run_until(from_seconds(t_s));
    std::vector<TimedByte> bytes;
    for (std::size_t i = 0; i < network.size(); ++i) {
      bytes.clear();
      network.take(i, bytes);
      for (const TimedByte& byte : bytes)
        traces_[i] = (traces_[i] ^ byte.value ^ static_cast<std::uint64_t>(byte.t)) * 0x100000001B3ULL;
      listeners[i].take(bytes);
    }
  }

  // For each node: a hash over each byte on its line and the byte's time.
  [[nodiscard]] const std::vector<std::uint64_t>& line_traces() const { return traces_; }

  template <class F>
  void each_range(F&& f, double from_s = 0.0) const {
    for (std::size_t i = 0; i < static_cast<std::size_t>(settings_.tags); ++i)
      for (const Listener::Report& report : listeners[i].reports) {
        if (to_seconds(report.t) < from_s) continue;
        for (pb_size_t k = 0; k < report.body.ranges_count; ++k) f(report.body, report.body.ranges[k]);
      }
  }
  [[nodiscard]] int good_ranges(double from_s = 0.0) const {
    int count = 0;
    each_range([&](const auto&,
                   const groma_Range& range) { count += range.status == groma_RangeStatus_RANGE_OK ? 1 : 0; },
               from_s);
    return count;
  }

 private:
  void add(std::uint16_t id, groma_Role role, int index) {
    const int count = settings_.tags + settings_.anchors;
    // Consecutive nodes lie far apart in frequency. Tags are near the floor, anchors around them.
    const double turn = std::fmod(static_cast<double>(index) * 0.618034, 1.0);
    const double angle = 6.2831853 * static_cast<double>(index) / static_cast<double>(count);
    space.put(id, role == groma_Role_ROLE_TAG ? Place{1.0 + index, 0.7 * index, 0.5}
                                              : Place{14.0 * std::cos(angle), 9.0 * std::sin(angle), 2.7});
    NodeSpec spec;
    spec.chip.id = id;
    spec.chip.clock.offset_ppm = settings_.spread_ppm * (2.0 * turn - 1.0);
    spec.chip.clock.first_tick = static_cast<std::uint64_t>(index) * std::uint64_t{0x1234'5678'9A};
    spec.chip.clock.drift_ppm_per_s = (index % 2 == 0 ? -1.0 : 1.0) * settings_.drift_ppm_per_s;
    spec.chip.clock.drift_from_s = 1.0;
    spec.chip.clock.drift_until_s = 11.0;
    spec.cpu.spi_transaction_us = settings_.spi_transaction_us;
    spec.uart.bits_per_s = settings_.uart_bits_per_s;
    spec.power_on = SimTime{index} * 7 * kUnitsPerMillisecond;
    settings_.equip(spec.chip);
    const groma_Config config = config_of(id, role);
    std::array<std::uint8_t, node::kMaxConfigBytes> blob{};
    const std::size_t size = node::encode_config(config, blob);
    spec.stored_config.assign(blob.begin(), blob.begin() + static_cast<std::ptrdiff_t>(size));
    network.add(settings_.make_node(spec, network.medium()));
  }

  SiteSettings settings_;
  std::vector<std::uint64_t> traces_;

 public:
  FreeSpace space;
  Network network;
  std::vector<Listener> listeners;
};

}  // namespace groma::sim
