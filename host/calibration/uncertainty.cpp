#include "host/calibration/uncertainty.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>

#include "host/calibration/robust_kernel.hpp"
#include "host/model/ablation.hpp"

namespace groma::calibration {
namespace {

// By hand: with 8 blocks the ratio for 9 unknowns has a sigma of sqrt(2 / (8 * 9)) = 0.17; the shortest block
// holds a few ranges of each pair; the most blocks bound memory, at 34 minutes.
constexpr double kMinBlocks = 8.0;
constexpr double kScoreBlock_s = 0.5;
constexpr double kMaxScoreBlocks = 4096.0;
// Excess scatter counts if it is above this many of its own standard deviations: 0.6 % by chance (normal,
// one-sided) for each block length.
constexpr double kSignificance = 2.5;
// Lower limit of a kernel's mean curvature, as a share of its majorizer's: it keeps the information positive.
// By hand; the CalibrationCampaign tests hold with it (NEES 1.0).
constexpr double kMinCurvatureShare = 0.3;

// Jackknife: parts of the drive, solver steps for each. By hand: five parts have four degrees of freedom for
// three coordinates; 50 ranges are ten in each part.
constexpr int kParts = 5;
constexpr int kJackknifeSteps = 6;
constexpr std::size_t kMinJackknifeRows = 50;
// 99.7 % quantile of the largest eigenvalue of a Wishart matrix of 3 dimensions and 4 degrees of freedom,
// divided by the latter.
constexpr double kLargestByChance = 5.5;
// Variance of Student's t with 4 degrees of freedom.
constexpr double kStudent = 2.0;

struct PairMoments {
  PairBlock weighted = PairBlock::Zero();  // sum of weight J J^T, its lower triangle
  double weight = 0.0;
  double curvature = 0.0;
  double square_slope = 0.0;
};

// Adds factor times the symmetric matrix whose lower triangle is given.
void add_pair(const PairBlock& lower, double factor, std::size_t tag, std::size_t tag_count,
              Eigen::MatrixXd& out) {
  const PairBlock block = lower.selfadjointView<Eigen::Lower>();
  const PairIndex index = pair_index(tag, tag_count);
  out(index, index) += factor * block;
}

// `scores`: one row per block of the shortest length.
std::array<Scatter, kBlockLevels> scatter_by_block_length(const Eigen::MatrixXd& information,
                                                          const Eigen::MatrixXd& score_variance,
                                                          const Eigen::MatrixXd& scores) {
  // With L L^T the information, the square of a score s in its metric is |L^-1 s|^2.
  const Eigen::LLT<Eigen::MatrixXd> factors(information);
  const Eigen::MatrixXd inverse =
      factors.matrixL().solve(Eigen::MatrixXd::Identity(information.rows(), information.cols()));
  const double independent = (inverse * score_variance).cwiseProduct(inverse).sum();
  std::array<Eigen::VectorXd, kBlockLevels> squares;
  Eigen::Index blocks = scores.rows();
  for (Eigen::VectorXd& square : squares) {
    square = Eigen::VectorXd::Zero(blocks);
    blocks = (blocks + 1) / 2;
  }
  Eigen::VectorXd whitened(scores.rows());
  for (Eigen::Index k = 0; k < scores.cols(); ++k) {
    whitened.setZero();
    for (Eigen::Index i = 0; i <= k; ++i) whitened += inverse(k, i) * scores.col(i);
    for (Eigen::VectorXd& square : squares) {
      const Eigen::Index size = square.size();
      square.array() += whitened.head(size).array().square();
      for (Eigen::Index block = 0; 2 * block < size; ++block) {
        const double second = 2 * block + 1 < size ? whitened(2 * block + 1) : 0.0;
        whitened(block) = whitened(2 * block) + second;
      }
    }
  }
  std::array<Scatter, kBlockLevels> out;
  for (std::size_t level = 0; level < kBlockLevels; ++level) {
    Scatter& scatter = out[level];
    scatter.observed = squares[level].sum();
    scatter.blocks = static_cast<double>((squares[level].array() > 0.0).count());
    // The scores of all blocks sum to nearly zero at the solution: one block's worth is missing.
    if (scatter.blocks > 1.0) scatter.expected = independent * (1.0 - 1.0 / scatter.blocks);
  }
  return out;
}

double ratio(const Scatter& scatter) {
  return scatter.expected > 0.0 ? scatter.observed / scatter.expected : 1.0;
}

// Largest significant ratio among block lengths, at least 1.
double significant_ratio(std::span<const Scatter> levels, double dimensions) {
  if (model::is_ablated(model::Mechanism::kCalibrationInflation)) return 1.0;
  double largest = 1.0;
  for (const Scatter& scatter : levels) {
    if (scatter.blocks < kMinBlocks) continue;
    const double deviation = std::sqrt(2.0 / (scatter.blocks * dimensions));
    const double found = ratio(scatter);
    if (found > 1.0 + kSignificance * deviation) largest = std::max(largest, found);
  }
  return largest;
}

// Lag bins, each from its own value to the next: from a usual interval of ranges on, doubled. Unless stated,
// the constants of range_noise() are by hand; the RangeNoise tests hold with them (times of 0.7 and 4 s).
constexpr std::array kLags_s{0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8};
constexpr std::size_t kLags = kLags_s.size() - 1;
constexpr std::size_t kFewPairs = 3;
constexpr std::size_t kFewRows = 50;
constexpr double kFewProducts = 30.0;  // a covariance of white residuals: sigma 1/sqrt(30) of the variance
// Residuals beyond this many robust sigmas of their pair are not LOS: 6e-5 by chance (normal, two-sided).
constexpr double kWithin = 4.0;
// Correlation times to try, each longer than the one before by the factor kLonger.
constexpr double kShortest_s = 0.2;
constexpr double kLongest_s = 20.0;
constexpr double kLonger = 1.1;
// A correlated or white part below this share of the whole variance cannot be distinguished from none.
constexpr double kLeastShare = 0.05;

struct Residual {
  double t_s = 0.0;
  double value_m = 0.0;
};

std::vector<Residual> los_residuals(const AnchorFit& fit, std::size_t tag) {
  std::vector<Residual> out;
  for (const Observation& row : fit.problem.rows) {
    if (row.tag != tag) continue;
    const RowAt at = row_at(fit, row);
    if (at.value.los_count >= 0.5) out.push_back({row.t_s, at.residual_m});
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
  std::array<std::vector<double>, kLags> lag_s;  // mean lag in the bin
};

void add(const std::vector<Residual>& residuals, Covariances& out) {
  double variance = 0.0;
  std::array<double, kLags> sums{};
  std::array<double, kLags> lags_s{};
  std::array<double, kLags> counts{};
  for (std::size_t i = 0; i < residuals.size(); ++i) {
    variance += residuals[i].value_m * residuals[i].value_m;
    // One partner per lag bin, the first in it: each residual counts the same.
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

Evidence gather_evidence(const AnchorFit& fit) {
  const AnchorProblem& problem = fit.problem;
  const std::size_t tags = problem.tag_count;
  const Eigen::Index size = fit.anchor.size();
  Evidence out;
  out.prior_information = information_of_priors(problem);
  out.information = out.prior_information;
  out.surveyed = problem.position.surveyed;
  out.score_variance = Eigen::MatrixXd::Zero(size, size);
  if (problem.rows.empty()) return out;

  const double begin_s = problem.rows.front().t_s;
  const double duration_s = problem.rows.back().t_s - begin_s;
  const double block_s = std::max(kScoreBlock_s, duration_s / kMaxScoreBlocks);
  const auto blocks = 1 + static_cast<Eigen::Index>(duration_s / block_s);
  Eigen::MatrixXd scores = Eigen::MatrixXd::Zero(blocks, size);
  std::vector<PairMoments> pairs(tags);
  for (const Observation& row : problem.rows) {
    const RowAt at = row_at(fit, row);
    const RowValue& whole = at.value;
    const KernelValue& value = whole.seen;
    PairMoments& pair = pairs[row.tag];
    add_square(at.j, value.weight, pair.weighted);
    pair.weight += value.weight;
    // Curvature of the mixture: the variance of the slope between LOS and NLOS counts too.
    pair.curvature += whole.los_count * at.noise_share * at.noise_share *
                      fit.kernels[row.tag].curvature(at.noise_share * at.residual_m);
    if (whole.los_count > 0.0) {
      pair.curvature -= (1.0 / whole.los_count - 1.0) * value.slope * value.slope;
    }
    pair.square_slope += value.slope * value.slope;

    const double elapsed_s = std::max(0.0, row.t_s - begin_s);
    const Eigen::Index block = std::min(blocks - 1, static_cast<Eigen::Index>(elapsed_s / block_s));
    scores(block, pair_index(row.tag, tags)) += value.slope * at.j.transpose();
    if (!(whole.nlos_weight > 0.0)) continue;
    const LongNlosRow nlos(at.j, problem.los_states->rows[row.index], row.tag, tags);
    nlos.add(whole.nlos_slope, scores.row(block).transpose());
    nlos.add_square(whole.nlos_weight, out.information);
    nlos.add_square(whole.nlos_slope * whole.nlos_slope, out.score_variance);
  }
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const PairMoments& pair = pairs[tag];
    if (!(pair.weight > 0.0)) continue;
    const double curvature = model::is_ablated(model::Mechanism::kCalibrationCurvature)
                                 ? 1.0
                                 : std::clamp(pair.curvature / pair.weight, kMinCurvatureShare, 1.0);
    add_pair(pair.weighted, curvature, tag, tags, out.information);
    add_pair(pair.weighted, pair.square_slope / pair.weight, tag, tags, out.score_variance);
  }
  out.scatter = scatter_by_block_length(out.information, out.score_variance, scores);
  return out;
}

std::vector<Evidence> gather_evidence(std::span<const AnchorFit> fits) {
  std::vector<Evidence> out;
  for (const AnchorFit& fit : fits) out.push_back(gather_evidence(fit));
  return out;
}

std::vector<double> score_inflation(std::span<const Evidence> evidence) {
  std::vector<double> own;
  std::array<Scatter, kBlockLevels> site;
  double dimensions = 1.0;
  for (const Evidence& anchor : evidence) {
    dimensions = static_cast<double>(anchor.information.rows());
    for (std::size_t level = 0; level < kBlockLevels; ++level) {
      const Scatter& scatter = anchor.scatter[level];
      if (!(scatter.expected > 0.0)) continue;
      // Normalized, so that anchors with more ranges do not dominate.
      site[level].observed += scatter.blocks * ratio(scatter);
      site[level].expected += scatter.blocks;
      site[level].blocks += scatter.blocks;
    }
    own.push_back(significant_ratio(anchor.scatter, dimensions));
  }
  const double common = significant_ratio(site, dimensions);
  for (double& inflation : own) inflation = std::max(inflation, common);
  return own;
}

double inflation_within(const Evidence& evidence, double duration_s) {
  std::size_t count = 0;
  for (double block_s = kScoreBlock_s; block_s <= duration_s && count < kBlockLevels; block_s *= 2.0) ++count;
  return significant_ratio(std::span(evidence.scatter).first(count),
                           static_cast<double>(evidence.information.rows()));
}

std::optional<Eigen::Matrix3d> jackknife_covariance(const AnchorFit& fit) {
  const std::span<const Observation> rows = fit.problem.rows;
  if (rows.size() < kMinJackknifeRows || fit.problem.position.surveyed) return std::nullopt;
  if (model::is_ablated(model::Mechanism::kCalibrationJackknife)) return std::nullopt;
  const double begin_s = rows.front().t_s;
  const double part_s = (rows.back().t_s - begin_s) / kParts;
  Eigen::Matrix3d sum = Eigen::Matrix3d::Zero();
  std::vector<Observation> kept;
  kept.reserve(rows.size());
  for (int part = 0; part < kParts; ++part) {
    const double from_s = begin_s + part * part_s;
    const double to_s = part + 1 == kParts ? rows.back().t_s + 1.0 : from_s + part_s;
    kept.clear();
    std::copy_if(rows.begin(), rows.end(), std::back_inserter(kept),
                 [&](const Observation& row) { return row.t_s < from_s || row.t_s >= to_s; });
    AnchorProblem problem = fit.problem;
    problem.rows = kept;
    const Eigen::Vector3d moved_m =
        (solve_anchor(problem, fit.kernels, fit.anchor, kJackknifeSteps).anchor - fit.anchor).head<3>();
    sum += moved_m * moved_m.transpose();
  }
  return Eigen::Matrix3d((kParts - 1.0) / kParts * sum);
}

Eigen::MatrixXd excess_of_jackknife(const Eigen::Matrix3d& jackknife, const Eigen::MatrixXd& expected) {
  const Eigen::Index size = expected.rows();
  const Eigen::LLT<Eigen::Matrix3d> root(expected.topLeftCorner<3, 3>());
  if (root.info() != Eigen::Success || !jackknife.allFinite()) return Eigen::MatrixXd::Zero(size, size);
  const Eigen::Matrix3d half = root.matrixL().solve(jackknife);
  const Eigen::Matrix3d relative = root.matrixL().solve(half.transpose());
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix3d> axes(0.5 * (relative + relative.transpose()));
  Eigen::Matrix3d more = Eigen::Matrix3d::Zero();
  for (Eigen::Index axis = 0; axis < 3; ++axis) {
    const double ratio = axes.eigenvalues()(axis);
    if (ratio < kLargestByChance) continue;
    const Eigen::Vector3d direction = axes.eigenvectors().col(axis);
    more += (kStudent * ratio - 1.0) * direction * direction.transpose();
  }
  const Eigen::MatrixXd by_position = root.matrixL().solve(expected.topRows<3>());
  return by_position.transpose() * more * by_position;
}

Eigen::MatrixXd anchor_covariance(const Evidence& evidence, double inflation) {
  const Eigen::Index size = evidence.information.rows();
  if (evidence.surveyed) {
    const Eigen::Index biases = size - 3;
    const Eigen::LDLT<Eigen::MatrixXd> information(evidence.information.bottomRightCorner(biases, biases));
    // Change of the biases by the change of the position.
    const Eigen::MatrixXd by_position = -information.solve(evidence.information.bottomLeftCorner(biases, 3));
    const Eigen::Matrix3d position =
        evidence.prior_information.topLeftCorner<3, 3>().ldlt().solve(Eigen::Matrix3d::Identity());
    const Eigen::MatrixXd variance = evidence.prior_information.bottomRightCorner(biases, biases) +
                                     inflation * evidence.score_variance.bottomRightCorner(biases, biases);
    const Eigen::MatrixXd half = information.solve(variance);
    Eigen::MatrixXd covariance(size, size);
    covariance.topLeftCorner<3, 3>() = position;
    covariance.bottomLeftCorner(biases, 3) = by_position * position;
    covariance.topRightCorner(3, biases) = covariance.bottomLeftCorner(biases, 3).transpose();
    covariance.bottomRightCorner(biases, biases) =
        information.solve(half.transpose()) + by_position * position * by_position.transpose();
    return 0.5 * (covariance + covariance.transpose());
  }
  const Eigen::MatrixXd inverse = evidence.information.ldlt().solve(Eigen::MatrixXd::Identity(size, size));
  const Eigen::MatrixXd variance = evidence.prior_information + inflation * evidence.score_variance;
  const Eigen::MatrixXd covariance = inverse * variance * inverse;
  return 0.5 * (covariance + covariance.transpose());
}

Eigen::MatrixXd rough_covariance(const AnchorFit& fit) {
  constexpr std::size_t kRows = 200;  // by hand, a bound on time
  const AnchorProblem& problem = fit.problem;
  const std::size_t tags = problem.tag_count;
  const std::size_t step = 1 + problem.rows.size() / kRows;
  std::vector<PairBlock> pairs(tags, PairBlock::Zero());
  for (std::size_t i = 0; i < problem.rows.size(); i += step) {
    const RowAt at = row_at(fit, problem.rows[i]);
    add_square(at.j, at.value.seen.weight, pairs[problem.rows[i].tag]);
  }
  Eigen::MatrixXd information = information_of_priors(problem);
  for (std::size_t tag = 0; tag < tags; ++tag) {
    add_pair(pairs[tag], static_cast<double>(step), tag, tags, information);
  }
  return information.ldlt().solve(Eigen::MatrixXd::Identity(information.rows(), information.cols()));
}

double prediction_sigma_m(const PairRow& j, std::size_t tag, const Eigen::MatrixXd& covariance) noexcept {
  const auto tags = static_cast<std::size_t>(covariance.rows() - 3) / model::kPairTerms.size();
  const PairIndex index = pair_index(tag, tags);
  double variance_m2 = 0.0;
  for (std::size_t i = 0; i < index.size(); ++i) {
    for (std::size_t k = 0; k < index.size(); ++k) {
      variance_m2 +=
          j(static_cast<Eigen::Index>(i)) * j(static_cast<Eigen::Index>(k)) * covariance(index[i], index[k]);
    }
  }
  return std::sqrt(std::max(0.0, variance_m2));
}

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

  // Least-squares fit of variance exp(-lag / time) to the medians: for each time the best variance.
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
    // The fit lowers the sum of squares by product^2 / square.
    if (product > 0.0 && product * product / square > best) {
      best = product * product / square;
      slow_m2 = product / square;
      time_s = time;
    }
  }
  slow_m2 = std::min(slow_m2, (1.0 - kLeastShare) * whole_m2);
  if (slow_m2 < kLeastShare * whole_m2) slow_m2 = 0.0;
  return model::RangeNoise{.white_sigma_m = std::sqrt(whole_m2 - slow_m2),
                           .bias_sigma_m = std::sqrt(slow_m2),
                           .bias_time_s = time_s};
}

}  // namespace groma::calibration
