// What a node tells the host, in the schema's form.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/mac/synchronizer.hpp"
#include "firmware/core/node/platform.hpp"
#include "groma.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::node {

inline constexpr std::uint32_t kProtocolVersion = 1;

// Cuts what does not fit.
void copy_text(std::span<char> out, const char* text) noexcept;

// Evaluates the exchange's ranges; counts those completed and lost into `counters`. `device_time` is now.
void fill_slot_report(groma_SlotReport& report, const mac::Exchange& exchange, ranging::ClockTime device_time,
                      bool with_raw_stamps, groma_Counters& counters) noexcept;

// A slot report becomes a compact one.
void make_compact(groma_NodeToHost& message) noexcept;

// `config`: the one in force, or nothing. `radio_error`: empty where the radio came up.
void fill_hello(groma_Hello& hello, const Build& build, const std::optional<groma_Config>& config,
                ResetReason reset_reason, const std::optional<Fault>& last_fault, const StackUse& stack,
                const char* radio_error) noexcept;

[[nodiscard]] groma_SyncState sync_state_of(mac::SyncState state) noexcept;

// Encodes and frames messages in two buffers of its own.
class MessageEncoder {
 public:
  // One whole frame, valid until the next call; empty where the message does not fit, which no message of the
  // schema does.
  [[nodiscard]] std::span<const std::uint8_t> encode(const groma_NodeToHost& message) noexcept;

 private:
  std::array<std::uint8_t, groma_NodeToHost_size> payload_{};
  std::array<std::uint8_t, wire::max_encoded_size(groma_NodeToHost_size)> frame_{};
};

}  // namespace groma::node
