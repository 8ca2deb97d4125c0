// A survey: an anchor measures its ranges to the other anchors.
//
// Meanwhile it acts as a tag: it polls the other anchors in the slot of the tag that forwarded the command,
// while that tag is silent.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "firmware/core/mac/exchange.hpp"
#include "firmware/core/mac/frame.hpp"
#include "groma.pb.h"

namespace groma::node {

class Survey {
 public:
  static constexpr std::uint32_t kMaxExchanges = 200;
  static constexpr std::size_t kMaxPairs = sizeof(groma_SurveyReport::pairs) / sizeof(groma_SurveyPair);

  // Starts with `exchanges`, 1 to kMaxExchanges, still to come in the slot of the tag `lender`, and
  // `until_us` on the node's clock to complete them.
  void begin(std::uint16_t lender, std::uint32_t exchanges, std::uint64_t until_us) noexcept;
  void end() noexcept { lender_ = mac::kNobody; }

  [[nodiscard]] bool under_way() const noexcept { return lender_ != mac::kNobody; }
  // The tag in whose slot this anchor polls; kNobody while no survey is under way.
  [[nodiscard]] std::uint16_t lender() const noexcept { return lender_; }
  [[nodiscard]] bool is_complete() const noexcept { return under_way() && left_ == 0; }
  [[nodiscard]] bool is_overdue(std::uint64_t now_us) const noexcept {
    return under_way() && now_us >= until_us_;
  }

  // Adds the ranges of one exchange. Ignores anchors beyond kMaxPairs, and exchanges beyond the number asked
  // for.
  void add(const mac::Exchange& exchange) noexcept;
  // Mean and standard deviation of the ranges to each anchor, into an empty report.
  void fill(groma_SurveyReport& report) const noexcept;

 private:
  struct Sum {
    std::uint16_t anchor = mac::kNobody;
    std::uint16_t count = 0;
    float mean_m = 0.0F;
    float squares_m2 = 0.0F;
  };

  void add(std::uint16_t anchor, float range_m) noexcept;

  std::uint16_t lender_ = mac::kNobody;
  std::uint16_t left_ = 0;  // exchanges
  std::uint64_t until_us_ = 0;
  std::size_t count_ = 0;
  std::array<Sum, kMaxPairs> sums_{};
};

}  // namespace groma::node
