// What a node tells the host, in the schema's form.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/mac/synchronizer.hpp"
#include "firmware/core/node/platform.hpp"
#include "groma.pb.h"
#include "proto/frame_codec.hpp"
#include "proto/slot_report.hpp"

namespace groma::node {

inline constexpr std::uint32_t kProtocolVersion = 1;

// Cuts what does not fit.
void copy_text(std::span<char> out, const char* text) noexcept;

// How a tag's ranges are made and told.
struct Ranging {
  bool raw_stamps = false;
  bool correct_temperature = false;  // where both ends' temperature, or supply, is known
  bool correct_power_bias = false;
  std::optional<dw1000::Ambient> ambient{};  // of the tag's chip
};

// Evaluates the exchange's ranges; counts those completed and lost into `counters`. `device_time` is now.
void fill_slot_report(groma_SlotReport& report, const mac::Exchange& exchange, ranging::ClockTime device_time,
                      const Ranging& ranging, groma_Counters& counters) noexcept;
// The same in pieces, for who cannot spare the time at once: all but the ranges, then each of them.
void begin_slot_report(groma_SlotReport& report, const mac::Exchange& exchange,
                       ranging::ClockTime device_time) noexcept;
void fill_range(groma_SlotReport& report, std::size_t index, const mac::Exchange& exchange,
                ranging::ClockTime device_time, const Ranging& ranging, groma_Counters& counters) noexcept;

// As a frame carries it.
[[nodiscard]] mac::Health health_of(const dw1000::Ambient& ambient) noexcept;

// A slot report becomes a compact one.
void make_compact(groma_NodeToHost& message) noexcept;

// `config`: the one in force, or nothing. `radio_error`: empty where the radio came up.
void fill_hello(groma_Hello& hello, const Build& build, const std::optional<groma_Config>& config,
                ResetReason reset_reason, const std::optional<Fault>& last_fault, const StackUse& stack,
                const char* radio_error) noexcept;

[[nodiscard]] groma_SyncState sync_state_of(mac::SyncState state) noexcept;

// The configuration of a reply, in its encoded form; nothing where the reply has none, or holds it itself.
using ReplyConfig = std::optional<std::span<const std::uint8_t>>;

// Writes the message to the start of `out`, as nanopb does; its size, 0 where it does not fit. nanopb goes
// over nested messages again to learn their length, eight times over a schedule in a reply: `config`, of a
// reply without one of its own, is put in as it is.
[[nodiscard]] std::size_t encode_message(const groma_NodeToHost& message, const ReplyConfig& config,
                                         std::span<std::uint8_t> out) noexcept;

// Encodes and frames messages in a buffer of its own.
class MessageEncoder {
 public:
  // One whole frame, valid until the next call; empty where the message does not fit, which no message of the
  // schema does. `config` as of encode_message().
  [[nodiscard]] std::span<const std::uint8_t> encode(const groma_NodeToHost& message,
                                                     const ReplyConfig& config = {}) noexcept;
  // A message of another node, encoded already, with that node's id as its source.
  [[nodiscard]] std::span<const std::uint8_t> encode_of(std::span<const std::uint8_t> message,
                                                        std::uint16_t source) noexcept;

  // A slot report in pieces: begin(), put_range() from the last range to the first, close(), then step()
  // until it is true; then frame() is as encode() would have given it. Each takes at most some 30 us at 64
  // MHz.
  void begin(const groma_SlotReport& report) noexcept { report_.begin(report, buffer_); }
  void put_range(const groma_Range& range) noexcept { report_.put_range(range); }
  void close(const groma_SlotReport& report) noexcept;
  [[nodiscard]] bool step() noexcept;
  [[nodiscard]] std::span<const std::uint8_t> frame() const noexcept {
    return std::span(buffer_).first(frame_bytes_);
  }

 private:
  // The first so many bytes of the buffer, moved to its end and framed.
  [[nodiscard]] std::span<const std::uint8_t> frame_first(std::size_t bytes) noexcept;

  // The payload is written at its end and framed to its beginning.
  std::array<std::uint8_t, wire::max_encoded_size(groma_NodeToHost_size)> buffer_{};
  wire::SlotReportWriter report_;
  std::span<const std::uint8_t> payload_;  // what of it is still to be framed
  wire::FrameWriter writer_{buffer_};
  std::size_t frame_bytes_ = 0;
};

}  // namespace groma::node
