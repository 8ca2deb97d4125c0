// The figures of experiments over their seeds.
#pragma once

#include <array>
#include <cstddef>
#include <vector>

#include "host/reproduce/paper.hpp"
#include "host/reproduce/runner.hpp"
#include "host/reproduce/sensitivity.hpp"
#include "host/reproduce/tables.hpp"

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

// What a table of poses has for each row.
struct Column {
  const char* title;
  const char* figure;
  const char* statistic;
  double PaperStatistic::*of_paper;
  PaperStatistic PaperRow::*row;
  const char* format;
};
inline constexpr std::array kColumns{
    Column{"ATE mean m", "ate_m", "mean", &PaperStatistic::mean, &PaperRow::ate_m, "{:.3f}"},
    Column{"ATE max m", "ate_m", "max", &PaperStatistic::max, &PaperRow::ate_m, "{:.3f}"},
    Column{"heading mean rad", "ate_rad", "mean", &PaperStatistic::mean, &PaperRow::ate_rad, "{:.3f}"},
    Column{"NEES mean", "nees", "mean", &PaperStatistic::mean, &PaperRow::nees, "{:.1f}"}};

// kNotGiven where the paper has none.
[[nodiscard]] double paper_value(const TableRow& row, const Column& column);

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
