#include "host/diagnosis/range_fit.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/QR>

#include "host/diagnosis/student.hpp"
#include "host/model/median.hpp"

namespace groma::diagnosis {
namespace {

// No range is better than this. By hand.
constexpr double kLeastScale_m = 0.005;
// An iteration that gains less than this a row is the last: by hand, of 3000 rows a tenth of what a
// parameter gains that is off by one sigma.
constexpr double kConverged = 1e-5;

struct BlockRange {
  std::size_t begin = 0;
  std::size_t end = 0;
};

std::vector<BlockRange> blocks_of(const Scene& scene) {
  std::vector<BlockRange> out(scene.block_count());
  const auto rows = scene.rows();
  for (std::size_t i = 0; i < rows.size(); ++i) {
    BlockRange& block = out[rows[i].block];
    if (block.end == 0) block.begin = i;
    block.end = i + 1;
  }
  return out;
}

double median_size(std::vector<double> values) {
  std::erase_if(values, [](double value) { return !std::isfinite(value); });
  if (values.empty()) return kLeastScale_m;
  for (double& value : values) value = std::abs(value);
  return std::max(1.5 * model::median(std::move(values)), kLeastScale_m);
}

double prior_cost(const Scene& scene, const Eigen::VectorXd& block) {
  return 0.5 * ((block - scene.prior_mean()).array() / scene.prior_sigma().array()).square().sum();
}

// Ranges measured less predicted, NaN without an antenna, and the predictions' derivatives, a column each.
struct Evaluated {
  std::vector<double> residuals;
  Eigen::Matrix3Xd by_antenna;
  Eigen::MatrixXd by_block;
};

class Fitter {
 public:
  Fitter(const Scene& scene, const Parameters& parameters)
      : scene_(scene), parameters_(parameters), rows_(scene.rows()), ranges_(blocks_of(scene)) {
    derivatives_.block.resize(scene.prior_mean().size());
    prior_information_ = scene.prior_sigma().array().square().inverse();
  }

  // Searches the blocks if none are given.
  RangeFit run(std::vector<Eigen::VectorXd> blocks, int max_iterations) {
    RangeFit best;
    best.at = parameters_.start;
    locate(best.at, antennas_);
    best.blocks = std::move(blocks);
    if (best.blocks.empty()) {
      for (const BlockRange range : ranges_) best.blocks.push_back(search_block(range));
    }
    evaluate_all(antennas_, best.blocks, now_);
    best.scale_m = median_size(now_.residuals);
    score(now_.residuals, best, 20);
    iterate(best, max_iterations);
    return best;
  }

 private:
  void locate(const Eigen::VectorXd& at, std::vector<Eigen::Vector3d>& out) const {
    scene_.locate(parameters_.mistake(at), out);
  }

  // Of row i into column k.
  void evaluate(std::size_t i, const Eigen::Vector3d& antenna_m, const Eigen::VectorXd& block, Evaluated& out,
                std::size_t k) {
    out.residuals[k] = rows_[i].range_m - scene_.predict_m(rows_[i], antenna_m, block, derivatives_);
    out.by_antenna.col(static_cast<Eigen::Index>(k)) = derivatives_.antenna;
    out.by_block.col(static_cast<Eigen::Index>(k)) = derivatives_.block;
  }

  void resize(Evaluated& out, std::size_t rows) const {
    out.residuals.resize(rows);
    out.by_antenna.resize(3, static_cast<Eigen::Index>(rows));
    out.by_block.resize(scene_.prior_mean().size(), static_cast<Eigen::Index>(rows));
  }

  void evaluate_all(const std::vector<Eigen::Vector3d>& antennas, const std::vector<Eigen::VectorXd>& blocks,
                    Evaluated& out) {
    resize(out, rows_.size());
    for (std::size_t i = 0; i < rows_.size(); ++i) evaluate(i, antennas[i], blocks[rows_[i].block], out, i);
  }

