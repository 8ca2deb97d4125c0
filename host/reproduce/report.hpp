// The results as a page and as JSON.
#pragma once

#include "host/report/page.hpp"
#include "host/reproduce/runner.hpp"

namespace groma::reproduce {

// Median, and 5 to 95 % over the seeds.
struct Band {
  double low = 0.0;
  double median = 0.0;
  double high = 0.0;
  std::size_t count = 0;
};
[[nodiscard]] Band band(std::vector<double> values);

[[nodiscard]] report::Page page_of(const Outcome& outcome, const Plan& plan);
// {experiment: {row: {metric: {"median", "low", "high", "paper"}}}}.
[[nodiscard]] Json summary_of(const Outcome& outcome);

}  // namespace groma::reproduce
