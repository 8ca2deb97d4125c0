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
  // Upper edges of the histogram's first bins, as the schema states them; a negative slack is a missed
  // deadline.
  static constexpr std::array<std::int32_t, 7> kEdges_us{0, 10, 20, 50, 100, 200, 500};

  void clear() noexcept { slots_ = {}; }

  void add(mac::SlotKind kind, std::int32_t slack_us) noexcept {
    if (kind == mac::SlotKind::kNone) return;
    Slot& slot = slots_[static_cast<std::size_t>(kind)];
    const auto bin = std::upper_bound(kEdges_us.begin(), kEdges_us.end(), slack_us) - kEdges_us.begin();
    slot.least_us = slot.any ? std::min(slot.least_us, slack_us) : slack_us;
    slot.any = true;
    ++slot.counts[static_cast<std::size_t>(bin)];
  }

  void fill(groma_Slack& out) const noexcept {
    for (std::size_t kind = 0; kind < slots_.size(); ++kind) {
      const Slot& slot = slots_[kind];
      if (!slot.any) continue;
      groma_SlotSlack& entry = out.slots[out.slots_count++];
      entry.kind = static_cast<groma_SlotKind>(kind);
      entry.least_us = slot.least_us;
      entry.counts_count = static_cast<pb_size_t>(slot.counts.size());
      std::copy(slot.counts.begin(), slot.counts.end(), entry.counts);
    }
  }

 private:
  struct Slot {
    bool any = false;
    std::int32_t least_us = 0;
    std::array<std::uint32_t, kEdges_us.size() + 1> counts{};
  };
  std::array<Slot, static_cast<std::size_t>(mac::SlotKind::kNone)> slots_{};
  static_assert(static_cast<std::size_t>(mac::SlotKind::kNone) ==
                std::extent_v<decltype(groma_Slack::slots)>);
  static_assert(kEdges_us.size() + 1 == std::extent_v<decltype(groma_SlotSlack::counts)>);
};

}  // namespace groma::node
