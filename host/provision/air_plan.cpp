#include "host/provision/air_plan.hpp"

#include <fmt/format.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <set>
#include <span>
#include <vector>

#include "firmware/core/dw1000/phy.hpp"
#include "firmware/core/mac/anchor_set.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/sim/can_bits.hpp"
#include "proto/can_segment.hpp"
#include "proto/compact_report.hpp"
#include "proto/frame_codec.hpp"
#include "proto/slot_report.hpp"

namespace groma::provision {

namespace {

using mac::Superframe;
using ranging::Ticks;

double seconds(Ticks ticks) {
  return static_cast<double>(ticks.count()) / static_cast<double>(Ticks::kPerSecond);
}

// A tag's report of maximum size: all ranges good, all numbers of maximum length.
groma_SlotReport report_of(const groma_Config& config, std::size_t ranges) {
  groma_SlotReport report = groma_SlotReport_init_zero;
  report.sequence = 1U << 30;
  report.superframe = 1U << 30;
  report.slot = 1;
  report.tag_id = config.schedule.tag_ids[0];
  report.device_time_dtu = std::uint64_t{1} << 56;
  report.network_time_dtu = std::uint64_t{1} << 56;
  report.network_rate_ppb = -17'000;
  report.ranges_count = static_cast<pb_size_t>(ranges);
  for (std::size_t i = 0; i < ranges; ++i) {
    groma_Range& range = report.ranges[i];
    range.anchor_id = config.schedule.anchor_ids[0];
    range.status = groma_RangeStatus_RANGE_OK;
    range.instant_offset_dtu = -(std::int64_t{1} << 30);
    range.range_m = 12.345F;
    range.has_first_path_power_cdbm = range.has_receive_power_cdbm = range.has_clock_offset_ppb = true;
    range.first_path_power_cdbm = -9'500;
    range.receive_power_cdbm = -9'000;
    range.clock_offset_ppb = -17'000;
    range.noise = 1'000;
    range.flags = 63;
    range.has_raw = config.report_raw_stamps;
    if (range.has_raw) {
      range.raw.tag_round_dtu = range.raw.anchor_reply_dtu = std::uint64_t{1} << 28;
      range.raw.anchor_round_dtu = range.raw.tag_reply_dtu = std::uint64_t{1} << 30;
    }
  }
  return report;
}

std::vector<std::uint8_t> framed(std::span<const std::uint8_t> payload) {
  std::vector<std::uint8_t> frame(wire::max_encoded_size(payload.size()));
  frame.resize(wire::encode_frame(payload, frame));
  return frame;
}

std::vector<std::uint8_t> full_report(const groma_Config& config, std::size_t ranges) {
  std::vector<std::uint8_t> payload(groma_NodeToHost_size);
  return framed(wire::encode_slot_report(report_of(config, ranges), payload));
}

std::vector<std::uint8_t> compact_report(const groma_Config& config, std::size_t ranges) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_compact_report_tag;
  wire::compact_report(report_of(config, ranges), message.body.compact_report);
  std::vector<std::uint8_t> payload(groma_NodeToHost_size);
  pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
  payload.resize(pb_encode(&stream, groma_NodeToHost_fields, &message) ? stream.bytes_written : 0);
  return framed(payload);
}

// Time on the bus, with the space between frames.
double bus_time_s(std::span<const std::uint8_t> stream, wire::CanFormat format, std::uint16_t node,
                  double nominal_bit_per_s, double data_bit_per_s) {
  double time_s = 0.0;
  wire::CanFrame frame{.id = wire::can_id({wire::CanDirection::kToHost, node})};
  while (!stream.empty()) {
    stream = stream.subspan(wire::cut_can_payload(stream, format, frame));
    const sim::CanBits bits = sim::can_bits(frame);
    time_s += (bits.nominal + sim::kIntermissionBits) / nominal_bit_per_s + bits.data / data_bit_per_s;
  }
  return time_s;
}

std::vector<LinkLoad> loads(const groma_Config& config, const AirPlan& plan, unsigned baud) {
  constexpr double kBitsPerByte = 10.0;
  const double reports_per_s = 1.0 / plan.superframe_s;  // of one tag
  const double ranges = static_cast<double>(plan.responses);
  const auto tags = static_cast<double>(plan.tags);
  const double nominal = config.can_nominal_bit_per_s == 0 ? 1e6 : config.can_nominal_bit_per_s;
  const double data = config.can_data_bit_per_s == 0 ? 2e6 : config.can_data_bit_per_s;
  const auto id = config.schedule.tag_ids[0];
  const auto full = full_report(config, plan.responses);
  const auto compact = compact_report(config, plan.responses);
  const double uart_s = static_cast<double>(full.size()) * kBitsPerByte / baud;
  const double can_s = bus_time_s(compact, wire::CanFormat::kClassic, id, nominal, nominal);
  const double fd_s = bus_time_s(full, wire::CanFormat::kFd, id, nominal, data);
  return {{"UART", static_cast<double>(full.size()), uart_s * reports_per_s, ranges / uart_s},
          {"CAN", static_cast<double>(compact.size()), can_s * reports_per_s * tags, ranges / can_s},
          {"CAN FD", static_cast<double>(full.size()), fd_s * reports_per_s * tags, ranges / fd_s}};
}

void warn(const groma_Config& config, AirPlan& plan) {
  const groma_Schedule& schedule = config.schedule;
  const auto say = [&](std::string text) { plan.warnings.push_back(std::move(text)); };
  constexpr double kFull = 0.9;
  const LinkLoad& link = plan.links.at(config.link == groma_Link_LINK_CAN      ? 1
                                       : config.link == groma_Link_LINK_CAN_FD ? 2
                                                                               : 0);
  if (link.busy > kFull) {
    // A compact report has no raw timestamps.
    const bool raw = config.report_raw_stamps && config.link != groma_Link_LINK_CAN;
    say(fmt::format(
        "{} would be busy {:.0f} % of the time: reports will be lost; {}take more bit/s, a faster "
        "link, or a longer response gap",
        link.name, 100.0 * link.busy, raw ? "turn report_raw_stamps off, or " : ""));
  }
  if (schedule.turn_round_us < mac::kUsualTurnaround_us) {
    say(
        fmt::format("schedule.turn_round_us: {} is less than {}, which is proven for the image; frames may "
                    "be sent late: watch "
                    "'slack us' in groma nodes",
                    schedule.turn_round_us, mac::kUsualTurnaround_us));
  }
  if (const auto usual_us = mac::usual_gap_us(schedule.arm_ahead, config.network_key.size != 0);
      schedule.response_gap_us < usual_us) {
    say(
        fmt::format("schedule.response_gap_us: {} is less than {}, which is proven for the image{}; tags may "
                    "miss responses: "
                    "watch 'slack us' in groma nodes",
                    schedule.response_gap_us, usual_us, schedule.arm_ahead ? " with arm_ahead" : ""));
  }
  if (schedule.backup_ids_count == 0 && schedule.anchor_ids_count > 1) {
    say(fmt::format("schedule.backup_ids: none, so that the site stops without anchor {}; name one or more",
                    schedule.master_id));
  }
  if (plan.open_slots_per_s < 1.0) {
    say(fmt::format(
        "only {:.2f} shared slots a second are open: joining and commands over the air will take minutes",
        plan.open_slots_per_s));
  }
}

// The long-run mean number of places in a POLL that go to trials and yield no range: an anchor that answers
// its trial is not polled again unless it is better than those in use. `reached`: the unused anchors
// answer.
double trials(std::size_t places, std::size_t anchors, bool reached) {
  if (anchors <= places) return 0.0;
  const double share = mac::AnchorSet::shares(reached);
  const double price = mac::AnchorSet::price(places);
  // Left out are the anchors beyond the places and those whose places go to trials.
  const double earned = share * static_cast<double>(anchors - places) / (price - share);
  return std::min(earned, static_cast<double>(mac::AnchorSet::most_trials(places)));
}

}  // namespace

