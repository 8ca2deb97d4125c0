#include "firmware/core/node/survey.hpp"

#include <cmath>
#include <cstring>

namespace groma::node {
namespace {

using Sum = SurveySums::Sum;

// The bytes need not be aligned.
Sum sum_at(std::span<const std::uint8_t> room, std::size_t i) noexcept {
  Sum sum;
  std::memcpy(&sum, room.subspan(i * sizeof(Sum)).data(), sizeof(Sum));
  return sum;
}

}  // namespace

void SurveySums::add(std::uint16_t anchor, float range_m, std::span<std::uint8_t> room) noexcept {
  std::size_t i = 0;
  Sum sum;
  for (; i < count_; ++i) {
    sum = sum_at(room, i);
    if (sum.anchor == anchor) break;
  }
  if (i == count_) {
    if (i == kMaxPairs) return;
    sum = Sum{.anchor = anchor};
    ++count_;
  }
  ++sum.count;
  const float off_m = range_m - sum.mean_m;
  sum.mean_m += off_m / static_cast<float>(sum.count);
  sum.squares_m2 += off_m * (range_m - sum.mean_m);
  std::memcpy(room.subspan(i * sizeof(Sum)).data(), &sum, sizeof(Sum));
}

void SurveySums::fill(groma_SurveyReport& report, std::span<const std::uint8_t> room) const noexcept {
  for (std::size_t i = 0; i < count_; ++i) {
    const Sum sum = sum_at(room, i);
    const float freedom = sum.count > 1 ? static_cast<float>(sum.count - 1) : 1.0F;
    report.pairs[report.pairs_count++] = {.anchor_id = sum.anchor,
                                          .mean_m = sum.mean_m,
                                          .sigma_m = std::sqrt(sum.squares_m2 / freedom),
                                          .count = sum.count};
  }
}

}  // namespace groma::node
