#include "firmware/core/node/messages.hpp"

#include <pb_encode.h>

#include "firmware/core/node/config.hpp"
#include "proto/compact_report.hpp"
#include "proto/slot_report.hpp"

namespace groma::node {
namespace {

groma_RangeStatus status_of(mac::RangeStatus status) noexcept {
  switch (status) {
    case mac::RangeStatus::kOk:
      return groma_RangeStatus_RANGE_OK;
    case mac::RangeStatus::kNoResponse:
      return groma_RangeStatus_RANGE_NO_RESPONSE;
    case mac::RangeStatus::kNoClosingStamp:
      return groma_RangeStatus_RANGE_NO_CLOSING_STAMP;
    case mac::RangeStatus::kStale:
      return groma_RangeStatus_RANGE_STALE;
    case mac::RangeStatus::kBadStamp:
      return groma_RangeStatus_RANGE_BAD_STAMP;
  }
  return groma_RangeStatus_RANGE_BAD_STAMP;
}

std::uint64_t ticks_of(ranging::Ticks t) noexcept {
  return static_cast<std::uint64_t>(t.count());
}

void set(bool& has, std::int32_t& field, std::optional<std::int32_t> value) noexcept {
  has = value.has_value();
  field = value.value_or(0);
}

groma_Range range_of(const mac::Exchange& exchange, const mac::Leg& leg, ranging::ClockTime device_time,
                     bool with_raw_stamps) noexcept {
  const mac::Range range = mac::evaluate(exchange, leg);
  groma_Range out = groma_Range_init_zero;
  out.anchor_id = leg.anchor;
  out.status = status_of(range.status);
  // Where there is no range, the instant is that of the POLL, so that the report can be placed in time.
  const ranging::ClockTime instant = leg.answered ? leg.received : exchange.poll_sent;
  out.instant_offset_dtu = (instant - device_time).count();
  if (leg.answered) {
    set(out.has_first_path_power_cdbm, out.first_path_power_cdbm, dw1000::first_path_power_cdbm(leg.quality));
    set(out.has_receive_power_cdbm, out.receive_power_cdbm, dw1000::receive_power_cdbm(leg.quality));
    set(out.has_clock_offset_ppb, out.clock_offset_ppb,
        dw1000::clock_offset_ppb(leg.quality.carrier_integral));
  }
  if (range.status != mac::RangeStatus::kOk) return out;
  out.range_m = range.flight.distance_m();
  out.has_raw = with_raw_stamps;
  if (with_raw_stamps) {
    out.raw = {.tag_round_dtu = ticks_of(range.intervals.tag_round),
               .anchor_reply_dtu = ticks_of(range.intervals.anchor_reply),
               .anchor_round_dtu = ticks_of(range.intervals.anchor_round),
               .tag_reply_dtu = ticks_of(range.intervals.tag_reply)};
  }
  return out;
}

}  // namespace

void copy_text(std::span<char> out, const char* text) noexcept {
  std::size_t i = 0;
  for (; i + 1 < out.size() && text[i] != '\0'; ++i) out[i] = text[i];
  out[i] = '\0';
}

void fill_slot_report(groma_SlotReport& report, const mac::Exchange& exchange, ranging::ClockTime device_time,
                      bool with_raw_stamps, groma_Counters& counters) noexcept {
  report.superframe = exchange.superframe;
  report.slot = exchange.slot;
  report.device_time_dtu = static_cast<std::uint64_t>(device_time.count());
  report.ranges_count = exchange.count;
  for (std::size_t i = 0; i < exchange.count; ++i) {
    report.ranges[i] = range_of(exchange, exchange.legs[i], device_time, with_raw_stamps);
    const bool good = report.ranges[i].status == groma_RangeStatus_RANGE_OK;
    ++(good ? counters.ranges_completed : counters.ranges_lost);
  }
}

void make_compact(groma_NodeToHost& message) noexcept {
  groma_CompactReport compact = groma_CompactReport_init_zero;
  wire::compact_report(message.body.slot_report, compact);
  message.which_body = groma_NodeToHost_compact_report_tag;
  message.body.compact_report = compact;
}

void fill_hello(groma_Hello& hello, const Build& build, const std::optional<groma_Config>& config,
                ResetReason reset_reason, const std::optional<Fault>& last_fault, const StackUse& stack,
                const char* radio_error) noexcept {
  copy_text(hello.version, build.version);
  hello.git_hash = build.git_hash;
  hello.protocol_version = kProtocolVersion;
  if (config) {
    hello.role = config->role;
    hello.id = config->id;
    hello.network_id = config->network_id;
    hello.schedule_hash = schedule_hash_of(*config);
    hello.config_hash = config_hash_of(*config);
  }
  hello.reset_reason = static_cast<groma_ResetReason>(reset_reason);
  hello.has_last_fault = last_fault.has_value();
  if (last_fault) hello.last_fault = {.pc = last_fault->pc, .lr = last_fault->lr, .cfsr = last_fault->cfsr};
  hello.stack_size_bytes = stack.size_bytes;
  hello.stack_high_water_bytes = stack.high_water_bytes;
  copy_text(hello.radio_error, radio_error);
}

groma_SyncState sync_state_of(mac::SyncState state) noexcept {
  switch (state) {
    case mac::SyncState::kSearching:
      return groma_SyncState_SYNC_SEARCHING;
    case mac::SyncState::kLocked:
      return groma_SyncState_SYNC_LOCKED;
    case mac::SyncState::kCoasting:
      return groma_SyncState_SYNC_COASTING;
  }
  return groma_SyncState_SYNC_SEARCHING;
}

std::span<const std::uint8_t> MessageEncoder::encode(const groma_NodeToHost& message) noexcept {
  std::span<const std::uint8_t> payload;
  if (message.which_body == groma_NodeToHost_slot_report_tag) {
    payload = wire::encode_slot_report(message.body.slot_report, payload_);
  } else {
    pb_ostream_t stream = pb_ostream_from_buffer(payload_.data(), payload_.size());
    if (!pb_encode(&stream, groma_NodeToHost_fields, &message)) return {};
    payload = std::span(payload_).first(stream.bytes_written);
  }
  if (payload.empty()) return {};
  return std::span(frame_).first(wire::encode_frame(payload, frame_));
}

}  // namespace groma::node
