// The figures of experiments over their seeds.
#pragma once

#include <cstddef>
#include <vector>

#include "host/reproduce/runner.hpp"
#include "host/reproduce/sensitivity.hpp"

namespace groma::reproduce {

// Median, and 5 to 95 % over the seeds.
struct Band {
  double low = 0.0;
  double median = 0.0;
  double high = 0.0;
  std::size_t count = 0;
};
// Not a number and infinite values do not count.
[[nodiscard]] Band band(std::vector<double> values);
// Of the number that each seed's result has at a pointer, if it has one.
[[nodiscard]] Band band_at(const Seeds& seeds, const Json::json_pointer& at);

// One level of a factor.
struct LevelBands {
  Band ate_m;      // mean ATE
  Band nees;       // mean NEES
  Band anchors_m;  // mean error of the anchors marked ok
};
[[nodiscard]] LevelBands bands_of(const Seeds& seeds, std::size_t level);
// Whether the error is over twice the usual one and 5 cm more, or the NEES over 4. By hand.
[[nodiscard]] bool is_broken(const LevelBands& level, const LevelBands& usual);

// {experiment: {row: {"ours" and "published": {metric: {"median", "low", "high", "seeds", "paper"}}}}}. The
// rows of sensitivity are "FACTOR: LEVEL", those of recorded "RUN: FILTER"; of baselines, what is not groma's
// is "published".
[[nodiscard]] Json summary_of(const Outcome& outcome);

}  // namespace groma::reproduce
