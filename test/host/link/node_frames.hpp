// Frames of a node, for tests.
#pragma once

#include <pb_encode.h>

#include <cstdint>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <vector>

#include "groma.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::link::test {

inline std::vector<std::uint8_t> frame_of(const groma_NodeToHost& message) {
  std::vector<std::uint8_t> payload(wire::kMaxPayload);
  pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
  if (!pb_encode(&stream, groma_NodeToHost_fields, &message)) throw std::runtime_error("pb_encode");
  payload.resize(stream.bytes_written);
  std::vector<std::uint8_t> frame(wire::max_encoded_size(payload.size()));
  frame.resize(wire::encode_frame(payload, frame));
  return frame;
}

inline groma_Range make_range(std::uint16_t anchor_id, double range_m, std::int64_t instant_offset_dtu) {
  groma_Range range = groma_Range_init_zero;
  range.anchor_id = anchor_id;
  range.range_m = static_cast<float>(range_m);
  range.instant_offset_dtu = instant_offset_dtu;
  return range;
}

inline groma_NodeToHost make_report(std::uint32_t sequence, std::uint32_t tag_id,
                                    std::uint64_t device_time_dtu, const std::vector<groma_Range>& ranges) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_slot_report_tag;
  groma_SlotReport& report = message.body.slot_report;
  report.sequence = sequence;
  report.tag_id = tag_id;
  report.device_time_dtu = device_time_dtu;
  for (const groma_Range& range : ranges) report.ranges[report.ranges_count++] = range;
  return message;
}

inline groma_NodeToHost make_hello(std::uint32_t id, const std::string& version) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_hello_tag;
  message.body.hello.id = id;
  message.body.hello.role = groma_Role_ROLE_TAG;
  std::snprintf(message.body.hello.version, sizeof(message.body.hello.version), "%s", version.c_str());
  return message;
}

inline groma_NodeToHost make_log(groma_LogLevel level, const std::string& text) {
  groma_NodeToHost message = groma_NodeToHost_init_zero;
  message.which_body = groma_NodeToHost_log_tag;
  message.body.log.level = level;
  std::snprintf(message.body.log.text, sizeof(message.body.log.text), "%s", text.c_str());
  return message;
}

}  // namespace groma::link::test
