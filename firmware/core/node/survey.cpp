#include "firmware/core/node/survey.hpp"

#include <algorithm>
#include <cmath>
#include <span>

namespace groma::node {

void Survey::begin(std::uint16_t lender, std::uint32_t exchanges, std::uint64_t until_us) noexcept {
  lender_ = lender;
  left_ = static_cast<std::uint16_t>(exchanges);
  until_us_ = until_us;
  count_ = 0;
}

void Survey::add(const mac::Exchange& exchange) noexcept {
  if (left_ == 0) return;
  --left_;
  for (const mac::Leg& leg : std::span(exchange.legs).first(exchange.count)) {
    const mac::Range range = mac::evaluate(exchange, leg);
    if (range.status == mac::RangeStatus::kOk) add(leg.anchor, range.flight.distance_m());
  }
}

// Welford's recurrence.
void Survey::add(std::uint16_t anchor, float range_m) noexcept {
  const auto end = sums_.begin() + static_cast<std::ptrdiff_t>(count_);
  const auto sum = std::find_if(sums_.begin(), end, [=](const Sum& s) { return s.anchor == anchor; });
  if (sum == end) {
    if (count_ == kMaxPairs) return;
    *sum = {.anchor = anchor};
    ++count_;
  }
  ++sum->count;
  const float off_m = range_m - sum->mean_m;
  sum->mean_m += off_m / static_cast<float>(sum->count);
  sum->squares_m2 += off_m * (range_m - sum->mean_m);
}

void Survey::fill(groma_SurveyReport& report) const noexcept {
  for (const Sum& sum : std::span(sums_).first(count_)) {
    const float freedom = sum.count > 1 ? static_cast<float>(sum.count - 1) : 1.0F;
    report.pairs[report.pairs_count++] = {.anchor_id = sum.anchor,
                                          .mean_m = sum.mean_m,
                                          .sigma_m = std::sqrt(sum.squares_m2 / freedom),
                                          .count = sum.count};
  }
}

}  // namespace groma::node
