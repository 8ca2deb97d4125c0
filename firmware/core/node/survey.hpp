// The results of an anchor's survey: mean and standard deviation of its ranges to each other anchor.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "groma.pb.h"

namespace groma::node {

// Keeps its sums in a borrowed buffer, the `room` of each call, which must not change between calls.
class SurveySums {
 public:
  static constexpr std::size_t kMaxPairs = sizeof(groma_SurveyReport::pairs) / sizeof(groma_SurveyPair);

  void clear() noexcept { count_ = 0; }
  // Ignores anchors beyond kMaxPairs.
  void add(std::uint16_t anchor, float range_m, std::span<std::uint8_t> room) noexcept;
  // Fills an empty report.
  void fill(groma_SurveyReport& report, std::span<const std::uint8_t> room) const noexcept;

  // Mean and squares by Welford's recurrence.
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
