// The node's messages to the host, in the schema's form.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/node/platform.hpp"
#include "firmware/core/radio/radio.hpp"
#include "groma.pb.h"
#include "proto/frame_codec.hpp"
#include "proto/slot_report.hpp"

namespace groma::node {

inline constexpr std::uint32_t kProtocolVersion = 1;

// Truncates a text that does not fit.
void copy_text(std::span<char> out, const char* text) noexcept;

// Fills a report of the exchange in steps: all fields except the ranges, then each range, corrected as
// `config` says for what is known of both ends; `ambient`: of the tag's chip. Counts completed and lost
// ranges in `counters`. `device_time` is now.
void begin_slot_report(groma_SlotReport& report, const mac::Exchange& exchange,
                       ranging::ClockTime device_time) noexcept;
void fill_range(groma_SlotReport& report, std::size_t index, const mac::Exchange& exchange,
                ranging::ClockTime device_time, const groma_Config& config,
                const std::optional<radio::Ambient>& ambient, groma_Counters& counters) noexcept;

// Converts to the units of a frame.
[[nodiscard]] mac::Health health_of(const radio::Ambient& ambient) noexcept;

// Replaces a slot report by a compact one.
void make_compact(groma_NodeToHost& message) noexcept;

// `config`: the one in force, if any. `radio_error`: empty if the radio came up.
void fill_hello(groma_Hello& hello, const Build& build, const std::optional<groma_Config>& config,
                ResetReason reset_reason, const std::optional<Fault>& last_fault, const StackUse& stack,
                const char* radio_error) noexcept;

// Where a message goes: to the host unasked, or as the answer to a command.
struct ReplyContext {
  enum class Way : std::uint8_t {
    kHost,   // over the link that the configuration in force selects
    kAsker,  // over the link that last delivered bytes to the node
    kAir,    // into the answer that the air link collects
  };
  Way way = Way::kHost;
  std::uint32_t request_id = 0;  // of the command

  [[nodiscard]] static ReplyContext link(std::uint32_t request_id) noexcept {
    return {Way::kAsker, request_id};
  }
  [[nodiscard]] static ReplyContext air(std::uint32_t request_id) noexcept { return {Way::kAir, request_id}; }
  [[nodiscard]] bool by_air() const noexcept { return way == Way::kAir; }
};

// The encoded configuration of a reply; nothing if the reply has none or contains it itself.
using ReplyConfig = std::optional<std::span<const std::uint8_t>>;

// How a command ended.
struct Outcome {
  groma_Result result = groma_Result_RESULT_OK;
  const char* text = "";  // at most 63 characters, empty if the result says all
  ReplyConfig config{};
};
[[nodiscard]] inline Outcome invalid(const char* text) noexcept {
  return {groma_Result_RESULT_INVALID, text};
}
[[nodiscard]] inline Outcome unsupported(const char* text) noexcept {
  return {groma_Result_RESULT_UNSUPPORTED, text};
}

// Writes the message to the start of `out`, as nanopb does, but in less time: nanopb encodes nested messages
// again to find their length, a schedule in a reply eight times; `config`, for a reply that does not contain
// one, is therefore copied in encoded form. Returns the size, 0 if the message does not fit.
[[nodiscard]] std::size_t encode_message(const groma_NodeToHost& message, const ReplyConfig& config,
                                         std::span<std::uint8_t> out) noexcept;

// Encodes and frames messages in its own buffers.
class MessageEncoder {
 public:
  // Returns one whole frame, valid until the next call; empty if the message does not fit, which no message
  // of the schema causes. `config` as in encode_message().
  [[nodiscard]] std::span<const std::uint8_t> encode(const groma_NodeToHost& message,
                                                     const ReplyConfig& config = {}) noexcept;
  // Frames an encoded message of another node, with that node's id as source_id.
  [[nodiscard]] std::span<const std::uint8_t> encode_of(std::span<const std::uint8_t> message,
                                                        std::uint16_t source) noexcept;

  // Encodes a slot report in steps: begin(), put_range() from the last range to the first, close(), then
  // step() until it returns true. frame() is then what encode() would return. Each step takes at most about
  // 30 us at 64 MHz.
  void begin(const groma_SlotReport& report) noexcept { report_.begin(report, encoded_); }
  void put_range(const groma_Range& range) noexcept { report_.put_range(range); }
  void close(const groma_SlotReport& report) noexcept;
  [[nodiscard]] bool step() noexcept;
  [[nodiscard]] std::span<const std::uint8_t> frame() const noexcept {
    return std::span(frame_).first(frame_bytes_);
  }

 private:
  [[nodiscard]] std::span<const std::uint8_t> frame_of(std::span<const std::uint8_t> payload) noexcept;

  std::array<std::uint8_t, groma_NodeToHost_size> encoded_{};
  std::array<std::uint8_t, wire::max_encoded_size(groma_NodeToHost_size)> frame_{};
  wire::SlotReportWriter report_;
  std::span<const std::uint8_t> payload_;  // the part that is not framed yet
  wire::FrameWriter writer_{frame_};
  std::size_t frame_bytes_ = 0;
};

}  // namespace groma::node
