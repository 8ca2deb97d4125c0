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

}  // namespace groma::calibration
