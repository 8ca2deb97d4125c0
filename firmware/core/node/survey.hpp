// What an anchor that surveys has found: mean and spread of its ranges to each of the others.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "groma.pb.h"

namespace groma::node {

// Keeps its sums in somebody else's bytes, `room` of each call, which nobody else writes meanwhile.
class SurveySums {
 public:
  static constexpr std::size_t kMaxPairs = sizeof(groma_SurveyReport::pairs) / sizeof(groma_SurveyPair);

  void clear() noexcept { count_ = 0; }
  // Anchors beyond kMaxPairs are left out.
  void add(std::uint16_t anchor, float range_m, std::span<std::uint8_t> room) noexcept;
  // An empty one is filled.
  void fill(groma_SurveyReport& report, std::span<const std::uint8_t> room) const noexcept;

  // By Welford's recurrence.
  struct Sum {
    std::uint16_t anchor = mac::kNobody;
    std::uint16_t count = 0;
    float mean_m = 0.0F;
    float squares_m2 = 0.0F;
  };
  static constexpr std::size_t kRoomBytes = kMaxPairs * sizeof(Sum);

 private:
  std::uint8_t count_ = 0;
};

}  // namespace groma::node
