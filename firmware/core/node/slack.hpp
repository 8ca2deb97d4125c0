// How long before its deadline the radio was armed, for each kind of slot: minimum and histogram.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "firmware/core/mac/step.hpp"
#include "groma.pb.h"

namespace groma::node {

class Slack {
 public:
  void clear() noexcept { slots_ = {}; }

  // A negative slack is a missed deadline. SlotKind::kNone has none.
  void add(mac::SlotKind kind, std::int32_t slack_us) noexcept {
    if (kind == mac::SlotKind::kNone) return;
    groma_SlotSlack& slot = slots_[static_cast<std::size_t>(kind)];
    if (slot.counts_count == 0) {
      slot.kind = static_cast<groma_SlotKind>(kind);
      slot.least_us = slack_us;
      slot.counts_count = kEdges_us.size() + 1;
    }
    slot.least_us = std::min(slot.least_us, slack_us);
    ++slot.counts[std::upper_bound(kEdges_us.begin(), kEdges_us.end(), slack_us) - kEdges_us.begin()];
  }

  // Into an empty message.
  void fill(groma_Slack& out) const noexcept {
    for (const groma_SlotSlack& slot : slots_) {
      if (slot.counts_count != 0) out.slots[out.slots_count++] = slot;
    }
  }

 private:
  // Upper edges of the histogram's first bins, as the schema states them.
  static constexpr std::array<std::int32_t, 7> kEdges_us{0, 10, 20, 50, 100, 200, 500};
  static_assert(kEdges_us.size() + 1 == std::extent_v<decltype(groma_SlotSlack::counts)>);

  std::array<groma_SlotSlack, std::extent_v<decltype(groma_Slack::slots)>> slots_{};
  static_assert(static_cast<std::size_t>(mac::SlotKind::kNone) ==
                std::extent_v<decltype(groma_Slack::slots)>);
};

}  // namespace groma::node
