// The loops over many parameters, in a file of their own so that they are compiled for speed. On x86-64 there
// are variants for AVX2 and AVX-512, selected at program start. All variants round each operation alike, so
// results do not depend on the variant.
//
// Vectors and columns are aligned to 64 bytes and padded with zeros to multiples of kKernelStep.
#pragma once

#include <cstddef>

#include "host/filter/state.hpp"

namespace groma::filter {

inline constexpr int kKernelStep = 8;  // doubles in 64 bytes, the width of AVX-512

[[nodiscard]] constexpr int padded(int size) noexcept {
  return (size + kKernelStep - 1) / kKernelStep * kKernelStep;
}

// Column stride of the cross-covariance. Behind the parameters' rows there is room for the kCoreSize rows of
// JointCovariance::absence().
inline constexpr std::ptrdiff_t kCrossStride = padded(kMaxParameters + kCoreSize);

// C <- C F^T, with F the identity except the pose's rows, whose derivatives w.r.t. the delay are zero.
void move_cross(double* cross, int rows, const PoseRows& pose_rows) noexcept;

// q <- q + C d; C <- C - q gain^T.
void correct_cross(double* cross, int rows, const CoreVector& d, const CoreVector& gain, double* q) noexcept;

// P <- P - g g^T for the lower triangle, stored by columns; the entries above it are undefined.
void subtract_square(double* lower, int stride, int size, const double* g) noexcept;
// One column j of such an update: P(i, j) <- P(i, j) - scale g(i) for i >= from = j.
void subtract_column(double* column, int from, int size, double scale, const double* g) noexcept;

// out += P w for `count` adjacent columns of the symmetric matrix P, except the rows of their own diagonal
// block: out(i) += sum over k of w(k) P(i, first + k) for i >= first + count, and of w(k) P(first + k, i) for
// i < first.
void add_columns(const double* lower, int stride, int size, int first, int count, const double* w,
                 double* out) noexcept;

}  // namespace groma::filter
