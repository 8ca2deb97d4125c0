// Random numbers for tests, identical on every machine (SplitMix64).
#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>

#include <Eigen/Cholesky>
#include <Eigen/Core>

namespace groma::test {

class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}

  std::uint64_t next() {
    state_ += 0x9e3779b97f4a7c15ULL;
    std::uint64_t z = state_;
    z = (z ^ (z >> 30U)) * 0xbf58476d1ce4e5b9ULL;
    z = (z ^ (z >> 27U)) * 0x94d049bb133111ebULL;
    return z ^ (z >> 31U);
  }
  // In [0, 1).
  double uniform() { return static_cast<double>(next() >> 11U) * 0x1.0p-53; }
  double uniform(double low, double high) { return low + (high - low) * uniform(); }
  double gaussian() {
    const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
    return radius * std::cos(2.0 * std::numbers::pi * uniform());
  }
  Eigen::VectorXd gaussians(Eigen::Index size) {
    return Eigen::VectorXd::NullaryExpr(size, [this](Eigen::Index) { return gaussian(); });
  }
  // A zero-mean draw with this covariance (positive semidefinite).
  Eigen::VectorXd gaussians(const Eigen::MatrixXd& covariance) {
    const Eigen::LDLT<Eigen::MatrixXd> ldlt(covariance);
    Eigen::VectorXd draw = gaussians(covariance.rows());
    draw = ldlt.vectorD().cwiseMax(0.0).cwiseSqrt().cwiseProduct(draw);
    draw = ldlt.matrixL() * draw;
    return ldlt.transpositionsP().transpose() * draw;
  }

 private:
  std::uint64_t state_;
};

}  // namespace groma::test
