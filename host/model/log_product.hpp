// The logarithm of a product of many factors. A logarithm takes longer than all the rest of a robust cost, so
// the factors are multiplied first.
#pragma once

#include <cmath>

namespace groma::model {

class LogProduct {
 public:
  // factor: at least 1, at most 1e150.
  void multiply(double factor) noexcept {
    product_ *= factor;
    if (product_ < kMost) return;
    logarithms_ += std::log(product_);
    product_ = 1.0;
  }
  [[nodiscard]] double logarithm() const noexcept { return logarithms_ + std::log(product_); }

 private:
  static constexpr double kMost = 1e150;  // numerics: keeps the next product from overflowing (1.8e308)
  double product_ = 1.0;
  double logarithms_ = 0.0;
};

}  // namespace groma::model
