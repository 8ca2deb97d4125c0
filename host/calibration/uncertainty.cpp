#include "host/calibration/uncertainty.hpp"

#include <algorithm>
#include <cmath>

#include <Eigen/Cholesky>

namespace groma::calibration {
namespace {

constexpr int kBlockLevels = 9;  // each twice as long as the one before: up to 128 s
constexpr double kMinBlocks = 8.0;
constexpr double kScoreBlock_s = 0.5;
constexpr double kMaxScoreBlocks = 4096.0;
// An excess of the scatter counts from so many of its own standard deviations on.
constexpr double kSignificance = 2.5;
// The mean curvature of a kernel is believed no further below its majorizer than this.
constexpr double kMinCurvatureShare = 0.3;

// What one pair's rows say together.
struct PairMoments {
  PairBlock weighted = PairBlock::Zero();  // sum of weight J J^T, its lower triangle
  double weight = 0.0;
  double curvature = 0.0;
  double square_slope = 0.0;
};

void add_pair(const PairBlock& block, double factor, std::size_t tag, std::size_t tag_count,
              Eigen::MatrixXd& out) {
  const Eigen::Index index[5] = {0, 1, 2, beta_index(tag), gamma_index(tag, tag_count)};
  for (int i = 0; i < 5; ++i) {
    for (int j = 0; j < 5; ++j) out(index[i], index[j]) += factor * block(i, j);
  }
}

// Scatter of the score at one block length, over what independent residuals give, and how well it is known.
struct Scatter {
  double observed = 0.0;
  double expected = 0.0;
  double blocks = 0.0;
};

std::vector<Scatter> scatter_by_block_length(const Evidence& evidence) {
  std::vector<Scatter> out(kBlockLevels);
  const Eigen::Index size = evidence.information.rows();
  const Eigen::MatrixXd weighing = evidence.information.ldlt().solve(Eigen::MatrixXd::Identity(size, size));
  const double independent = (weighing * evidence.score_variance).trace();
  std::vector<Eigen::VectorXd> scores = evidence.scores;
  for (Scatter& scatter : out) {
    for (const Eigen::VectorXd& score : scores) {
      if (score.isZero(0.0)) continue;
      scatter.observed += score.dot(weighing * score);
      scatter.blocks += 1.0;
    }
    // The scores of all blocks sum to nearly nothing at the solution: one block's worth is missing.
    if (scatter.blocks > 1.0) scatter.expected = independent * (1.0 - 1.0 / scatter.blocks);
    for (std::size_t i = 0; 2 * i < scores.size(); ++i) {
      scores[i] = scores[2 * i];
      if (2 * i + 1 < scores.size()) scores[i] += scores[2 * i + 1];
    }
    scores.resize((scores.size() + 1) / 2);
  }
  return out;
}

double ratio(const Scatter& scatter) {
  return scatter.expected > 0.0 ? scatter.observed / scatter.expected : 1.0;
}

// The largest significant ratio among block lengths, at least 1.
double significant_ratio(std::span<const Scatter> levels, double dimensions) {
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
  std::vector<PairMoments> pairs(tags);
  for (const Observation& row : problem.rows) {
    const model::AntennaPrediction predicted = predict(row, fit.anchor, tags);
    const double residual_m = row.range_m - predicted.range_m;
    const RobustKernel& kernel = fit.kernels[row.tag];
    const RowValue whole = value_of(problem, fit.kernels, row, residual_m, fit.anchor);
    const KernelValue& value = whole.seen;
    const PairRow j = pair_jacobian(predicted, fit.anchor(gamma_index(row.tag, tags)));
    PairMoments& pair = pairs[row.tag];
    add_square(j, value.weight, pair.weighted);
    pair.weight += value.weight;
    // Of the mixture: the variance of the slope between what is in sight and what is not counts too.
    pair.curvature += whole.seen_share * kernel.curvature(residual_m);
    if (whole.seen_share > 0.0) {
      pair.curvature -= (1.0 / whole.seen_share - 1.0) * value.slope * value.slope;
    }
    pair.square_slope += value.slope * value.slope;

    const double elapsed_s = std::max(0.0, row.t_s - begin_s);
    const auto block = static_cast<std::size_t>(elapsed_s / block_s);
    if (out.scores.size() <= block) out.scores.resize(block + 1, Eigen::VectorXd::Zero(size));
    Eigen::VectorXd& score = out.scores[block];
    score.head<3>() += value.slope * j.head<3>();
    score(beta_index(row.tag)) += value.slope;
    score(gamma_index(row.tag, tags)) += value.slope * j(4);
    if (!(whole.wall_weight > 0.0)) continue;
    const WallRow walled = wall_row(j, problem.sight->rows[row.index], row.tag, tags);
    add(walled, whole.wall_slope, score);
    add_square(walled, whole.wall_weight, out.information);
    add_square(walled, whole.wall_slope * whole.wall_slope, out.score_variance);
  }
  for (std::size_t tag = 0; tag < tags; ++tag) {
    const PairMoments& pair = pairs[tag];
    if (!(pair.weight > 0.0)) continue;
    const double curvature = std::clamp(pair.curvature / pair.weight, kMinCurvatureShare, 1.0);
    const PairBlock weighted = pair.weighted.selfadjointView<Eigen::Lower>();
    add_pair(weighted, curvature, tag, tags, out.information);
    add_pair(weighted, pair.square_slope / pair.weight, tag, tags, out.score_variance);
  }
  return out;
}

std::vector<double> score_inflation(std::span<const Evidence> evidence) {
  std::vector<double> own;
  std::vector<Scatter> site(kBlockLevels);
  double dimensions = 1.0;
  for (const Evidence& anchor : evidence) {
    dimensions = static_cast<double>(anchor.information.rows());
    const std::vector<Scatter> levels = scatter_by_block_length(anchor);
    for (std::size_t level = 0; level < levels.size(); ++level) {
      if (!(levels[level].expected > 0.0)) continue;
      // Normalized, so that no anchor speaks louder for having more ranges.
      site[level].observed += levels[level].blocks * ratio(levels[level]);
      site[level].expected += levels[level].blocks;
      site[level].blocks += levels[level].blocks;
    }
    own.push_back(significant_ratio(levels, dimensions));
  }
  const double common = significant_ratio(site, dimensions);
  for (double& inflation : own) inflation = std::max(inflation, common);
  return own;
}

double inflation_within(const Evidence& evidence, double duration_s) {
  const std::vector<Scatter> levels = scatter_by_block_length(evidence);
  std::size_t count = 0;
  for (double block_s = kScoreBlock_s; block_s <= duration_s && count < levels.size(); block_s *= 2.0)
    ++count;
  return significant_ratio(std::span(levels).first(count), static_cast<double>(evidence.information.rows()));
}

Eigen::MatrixXd anchor_covariance(const Evidence& evidence, double inflation) {
  const Eigen::Index size = evidence.information.rows();
  if (evidence.surveyed) {
    const Eigen::Index biases = size - 3;
    const Eigen::LDLT<Eigen::MatrixXd> information(evidence.information.bottomRightCorner(biases, biases));
    // Biases move by this where the position moves by one.
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

}  // namespace groma::calibration
