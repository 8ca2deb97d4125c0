// Derivatives by central differences, to check analytical ones.
#pragma once

#include <functional>

#include <Eigen/Core>

namespace groma::test {

// d f / d x at x, one column per component of x; step: the perturbation to each side.
inline Eigen::MatrixXd numerical_jacobian(const std::function<Eigen::VectorXd(const Eigen::VectorXd&)>& f,
                                          const Eigen::VectorXd& x, double step = 1e-5) {
  const Eigen::Index rows = f(x).size();
  Eigen::MatrixXd jacobian(rows, x.size());
  for (Eigen::Index i = 0; i < x.size(); ++i) {
    Eigen::VectorXd ahead = x;
    Eigen::VectorXd behind = x;
    ahead(i) += step;
    behind(i) -= step;
    jacobian.col(i) = (f(ahead) - f(behind)) / (2.0 * step);
  }
  return jacobian;
}

}  // namespace groma::test
