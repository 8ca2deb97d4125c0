#include "firmware/core/node/messages.hpp"

#include <pb_common.h>
#include <pb_encode.h>

#include <algorithm>

#include "firmware/core/mac/synchronizer.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/core/ranging/corrections.hpp"
#include "proto/compact_report.hpp"

namespace groma::node {
namespace {

// These have the schema's values.
static_assert(static_cast<int>(mac::RangeStatus::kNoResponse) == groma_RangeStatus_RANGE_NO_RESPONSE &&
              static_cast<int>(mac::RangeStatus::kNoClosingTimestamp) ==
                  groma_RangeStatus_RANGE_NO_CLOSING_STAMP &&
              static_cast<int>(mac::RangeStatus::kStale) == groma_RangeStatus_RANGE_STALE &&
              static_cast<int>(mac::RangeStatus::kBadTimestamp) == groma_RangeStatus_RANGE_BAD_STAMP);
static_assert(static_cast<int>(mac::SyncState::kLocked) == groma_SyncState_SYNC_LOCKED &&
              static_cast<int>(mac::SyncState::kCoasting) == groma_SyncState_SYNC_COASTING);
static_assert(static_cast<int>(radio::LineOfSight::kUnlikely) == groma_LineOfSight_LINE_OF_SIGHT_UNLIKELY);

std::uint64_t ticks_of(ranging::Ticks t) noexcept {
  return static_cast<std::uint64_t>(t.count());
}

template <class T>
void set(bool& has, T& field, std::optional<std::int32_t> value) noexcept {
  has = value.has_value();
  field = static_cast<T>(value.value_or(0));
}

// Applies the corrections that are requested and for which the data is known; sets `flags` accordingly.
ranging::FlightTime corrected(ranging::FlightTime flight, const mac::Leg& leg, const groma_Config& config,
                              const std::optional<radio::Ambient>& ambient,
                              std::optional<std::int32_t> receive_power_cdbm, std::uint8_t& flags) noexcept {
  if (config.correct_temperature && ambient) {
    if (leg.health.temperature_c != mac::Health::kUnknown) {
      flight = flight - ranging::temperature_drift(ambient->temperature_cdegc) -
               ranging::temperature_drift(leg.health.temperature_c * 100);
      flags |= groma_RangeFlag_RANGE_FLAG_TEMPERATURE;
    }
    if (leg.health.supply_64ths_v != 0) {
      flight = flight - ranging::supply_drift(ambient->supply_mv) -
               ranging::supply_drift(leg.health.supply_64ths_v * 1000 / 64);
      flags |= groma_RangeFlag_RANGE_FLAG_SUPPLY;
    }
  }
  if (config.correct_power_bias && receive_power_cdbm) {
    flight = flight - ranging::power_bias(*receive_power_cdbm);
    flags |= groma_RangeFlag_RANGE_FLAG_POWER_BIAS;
  }
  return flight;
}

}  // namespace

void copy_text(std::span<char> out, const char* text) noexcept {
  std::size_t i = 0;
  for (; i + 1 < out.size() && text[i] != '\0'; ++i) out[i] = text[i];
  out[i] = '\0';
}

void begin_slot_report(groma_SlotReport& report, const mac::Exchange& exchange,
                       ranging::ClockTime device_time) noexcept {
  report.superframe = exchange.superframe;
  report.slot = exchange.slot;
  report.device_time_dtu = static_cast<std::uint64_t>(device_time.count());
  report.ranges_count = exchange.count;
}

void fill_range(groma_SlotReport& report, std::size_t index, const mac::Exchange& exchange,
                ranging::ClockTime device_time, const groma_Config& config,
                const std::optional<radio::Ambient>& ambient, groma_Counters& counters) noexcept {
  const mac::Leg& leg = exchange.legs[index];
  const mac::Range range = mac::evaluate(exchange, leg);
  groma_Range& out = report.ranges[index];
  out = groma_Range_init_zero;
  out.anchor_id = leg.anchor;
  out.status = static_cast<groma_RangeStatus>(range.status);
  // Without a RESPONSE the instant is that of the POLL, so that the report has a time.
  out.instant_offset_dtu = ((leg.answered ? leg.received : exchange.poll_sent) - device_time).count();
  std::optional<std::int32_t> receive_power_cdbm;
  if (leg.answered) {
    const radio::LinkQuality& link = leg.quality;
    const auto first_path_power_cdbm = radio::power_cdbm(link.first_path_power);
    receive_power_cdbm = radio::power_cdbm(link.receive_power);
    set(out.has_first_path_power_cdbm, out.first_path_power_cdbm, first_path_power_cdbm);
    set(out.has_receive_power_cdbm, out.receive_power_cdbm, receive_power_cdbm);
    set(out.has_clock_offset_ppb, out.clock_offset_ppb, link.clock_offset_ppb);
    out.noise = link.noise;
    out.flags = static_cast<std::uint8_t>(
        radio::line_of_sight(first_path_power_cdbm, receive_power_cdbm, link.peak_distance_64ths));
  }
  const bool good = range.status == mac::RangeStatus::kOk;
  ++(good ? counters.ranges_completed : counters.ranges_lost);
  if (!good) return;
  out.flags |= groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS;
  out.range_m = corrected(range.flight, leg, config, ambient, receive_power_cdbm, out.flags).distance_m();
  out.has_raw = config.report_raw_stamps;
  if (out.has_raw) {
    out.raw = {.tag_round_dtu = static_cast<std::uint32_t>(ticks_of(range.intervals.tag_round)),
               .anchor_reply_dtu = static_cast<std::uint32_t>(ticks_of(range.intervals.anchor_reply)),
               .anchor_round_dtu = ticks_of(range.intervals.anchor_round),
               .tag_reply_dtu = ticks_of(range.intervals.tag_reply)};
  }
}

mac::Health health_of(const radio::Ambient& ambient) noexcept {
  const int rounding = ambient.temperature_cdegc < 0 ? -50 : 50;
  const int temperature_c = (ambient.temperature_cdegc + rounding) / 100;
  const unsigned supply_64ths_v = (ambient.supply_mv * 64U + 500U) / 1000U;
  return {.temperature_c = static_cast<std::int8_t>(std::clamp(temperature_c, -127, 127)),
          .supply_64ths_v = static_cast<std::uint8_t>(std::clamp(supply_64ths_v, 1U, 255U))};
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

std::span<const std::uint8_t> MessageEncoder::encode_of(std::span<const std::uint8_t> message,
                                                        std::uint16_t source) noexcept {
  // A decoder uses the last value of a field.
  pb_ostream_t stream = pb_ostream_from_buffer(encoded_.data(), encoded_.size());
  const bool fits = pb_write(&stream, message.data(), message.size()) &&
                    pb_encode_tag(&stream, PB_WT_VARINT, groma_NodeToHost_source_id_tag) &&
                    pb_encode_varint(&stream, source);
  return frame_of(std::span(encoded_).first(fits ? stream.bytes_written : 0));
}

std::span<const std::uint8_t> MessageEncoder::frame_of(std::span<const std::uint8_t> payload) noexcept {
  if (payload.empty()) return {};
  return std::span(frame_).first(wire::encode_frame(payload, frame_));
}

// Encodes the body once, at the start of `out`, and then moves it behind its tag and length. A node's own
// messages have no source_id.
std::size_t encode_message(const groma_NodeToHost& message, const ReplyConfig& config,
                           std::span<std::uint8_t> out) noexcept {
  pb_field_iter_t field;
  if (!pb_field_iter_begin_const(&field, groma_NodeToHost_fields, &message) ||
      !pb_field_iter_find(&field, message.which_body)) {
    return 0;
  }
  static_assert(groma_Reply_config_tag == 4, "the configuration is the reply's last field");
  pb_ostream_t body = pb_ostream_from_buffer(out.data(), out.size());
  if (!pb_encode(&body, field.submsg_desc, field.pData)) return 0;
  if (config && (!pb_encode_tag(&body, PB_WT_STRING, groma_Reply_config_tag) ||
                 !pb_encode_string(&body, config->data(), config->size()))) {
    return 0;
  }
  constexpr std::size_t kLongestHead = 4;
  static_assert(groma_NodeToHost_size < 1U << 14U);
  std::array<std::uint8_t, kLongestHead> head_bytes{};
  pb_ostream_t head = pb_ostream_from_buffer(head_bytes.data(), head_bytes.size());
  if (!pb_encode_tag(&head, PB_WT_STRING, message.which_body) ||
      !pb_encode_varint(&head, body.bytes_written)) {
    return 0;
  }
  const std::size_t size = head.bytes_written + body.bytes_written;
  if (size > out.size()) return 0;
  std::copy_backward(out.data(), out.data() + body.bytes_written, out.data() + size);
  std::copy_n(head_bytes.data(), head.bytes_written, out.data());
  return size;
}

std::span<const std::uint8_t> MessageEncoder::encode(const groma_NodeToHost& message,
                                                     const ReplyConfig& config) noexcept {
  return frame_of(std::span(encoded_).first(encode_message(message, config, encoded_)));
}

void MessageEncoder::close(const groma_SlotReport& report) noexcept {
  payload_ = report_.finish(report);
  frame_bytes_ = 0;
  if (!payload_.empty()) writer_ = wire::FrameWriter(frame_);
}

bool MessageEncoder::step() noexcept {
  constexpr std::size_t kPiece = 64;
  if (payload_.empty()) return true;
  writer_.put(payload_.first(std::min(kPiece, payload_.size())));
  payload_ = payload_.subspan(std::min(kPiece, payload_.size()));
  if (payload_.empty()) frame_bytes_ = writer_.finish();
  return payload_.empty();
}

}  // namespace groma::node
