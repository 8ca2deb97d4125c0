#include "host/calibration/range_noise.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

#include "host/calibration/median.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Lags, each from its own figure to the next.
constexpr std::array kLags_s{0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8};
constexpr std::size_t kLags = kLags_s.size() - 1;
constexpr std::size_t kFewPairs = 3;
constexpr std::size_t kFewRows = 50;
constexpr double kFewProducts = 30.0;
// A residual beyond so many robust sigmas of its pair is none of a range in sight.
constexpr double kWithin = 4.0;
// Correlation times that are tried: each longer than the one before by this factor.
constexpr double kShortest_s = 0.2;
constexpr double kLongest_s = 20.0;
constexpr double kLonger = 1.1;
// Less than this share of the whole variance is not told from white noise.
constexpr double kLeastShare = 0.05;

struct Residual {
  double t_s = 0.0;
  double value_m = 0.0;
};

std::vector<Residual> residuals_in_sight(const AnchorFit& fit, std::size_t tag, std::size_t tag_count) {
  std::vector<Residual> out;
  for (const Observation& row : fit.problem.rows) {
    if (row.tag != tag) continue;
    const double value_m = residual_m(row, fit.anchor, tag_count);
    if (value_of(fit.problem, fit.kernels, row, value_m, fit.anchor).seen_share < 0.5) continue;
    out.push_back({row.t_s, value_m});
  }
  if (out.size() < kFewRows) return {};
  std::vector<double> values;
  values.reserve(out.size());
  for (const Residual& residual : out) values.push_back(residual.value_m);
  const double middle_m = median(values);
  for (double& value : values) value = std::abs(value - middle_m);
  const double sigma_m = kSigmaOfMad * median(values);
  std::erase_if(out, [&](const Residual& residual) {
    return std::abs(residual.value_m - middle_m) > kWithin * sigma_m;
  });
  double mean_m = 0.0;
  for (const Residual& residual : out) mean_m += residual.value_m / static_cast<double>(out.size());
  for (Residual& residual : out) residual.value_m -= mean_m;
  return out;
}

// Variance and covariance by lag of all pairs, a list each.
struct Covariances {
  std::vector<double> variance_m2;
  std::array<std::vector<double>, kLags> by_lag_m2;
  std::array<std::vector<double>, kLags> lag_s;  // that was had, in the mean
};

void add(const std::vector<Residual>& residuals, Covariances& out) {
  double variance = 0.0;
  std::array<double, kLags> sums{};
  std::array<double, kLags> lags_s{};
  std::array<double, kLags> counts{};
  for (std::size_t i = 0; i < residuals.size(); ++i) {
    variance += residuals[i].value_m * residuals[i].value_m;
    // One partner a lag, the first within it: as much for each row.
    std::size_t j = i + 1;
    for (std::size_t lag = 0; lag < kLags; ++lag) {
      while (j < residuals.size() && residuals[j].t_s - residuals[i].t_s < kLags_s[lag]) ++j;
      if (j == residuals.size()) break;
      if (residuals[j].t_s - residuals[i].t_s >= kLags_s[lag + 1]) continue;
      sums[lag] += residuals[i].value_m * residuals[j].value_m;
      lags_s[lag] += residuals[j].t_s - residuals[i].t_s;
      counts[lag] += 1.0;
    }
  }
  out.variance_m2.push_back(variance / static_cast<double>(residuals.size()));
  for (std::size_t lag = 0; lag < kLags; ++lag) {
    if (counts[lag] < kFewProducts) continue;
    out.by_lag_m2[lag].push_back(sums[lag] / counts[lag]);
    out.lag_s[lag].push_back(lags_s[lag] / counts[lag]);
  }
}

}  // namespace

std::optional<model::RangeNoise> range_noise(std::span<const AnchorFit> fits, std::size_t tag_count) {
  Covariances pairs;
  for (const AnchorFit& fit : fits) {
    for (std::size_t tag = 0; tag < tag_count; ++tag) {
      const std::vector<Residual> residuals = residuals_in_sight(fit, tag, tag_count);
      if (residuals.size() >= kFewRows) add(residuals, pairs);
    }
  }
  if (pairs.variance_m2.size() < kFewPairs) return std::nullopt;
  if (model::is_ablated(model::Mechanism::kCalibrationRangeNoise)) return std::nullopt;
  const double whole_m2 = median(pairs.variance_m2);

  // variance exp(-lag / time) through the medians, by least squares: for each time the best variance.
  std::vector<std::array<double, 2>> points;
  for (std::size_t lag = 0; lag < kLags; ++lag) {
    if (pairs.by_lag_m2[lag].size() < kFewPairs) continue;
    points.push_back({median(pairs.lag_s[lag]), median(pairs.by_lag_m2[lag])});
  }
  double best = 0.0;
  double slow_m2 = 0.0;
  double time_s = kShortest_s;
  for (double time = kShortest_s; time < kLongest_s; time *= kLonger) {
    double product = 0.0;
    double square = 0.0;
    for (const auto& [lag_s, covariance_m2] : points) {
      const double shape = std::exp(-lag_s / time);
      product += shape * covariance_m2;
      square += shape * shape;
    }
    // The sum of squares falls by product^2 / square.
    if (product > 0.0 && product * product / square > best) {
      best = product * product / square;
      slow_m2 = product / square;
      time_s = time;
    }
  }
  slow_m2 = std::min(slow_m2, (1.0 - kLeastShare) * whole_m2);
  if (slow_m2 < kLeastShare * whole_m2) slow_m2 = 0.0;
  return model::RangeNoise{.white_sigma_m = std::sqrt(whole_m2 - slow_m2),
                           .slow_sigma_m = std::sqrt(slow_m2),
                           .slow_time_s = time_s};
}

}  // namespace groma::calibration
