// The one message that a tag sends hundreds of times a second, encoded without nanopb, which goes over nested
// messages several times: the same bytes in a tenth of the time on a Cortex-M4.
#pragma once

#include <cstdint>
#include <span>

#include "groma.pb.h"

namespace groma::wire {

// The NodeToHost message with this report, byte for byte as nanopb writes it, at the end of `out`; empty
// where it does not fit. groma_NodeToHost_size bytes always do.
[[nodiscard]] std::span<const std::uint8_t> encode_slot_report(const groma_SlotReport& report,
                                                               std::span<std::uint8_t> out) noexcept;

}  // namespace groma::wire
