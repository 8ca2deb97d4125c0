// A survey: an anchor measures its ranges to the other anchors.
//
// Meanwhile it acts as a tag: it polls the other anchors in the slot of the tag that forwarded the command,
// while that tag is silent.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <iterator>
#include <span>

#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/mac/frame.hpp"
#include "groma.pb.h"

namespace groma::node {

class Survey {
 public:
  static constexpr std::uint32_t kMaxExchanges = 200;
  static constexpr std::uint64_t kLongest_us = 60'000'000;

  // Starts with `exchanges`, 1 to kMaxExchanges, still to come in the slot of the tag `lender`, and
  // `until_us` on the node's clock to complete them.
  void begin(std::uint16_t lender, std::uint32_t exchanges, std::uint64_t until_us) noexcept {
    lender_ = lender;
    left_ = exchanges;
    until_us_ = until_us;
    report_ = groma_SurveyReport_init_zero;
  }
  void end() noexcept { lender_ = mac::kNobody; }

  [[nodiscard]] bool under_way() const noexcept { return lender_ != mac::kNobody; }
  // The tag in whose slot this anchor polls; kNobody while no survey is under way.
  [[nodiscard]] std::uint16_t lender() const noexcept { return lender_; }
  [[nodiscard]] bool is_complete() const noexcept { return under_way() && left_ == 0; }
  [[nodiscard]] bool is_overdue(std::uint64_t now_us) const noexcept {
    return under_way() && now_us >= until_us_;
  }

  // Adds the ranges of one exchange. Ignores anchors beyond the report's room, and exchanges beyond the
  // number asked for.
  void add(const mac::Exchange& exchange) noexcept {
    if (left_ == 0) return;
    --left_;
    for (const mac::Leg& leg : std::span(exchange.legs).first(exchange.count)) {
      const mac::Range range = mac::evaluate(exchange, leg);
      if (range.status == mac::RangeStatus::kOk) add(leg.anchor, range.flight.distance_m());
    }
  }

  // Mean and standard deviation of the ranges to each anchor.
  void fill(groma_SurveyReport& report) const noexcept {
    report = report_;
    for (groma_SurveyPair& pair : std::span(report.pairs).first(report.pairs_count))
      pair.sigma_m = std::sqrt(pair.sigma_m / static_cast<float>(std::max(pair.count - 1, 1)));
  }

 private:
  // Welford's recurrence. Until fill() sigma_m holds the sum of the squares.
  void add(std::uint16_t anchor, float range_m) noexcept {
    groma_SurveyPair* const end = report_.pairs + report_.pairs_count;
    groma_SurveyPair* const pair =
        std::find_if(report_.pairs, end, [=](const groma_SurveyPair& p) { return p.anchor_id == anchor; });
    if (pair == end) {
      if (end == std::end(report_.pairs)) return;
      ++report_.pairs_count;
      pair->anchor_id = anchor;
    }
    ++pair->count;
    const float off_m = range_m - pair->mean_m;
    pair->mean_m += off_m / static_cast<float>(pair->count);
    pair->sigma_m += off_m * (range_m - pair->mean_m);
  }

  std::uint16_t lender_ = mac::kNobody;
  std::uint32_t left_ = 0;  // exchanges
  std::uint64_t until_us_ = 0;
  groma_SurveyReport report_ = groma_SurveyReport_init_zero;
};

}  // namespace groma::node
