#include "host/link/report_decoder.hpp"

#include <pb_decode.h>

#include <cmath>
#include <limits>

#include "proto/compact_report.hpp"

namespace groma::link {
namespace {

constexpr double kBitsPerByte = 10.0;  // start, eight data, stop

static_assert(wire::kMaxPayload >= groma_NodeToHost_size);

float power_dbm(bool known, std::int32_t cdbm) {
  return known ? 0.01F * static_cast<float>(cdbm) : model::kUnknown;
}

}  // namespace

void ReportDecoder::take(std::span<const std::uint8_t> bytes, double arrival_s, NodeSink& sink) {
  for (const std::uint8_t byte : bytes) {
    if (frames_.push(byte)) take_message(arrival_s, sink);
  }
}

void ReportDecoder::link_reopened() noexcept {
  frames_.reset();
  time_.reset();
}

void ReportDecoder::take_message(double arrival_s, NodeSink& sink) {
  const auto payload = frames_.payload();
  pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
  message_ = groma_NodeToHost_init_zero;
  if (!pb_decode(&stream, groma_NodeToHost_fields, &message_)) {
    ++counters_.messages_malformed;
    return;
  }
  ++counters_.messages;
  switch (message_.which_body) {
    case groma_NodeToHost_slot_report_tag:
      take_report(message_.body.slot_report, arrival_s, sink);
      break;
    case groma_NodeToHost_compact_report_tag:
      if (!wire::expand_report(message_.body.compact_report, expanded_)) {
        --counters_.messages;
        ++counters_.messages_malformed;
        break;
      }
      take_report(expanded_, arrival_s, sink);
      break;
    case groma_NodeToHost_hello_tag:
      sink.on_hello(message_.body.hello);
      break;
    case groma_NodeToHost_network_status_tag:
      sink.on_network_status(message_.body.network_status);
      break;
    case groma_NodeToHost_counters_tag:
      sink.on_counters(message_.body.counters);
      break;
    case groma_NodeToHost_log_tag:
      sink.on_log(message_.body.log);
      break;
    case groma_NodeToHost_reply_tag:
      sink.on_reply(message_.body.reply);
      break;
    default:
      // Empty, or a kind that a later schema added.
      --counters_.messages;
      ++counters_.messages_malformed;
  }
}

void ReportDecoder::take_report(const groma_SlotReport& report, double arrival_s, NodeSink& sink) {
  if (report.tag_id > std::numeric_limits<model::NodeId>::max() ||
      report.device_time_dtu > static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max() / 2)) {
    --counters_.messages;
    ++counters_.messages_malformed;
    return;
  }
  count_lost(report);
  const auto ticks = static_cast<std::int64_t>(report.device_time_dtu);
  const double transmission_s =
      baud_ > 0.0 ? kBitsPerByte * static_cast<double>(frames_.encoded_size()) / baud_ : 0.0;
  time_.observe(ticks, arrival_s, transmission_s);

  for (pb_size_t i = 0; i < report.ranges_count; ++i) {
    const groma_Range& range = report.ranges[i];
    const double range_m = static_cast<double>(range.range_m);
    const double offset_s = static_cast<double>(range.instant_offset_dtu) / clock::kDeviceTicksPerSecond;
    if (number_in(range.status) != groma_RangeStatus_RANGE_OK) {
      ++counters_.ranges_not_ok;
    } else if (!(range_m > 0.0 && range_m <= kMaxRange_m)) {
      ++counters_.ranges_out_of_bounds;
    } else if (!(std::abs(offset_s) <= kMaxInstantOffset_s)) {
      ++counters_.ranges_bad_instant;
    } else {
      ++counters_.ranges;
      const clock::HostInstant instant = *time_.to_host(ticks + range.instant_offset_dtu);
      sink.on_range(
          {.t_s = instant.t_s,
           .tag_id = static_cast<model::NodeId>(report.tag_id),
           .anchor_id = static_cast<model::NodeId>(range.anchor_id),
           .range_m = range_m,
           .first_path_power_dbm = power_dbm(range.has_first_path_power_cdbm, range.first_path_power_cdbm),
           .receive_power_dbm = power_dbm(range.has_receive_power_cdbm, range.receive_power_cdbm)},
          instant.sigma_s);
    }
  }
}

void ReportDecoder::count_lost(const groma_SlotReport& report) noexcept {
  ++counters_.reports;
  const bool same_run = has_report_ && report.tag_id == last_tag_id_ &&
                        report.device_time_dtu > last_device_time_dtu_ &&
                        report.sequence - last_sequence_ - 1 < std::numeric_limits<std::uint32_t>::max() / 2;
  if (same_run) {
    counters_.frames_lost += report.sequence - last_sequence_ - 1;
  } else if (has_report_ && report.tag_id != last_tag_id_) {
    time_.reset();
  }
  has_report_ = true;
  last_sequence_ = report.sequence;
  last_device_time_dtu_ = report.device_time_dtu;
  last_tag_id_ = report.tag_id;
}

}  // namespace groma::link