  // Scale and cost of these residuals, priors included.
  void score(std::span<const double> residuals, RangeFit& fit, int iterations) const {
    fit.scale_m = student_scale(residuals, fit.scale_m, kLeastScale_m, iterations);
    std::vector<StudentCost> slices(kSlices, StudentCost(fit.scale_m));
    for (std::size_t i = 0; i < rows_.size(); ++i) {
      if (std::isfinite(residuals[i])) slices[rows_[i].slice].add(residuals[i]);
    }
    double sum = 0.0;
    fit.rows = 0;
    fit.slice_cost.clear();
    for (const StudentCost& slice : slices) {
      const double cost = slice.sum();
      sum += cost;
      fit.rows += slice.count();
      fit.slice_cost.push_back(cost / static_cast<double>(slice.count()));  // NaN without rows
    }
    for (const Eigen::VectorXd& block : fit.blocks) sum += prior_cost(scene_, block);
    sum += 0.5 * ((fit.at - parameters_.start).array() / parameters_.prior_sigma.array()).square().sum();
    fit.cost = fit.rows > 0 ? sum / static_cast<double>(fit.rows) : std::numeric_limits<double>::infinity();
  }

  // The best of the block's starts, each improved by itself.
  Eigen::VectorXd search_block(BlockRange range) {
    const std::size_t size = range.end - range.begin;
    std::vector<Eigen::VectorXd> starts =
        scene_.starts(rows_.subspan(range.begin, size), std::span(antennas_).subspan(range.begin, size));
    Eigen::VectorXd best = scene_.prior_mean();
    double best_cost = std::numeric_limits<double>::infinity();
    for (Eigen::VectorXd& start : starts) {
      const double cost = improve_block(range, start);
      if (cost < best_cost) {
        best_cost = cost;
        best = start;
      }
    }
    return best;
  }

  double block_cost(BlockRange range, const Eigen::VectorXd& block, double& scale_m, int iterations,
                    Evaluated& out) {
    resize(out, range.end - range.begin);
    for (std::size_t i = range.begin; i < range.end; ++i)
      evaluate(i, antennas_[i], block, out, i - range.begin);
    if (scale_m == 0.0) scale_m = median_size(out.residuals);
    scale_m = student_scale(out.residuals, scale_m, kLeastScale_m, iterations);
    StudentCost cost(scale_m);
    for (const double residual : out.residuals) {
      if (std::isfinite(residual)) cost.add(residual);
    }
    return prior_cost(scene_, block) + cost.sum();
  }

  double improve_block(BlockRange range, Eigen::VectorXd& block) {
    double scale_m = 0.0;
    double cost = block_cost(range, block, scale_m, 10, now_);
    double damping = 1e-2;
    for (int iteration = 0; iteration < 15; ++iteration) {
      Eigen::MatrixXd information = prior_information_.asDiagonal();
      Eigen::VectorXd gradient = prior_information_.cwiseProduct(scene_.prior_mean() - block);
      for (std::size_t k = 0; k < now_.residuals.size(); ++k) {
        const double r = now_.residuals[k];
        if (!std::isfinite(r)) continue;
        const double weight = student_weight(r, scale_m) / (scale_m * scale_m);
        const auto by_block = now_.by_block.col(static_cast<Eigen::Index>(k));
        information += weight * by_block.lazyProduct(by_block.transpose());
        gradient += weight * r * by_block;
      }
      bool improved = false;
      double gained = 0.0;
      for (int attempt = 0; attempt < 6 && !improved; ++attempt) {
        Eigen::MatrixXd damped = information;
        damped.diagonal() *= 1.0 + damping;
        damped.diagonal().array() += 1e-9;
        const Eigen::VectorXd next = block + damped.ldlt().solve(gradient);
        double next_scale_m = scale_m;
        const double next_cost = block_cost(range, next, next_scale_m, 2, next_);
        improved = next_cost < cost;
        damping = improved ? std::max(1e-7, 0.2 * damping) : 8.0 * damping;
        if (!improved) continue;
        gained = cost - next_cost;
        block = next;
        cost = next_cost;
        scale_m = next_scale_m;
        std::swap(now_, next_);
      }
      if (!improved || gained < 0.01) break;
    }
    return cost;
  }

