#include "host/calibration/range_noise.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

#include "host/calibration/robust_kernel.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// Lag bins, each from its own value to the next: from half a wavelength on, doubled. Unless stated, the
// constants are by hand; the RangeNoise tests hold with them (lengths of 0.3 and 4 m).
constexpr std::array kLags_m{0.025, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4};
constexpr std::size_t kLags = kLags_m.size() - 1;
constexpr std::size_t kFewPairs = 3;
constexpr std::size_t kFewRows = 50;
constexpr double kFewProducts = 30.0;  // a covariance of white residuals: sigma 1/sqrt(30) of the variance
// Residuals beyond this many robust sigmas of their pair are not LOS: 6e-5 by chance (normal, two-sided).
constexpr double kWithin = 4.0;
// Correlation lengths to try, each longer than the one before by the factor kLonger.
constexpr double kShortest_m = 0.02;
constexpr double kLongest_m = 20.0;
constexpr double kLonger = 1.1;
// A correlated or white part below this share of the whole variance cannot be distinguished from none.
constexpr double kLeastShare = 0.05;

struct Residual {
  double way_m = 0.0;  // of the antenna so far
  double value_m = 0.0;
};

std::vector<Residual> los_residuals(const AnchorFit& fit, std::size_t tag) {
  std::vector<Residual> out;
  const Observation* last = nullptr;
  double way_m = 0.0;
  for (const Observation& row : fit.problem.rows) {
    if (row.tag != tag) continue;
    if (last != nullptr) way_m += row.velocity_mps.norm() * (row.t_s - last->t_s);
    last = &row;
    const RowAt at = row_at(fit, row);
    if (at.value.los_count >= 0.5) out.push_back({way_m, at.residual_m});
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

// Variance and covariance by lag: one value per pair.
struct Covariances {
  std::vector<double> variance_m2;
  std::array<std::vector<double>, kLags> by_lag_m2;
  std::array<std::vector<double>, kLags> lag_m;  // mean lag in the bin
};

void add(const std::vector<Residual>& residuals, Covariances& out) {
  double variance = 0.0;
  std::array<double, kLags> sums{};
  std::array<double, kLags> lags_m{};
  std::array<double, kLags> counts{};
  for (std::size_t i = 0; i < residuals.size(); ++i) {
    variance += residuals[i].value_m * residuals[i].value_m;
    // One partner per lag bin, the first in it: each residual counts the same.
    std::size_t j = i + 1;
    for (std::size_t lag = 0; lag < kLags; ++lag) {
      while (j < residuals.size() && residuals[j].way_m - residuals[i].way_m < kLags_m[lag]) ++j;
      if (j == residuals.size()) break;
      if (residuals[j].way_m - residuals[i].way_m >= kLags_m[lag + 1]) continue;
      sums[lag] += residuals[i].value_m * residuals[j].value_m;
      lags_m[lag] += residuals[j].way_m - residuals[i].way_m;
      counts[lag] += 1.0;
    }
  }
  out.variance_m2.push_back(variance / static_cast<double>(residuals.size()));
  for (std::size_t lag = 0; lag < kLags; ++lag) {
    if (counts[lag] < kFewProducts) continue;
    out.by_lag_m2[lag].push_back(sums[lag] / counts[lag]);
    out.lag_m[lag].push_back(lags_m[lag] / counts[lag]);
  }
}

}  // namespace

std::optional<model::RangeNoise> range_noise(std::span<const AnchorFit> fits) {
  Covariances pairs;
  for (const AnchorFit& fit : fits) {
    for (std::size_t tag = 0; tag < fit.problem.tag_count; ++tag) {
      const std::vector<Residual> residuals = los_residuals(fit, tag);
      if (residuals.size() >= kFewRows) add(residuals, pairs);
    }
  }
  if (pairs.variance_m2.size() < kFewPairs) return std::nullopt;
  if (model::is_ablated(model::Mechanism::kCalibrationRangeNoise)) return std::nullopt;
  const double whole_m2 = median(pairs.variance_m2);

  // Least-squares fit of variance exp(-lag / length) to the medians: for each length the best variance.
  std::vector<std::array<double, 2>> points;
  for (std::size_t lag = 0; lag < kLags; ++lag) {
    if (pairs.by_lag_m2[lag].size() < kFewPairs) continue;
    points.push_back({median(pairs.lag_m[lag]), median(pairs.by_lag_m2[lag])});
  }
  double best = 0.0;
  double slow_m2 = 0.0;
  double length_m = kShortest_m;
  for (double tried_m = kShortest_m; tried_m < kLongest_m; tried_m *= kLonger) {
    double product = 0.0;
    double square = 0.0;
    for (const auto& [lag_m, covariance_m2] : points) {
      const double shape = std::exp(-lag_m / tried_m);
      product += shape * covariance_m2;
      square += shape * shape;
    }
    // The fit lowers the sum of squares by product^2 / square.
    if (product > 0.0 && product * product / square > best) {
      best = product * product / square;
      slow_m2 = product / square;
      length_m = tried_m;
    }
  }
  slow_m2 = std::min(slow_m2, (1.0 - kLeastShare) * whole_m2);
  if (slow_m2 < kLeastShare * whole_m2) slow_m2 = 0.0;
  return model::RangeNoise{.white_sigma_m = std::sqrt(whole_m2 - slow_m2),
                           .bias_sigma_m = std::sqrt(slow_m2),
                           .bias_length_m = length_m};
}

}  // namespace groma::calibration
