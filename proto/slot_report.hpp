// The one message that a tag sends hundreds of times a second, encoded without nanopb, which goes over nested
// messages several times: the same bytes in a tenth of the time on a Cortex-M4.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "groma.pb.h"

namespace groma::wire {

// The NodeToHost message with this report, byte for byte as nanopb writes it, at the end of `out`; empty
// where it does not fit. groma_NodeToHost_size bytes always do.
[[nodiscard]] std::span<const std::uint8_t> encode_slot_report(const groma_SlotReport& report,
                                                               std::span<std::uint8_t> out) noexcept;

// The same in pieces, for who cannot spare the time at once: begin(), then put_range() from the report's last
// range to its first, then finish().
class SlotReportWriter {
 public:
  // Writes at the end of `out`.
  void begin(const groma_SlotReport& report, std::span<std::uint8_t> out) noexcept;
  void put_range(const groma_Range& range) noexcept;
  [[nodiscard]] std::span<const std::uint8_t> finish(const groma_SlotReport& report) noexcept;

 private:
  std::span<std::uint8_t> out_;
  std::size_t at_ = 0;  // what is written begins there
  bool overflow_ = false;
};

}  // namespace groma::wire