  // Levenberg-Marquardt on all unknowns; the blocks are eliminated (Schur complement).
  void iterate(RangeFit& best, int max_iterations) {
    const Eigen::Index p = parameters_.start.size();
    const Eigen::Index n = scene_.prior_mean().size();
    const std::size_t blocks = ranges_.size();
    const Eigen::VectorXd shared_prior = parameters_.prior_sigma.array().square().inverse();
    std::vector<std::vector<Eigen::Vector3d>> moved(static_cast<std::size_t>(p));
    std::vector<Eigen::MatrixXd> a(blocks);  // information of the blocks
    std::vector<Eigen::MatrixXd> c(blocks);  // of blocks and shared parameters
    std::vector<Eigen::VectorXd> g(blocks);
    Eigen::MatrixXd shared(p, p);
    Eigen::VectorXd shared_g(p);
    Eigen::MatrixXd row_shared(p, static_cast<Eigen::Index>(rows_.size()));
    double damping = 1e-3;
    std::vector<Eigen::Vector3d> next_antennas;
    for (int iteration = 0; iteration < max_iterations; ++iteration) {
      for (Eigen::Index k = 0; k < p; ++k) {
        Eigen::VectorXd at = best.at;
        at(k) += parameters_.step(k);
        locate(at, moved[static_cast<std::size_t>(k)]);
      }
      shared = shared_prior.asDiagonal();
      shared_g = shared_prior.cwiseProduct(parameters_.start - best.at);
      for (std::size_t b = 0; b < blocks; ++b) {
        a[b] = prior_information_.asDiagonal();
        c[b].setZero(n, p);
        g[b] = prior_information_.cwiseProduct(scene_.prior_mean() - best.blocks[b]);
      }
      for (std::size_t i = 0; i < rows_.size(); ++i) {
        const auto column = static_cast<Eigen::Index>(i);
        row_shared.col(column).setZero();
        const double r = now_.residuals[i];
        if (!std::isfinite(r)) continue;
        const std::size_t b = rows_[i].block;
        const auto by_block = now_.by_block.col(column);
        for (Eigen::Index k = 0; k < p; ++k) {
          const Eigen::Vector3d by =
              (moved[static_cast<std::size_t>(k)][i] - antennas_[i]) / parameters_.step(k);
          row_shared(k, column) = by.allFinite() ? now_.by_antenna.col(column).dot(by) : 0.0;
        }
        const double weight = student_weight(r, best.scale_m) / (best.scale_m * best.scale_m);
        a[b] += weight * by_block.lazyProduct(by_block.transpose());
        g[b] += weight * r * by_block;
        if (p == 0) continue;
        c[b] += weight * by_block.lazyProduct(row_shared.col(column).transpose());
        shared += weight * row_shared.col(column).lazyProduct(row_shared.col(column).transpose());
        shared_g += weight * r * row_shared.col(column);
      }
      bool improved = false;
      double gained = 0.0;
      for (int attempt = 0; attempt < 7 && !improved; ++attempt) {
        Eigen::MatrixXd reduced = shared;
        reduced.diagonal() *= 1.0 + damping;
        Eigen::VectorXd reduced_g = shared_g;
        std::vector<Eigen::LDLT<Eigen::MatrixXd>> solvers(blocks);
        for (std::size_t b = 0; b < blocks; ++b) {
          Eigen::MatrixXd damped = a[b];
          damped.diagonal() *= 1.0 + damping;
          damped.diagonal().array() += 1e-9;
          solvers[b].compute(damped);
          if (p == 0) continue;
          reduced -= c[b].transpose() * solvers[b].solve(c[b]);
          reduced_g -= c[b].transpose() * solvers[b].solve(g[b]);
        }
        RangeFit next = best;
        Eigen::VectorXd step(p);
        if (p > 0) step = reduced.ldlt().solve(reduced_g);
        next.at += step;
        for (std::size_t b = 0; b < blocks; ++b) next.blocks[b] += solvers[b].solve(g[b] - c[b] * step);
        locate(next.at, next_antennas);
        evaluate_all(next_antennas, next.blocks, next_);
        score(next_.residuals, next, 2);
        improved = next.cost < best.cost;
        damping = improved ? std::max(1e-8, 0.2 * damping) : 8.0 * damping;
        if (!improved) continue;
        gained = best.cost - next.cost;
        best = std::move(next);
        antennas_.swap(next_antennas);
        std::swap(now_, next_);
      }
      if (!improved || gained < kConverged) break;
    }
    if (p > 0) estimate_covariance(a, c, shared, row_shared, best);
  }

