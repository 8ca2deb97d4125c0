// The loops over many parameters, apart so that they are compiled for speed, on x86-64 for AVX2 and AVX-512
// too, which is chosen when the program starts. Each operation is rounded alike in all: results do not depend
// on it.
//
// Vectors and columns begin at multiples of 64 bytes and are padded with zeros to multiples of kKernelStep.
#pragma once

#include <cstddef>

#include "host/filter/state.hpp"

namespace groma::filter {

inline constexpr int kKernelStep = 8;

[[nodiscard]] constexpr int padded(int size) noexcept {
  return (size + kKernelStep - 1) / kKernelStep * kKernelStep;
}

// Columns of the cross-covariance stand so far apart. Behind the parameters' rows there is place for those of
// JointCovariance's absent anchors.
inline constexpr std::ptrdiff_t kCrossStride = padded(kMaxParameters + kCoreSize);

// C <- C F^T, with F the identity but for the pose's rows, whose derivatives by the delay are zero.
void move_cross(double* cross, int rows, const PoseRows& pose_rows) noexcept;

// q <- q + C d; C <- C - q gain^T.
void correct_cross(double* cross, int rows, const CoreVector& d, const CoreVector& gain, double* q) noexcept;

// P <- P - g g^T, of the lower triangle, column by column; what stands above it is undefined.
void subtract_square(double* lower, int stride, int size, const double* g) noexcept;
// The same of column j alone with another factor: P(i, j) <- P(i, j) - scale g(i) for i from j on.
void subtract_column(double* column, int from, int size, double scale, const double* g) noexcept;

// out(i) <- sum over k of w(k) P(i, first + k), i from first + count on, and the same of P(first + k, i) for
// i before first: what `count` neighbouring columns of the symmetric matrix give, but for their own block.
void add_columns(const double* lower, int stride, int size, int first, int count, const double* w,
                 double* out) noexcept;

}  // namespace groma::filter