double range_success(groma_RangingMethod method, double frame_success) {
  // POLL, RESPONSE and the closing frame; the anchor returns the closing timestamp in the next RESPONSE,
  // which needs the next POLL. With METHOD_DS_NEXT_POLL that POLL is the closing frame.
  const int frames = method == groma_RangingMethod_METHOD_DS_FINAL ? 5 : 4;
  return std::pow(frame_success, frames);
}

AirPlan plan_air(const groma_Config& config, unsigned baud) {
  const groma_Schedule& schedule = config.schedule;
  const bool secured = config.network_key.size != 0;
  const radio::Phy phy = dw1000::phy_of(node::radio_settings(config).preamble);
  const Superframe superframe(schedule, phy, secured);
  AirPlan plan;
  plan.superframe_s = seconds(superframe.duration());
  plan.beacon_s = seconds(superframe.shared() - superframe.beacon());
  plan.slot_s = seconds(superframe.tag_slot());
  plan.slots = superframe.slot_count();
  plan.shared_s = plan.superframe_s - plan.beacon_s - static_cast<double>(plan.slots) * plan.slot_s;
  plan.tags = schedule.tag_ids_count;
  plan.responses = std::min<std::size_t>(superframe.responses(), schedule.anchor_ids_count);
  std::set<std::size_t> used;
  for (std::size_t i = 0; i < plan.tags; ++i) {
    used.insert(mac::configured_slot(schedule, schedule.tag_ids[i]).value_or(0));
  }
  const bool one_cell = used.size() == plan.tags;
  const auto responses = static_cast<double>(plan.responses);
  plan.tag_ranges_per_s =
      (responses - trials(plan.responses, schedule.anchor_ids_count, one_cell)) / plan.superframe_s;
  plan.ranges_per_s = plan.tag_ranges_per_s * static_cast<double>(plan.tags);

  const auto air_s = [&](std::size_t bytes) { return seconds(phy.air_time(superframe.on_air(bytes))); };
  const double beacon_s = air_s(mac::beacon_bytes(plan.slots, false));
  const double tag_s =
      air_s(mac::poll_bytes(plan.responses)) + (superframe.has_final() ? air_s(mac::kFinalBytes) : 0.0);
  const double exchange_s = tag_s + responses * air_s(mac::kResponseBytes);
  const auto slots_used = static_cast<double>(used.size());
  plan.bound_ranges_per_s = static_cast<double>(plan.tags) * responses / (beacon_s + slots_used * exchange_s);
  const double turns = schedule.backup_ids_count + 1.0;
  const double relayed_s = beacon_s * schedule.backup_ids_count / turns;
  plan.air_use = (beacon_s + relayed_s + slots_used * exchange_s) / plan.superframe_s;
  plan.tag_duty = tag_s / plan.superframe_s;
  plan.anchor_duty = slots_used * air_s(mac::kResponseBytes) / plan.superframe_s;
  plan.master_duty = plan.anchor_duty + beacon_s / plan.superframe_s;
  plan.open_slots_per_s = 1.0 / (turns * plan.superframe_s);
  plan.links = loads(config, plan, baud);
  warn(config, plan);
  return plan;
}

}  // namespace groma::provision