  // From the scatter of the slices' scores with the blocks eliminated, plus that of the model.
  void estimate_covariance(const std::vector<Eigen::MatrixXd>& a, const std::vector<Eigen::MatrixXd>& c,
                           const Eigen::MatrixXd& shared, const Eigen::MatrixXd& row_shared, RangeFit& best) {
    const Eigen::Index p = shared.rows();
    Eigen::MatrixXd information = shared;
    std::vector<Eigen::MatrixXd> gains;
    for (std::size_t b = 0; b < a.size(); ++b) {
      Eigen::MatrixXd damped = a[b];
      damped.diagonal().array() += 1e-9;
      gains.emplace_back(damped.ldlt().solve(c[b]));
      information -= c[b].transpose() * gains.back();
    }
    Eigen::MatrixXd scores = Eigen::MatrixXd::Zero(p, kSlices);
    for (std::size_t i = 0; i < rows_.size(); ++i) {
      const double r = now_.residuals[i];
      if (!std::isfinite(r)) continue;
      const auto column = static_cast<Eigen::Index>(i);
      const double weight = student_weight(r, best.scale_m) / (best.scale_m * best.scale_m);
      scores.col(rows_[i].slice) +=
          weight * r *
          (row_shared.col(column) - gains[rows_[i].block].transpose() * now_.by_block.col(column));
    }
    const Eigen::MatrixXd inverse = information.ldlt().solve(Eigen::MatrixXd::Identity(p, p));
    best.covariance = inverse * (scores * scores.transpose()) * inverse + inverse;
  }

  const Scene& scene_;
  const Parameters& parameters_;
  std::span<const RangeRow> rows_;
  std::vector<BlockRange> ranges_;
  Eigen::VectorXd prior_information_;
  RangeDerivatives derivatives_;
  std::vector<Eigen::Vector3d> antennas_;
  Evaluated now_;   // of the best blocks and parameters; while a block is searched, of its rows alone
  Evaluated next_;  // of a trial
};

}  // namespace

Eigen::Vector3d laterate(const Eigen::MatrixX3d& j, const Eigen::VectorXd& y,
                         const Eigen::VectorXd& distance_m, int rounds) {
  Eigen::VectorXd weight = distance_m.cwiseInverse();
  Eigen::Vector3d solution = Eigen::Vector3d::Zero();
  for (int round = 0; round < rounds; ++round) {
    solution = (weight.asDiagonal() * j).colPivHouseholderQr().solve(weight.cwiseProduct(y));
    const Eigen::ArrayXd error_m = ((y - j * solution).array() / (2.0 * distance_m.array())).abs();
    weight = (distance_m.array() * (0.2 + error_m).sqrt()).inverse();
  }
  return solution;
}

RangeFit fit_ranges(const Scene& scene, const Parameters& parameters, int max_iterations) {
  return Fitter(scene, parameters).run({}, max_iterations);
}

RangeFit fit_ranges_near(const Scene& scene, const Parameters& parameters,
                         std::vector<Eigen::VectorXd> blocks) {
  constexpr int kMaxIterations = 60;
  return Fitter(scene, parameters).run(std::move(blocks), kMaxIterations);
}

}  // namespace groma::diagnosis
