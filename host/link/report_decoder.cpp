#include "host/link/report_decoder.hpp"

#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>

#include "proto/compact_report.hpp"

namespace groma::link {
namespace {

constexpr double kBitsPerByte = 10.0;  // start, eight data, stop

static_assert(wire::kMaxPayload >= groma_NodeToHost_size);

constexpr std::uint64_t kLargestTime_dtu =
    static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max() / 2);

float power_dbm(bool known, std::int32_t cdbm) {
  return known ? 0.01F * static_cast<float>(cdbm) : model::kUnknown;
}

// Time of the range in network time, in ticks; 0: unknown.
std::int64_t network_time_dtu(const groma_SlotReport& report, const groma_Range& range) {
  if (report.network_time_dtu == 0 || report.network_time_dtu > kLargestTime_dtu) return 0;
  const double drift_dtu = static_cast<double>(range.instant_offset_dtu) * 1e-9 * report.network_rate_ppb;
  return static_cast<std::int64_t>(report.network_time_dtu) + range.instant_offset_dtu +
         std::llround(drift_dtu);
}

}  // namespace

std::vector<std::uint8_t> request_frame(const groma_HostToNode& message) {
  std::array<std::uint8_t, groma_HostToNode_size> payload{};
  pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
  if (!pb_encode(&stream, groma_HostToNode_fields, &message)) return {};
  const auto content = std::span(payload).first(stream.bytes_written);
  std::vector<std::uint8_t> frame(wire::max_encoded_size(content.size()));
  frame.resize(wire::encode_frame(content, frame));
  return frame;
}

const char* role_word(const groma_Role& role) noexcept {
  switch (number_in(role)) {
    case groma_Role_ROLE_TAG:
      return "tag";
    case groma_Role_ROLE_ANCHOR:
      return "anchor";
    default:
      return "unconfigured";
  }
}

const char* sync_word(const groma_SyncState& state) noexcept {
  switch (number_in(state)) {
    case groma_SyncState_SYNC_LOCKED:
      return "locked";
    case groma_SyncState_SYNC_COASTING:
      return "coasting";
    default:
      return "searching";
  }
}

std::vector<std::uint8_t> time_request(double now_s) {
  groma_HostToNode message = groma_HostToNode_init_zero;
  message.which_body = groma_HostToNode_time_request_tag;
  message.body.time_request.host_time_ns = static_cast<std::uint64_t>(std::llround(now_s * 1e9));
  return request_frame(message);
}

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
  if (message_.source_id != 0) return sink.on_relayed(message_);
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
    case groma_NodeToHost_slack_tag:
      sink.on_slack(message_.body.slack);
      break;
    case groma_NodeToHost_log_tag:
      sink.on_log(message_.body.log);
      break;
    case groma_NodeToHost_time_reply_tag:
      take_time_reply(message_.body.time_reply, arrival_s);
      break;
    case groma_NodeToHost_reply_tag:
      sink.on_reply(message_.body.reply);
      break;
    default:
      // Empty, or a message of a newer schema.
      --counters_.messages;
      ++counters_.messages_malformed;
  }
}

void ReportDecoder::take_report(const groma_SlotReport& report, double arrival_s, NodeSink& sink) {
  if (report.tag_id > std::numeric_limits<model::NodeId>::max() ||
      report.device_time_dtu > kLargestTime_dtu) {
    --counters_.messages;
    ++counters_.messages_malformed;
    return;
  }
  const ReportKey key{report.device_time_dtu, report.sequence, report.tag_id};
  if (is_repeated(key)) {
    ++counters_.reports_repeated;
    return;
  }
  count_lost(key);
  const auto ticks = static_cast<std::int64_t>(report.device_time_dtu);
  const double transmitted_s = transmission_s(frames_.encoded_size());
  // The times of its ranges share the error of the report's time.
  if (time_.observe(ticks, arrival_s, transmitted_s) == clock::Observation::kEarly) {
    counters_.ranges_bad_instant += report.ranges_count;
    return;
  }

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
      sink.on_range(
          {.t_s = time_.to_host(ticks + range.instant_offset_dtu)->t_s,
           .tag_id = static_cast<model::NodeId>(report.tag_id),
           .anchor_id = static_cast<model::NodeId>(range.anchor_id),
           .range_m = range_m,
           .first_path_power_dbm = power_dbm(range.has_first_path_power_cdbm, range.first_path_power_cdbm),
           .receive_power_dbm = power_dbm(range.has_receive_power_cdbm, range.receive_power_cdbm),
           .clock_offset_ppm = range.has_clock_offset_ppb
                                   ? 0.001F * static_cast<float>(range.clock_offset_ppb)
                                   : model::kUnknown,
           .noise = range.noise != 0 ? static_cast<float>(range.noise) : model::kUnknown,
           .line_of_sight = static_cast<model::LineOfSight>(range.flags & 3),
           .corrections = static_cast<std::uint8_t>(range.flags & ~3),
           .network_time_dtu = network_time_dtu(report, range)});
    }
  }
}

// Only the request's way is observed here. The reports show the delay of the way back: they come in the
// order of their times, while a reply may overtake a report that is being written.
void ReportDecoder::take_time_reply(const groma_TimeReply& reply, double arrival_s) {
  const double asked_s = 1e-9 * static_cast<double>(reply.host_time_ns);
  const bool ours = asked_s <= arrival_s && arrival_s - asked_s <= kMaxRoundTrip_s;
  if (!ours || reply.received_dtu > reply.transmitted_dtu || reply.transmitted_dtu > kLargestTime_dtu) {
    ++counters_.time_replies_unmatched;
    return;
  }
  ++counters_.time_replies;
  time_.observe_request(static_cast<std::int64_t>(reply.received_dtu),
                        asked_s + transmission_s(time_request(asked_s).size()));
}

double ReportDecoder::transmission_s(std::size_t bytes) const noexcept {
  return baud_ > 0.0 ? kBitsPerByte * static_cast<double>(bytes) / baud_ : 0.0;
}

bool ReportDecoder::is_repeated(const ReportKey& report) const noexcept {
  // The usual case needs no search.
  if (!last_report_ || report.device_time_dtu > last_report_->device_time_dtu) return false;
  const auto end = remembered_.begin() + static_cast<std::ptrdiff_t>(
                                             std::min<std::uint64_t>(counters_.reports, remembered_.size()));
  return std::find(remembered_.begin(), end, report) != end;
}

void ReportDecoder::count_lost(const ReportKey& report) noexcept {
  remembered_.at(counters_.reports % remembered_.size()) = report;
  ++counters_.reports;
  if (last_report_ && report.tag_id != last_report_->tag_id) {
    time_.reset();
  } else if (last_report_ && report.device_time_dtu > last_report_->device_time_dtu) {
    const std::uint32_t missing = report.sequence - last_report_->sequence - 1;
    const double elapsed_s = static_cast<double>(report.device_time_dtu - last_report_->device_time_dtu) /
                             clock::kDeviceTicksPerSecond;
    if (missing <= kMaxReports_hz * elapsed_s) counters_.frames_lost += missing;
  }
  last_report_ = report;
}

}  // namespace groma::link
