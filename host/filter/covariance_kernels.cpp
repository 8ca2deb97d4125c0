#include "host/filter/covariance_kernels.hpp"

#include <array>
#include <cstddef>

#if defined(__x86_64__) && defined(__linux__) && !defined(__SANITIZE_ADDRESS__) && \
    !defined(__SANITIZE_THREAD__)
#define GROMA_CLONES __attribute__((target_clones("default", "avx2", "avx512f")))
#else
#define GROMA_CLONES
#endif

namespace groma::filter {

namespace {

// All columns begin at a multiple of 64 bytes.
double* aligned(double* at) noexcept {
  return static_cast<double*>(__builtin_assume_aligned(at, 64));
}

}  // namespace

GROMA_CLONES void move_cross(double* cross, int rows, const PoseRows& pose_rows) noexcept {
  double* const c = aligned(cross);
  const PoseRows f = pose_rows;
  const int end = padded(rows);
  for (int i = 0; i < end; ++i) {
    const auto at = [=](CoreIndex k) -> double& { return c[i + k * kCrossStride]; };
    const double x = at(kX), y = at(kY), theta = at(kTheta), scale = at(kScale), bias = at(kYawBias);
    const double vx = at(kOdometryVx), vy = at(kOdometryVy), omega = at(kOdometryOmega);
    const auto position = [&](int row) {
      return f(row, kX) * x + f(row, kY) * y + f(row, kTheta) * theta + f(row, kScale) * scale +
             f(row, kYawBias) * bias + f(row, kOdometryVx) * vx + f(row, kOdometryVy) * vy +
             f(row, kOdometryOmega) * omega;
    };
    at(kX) = position(kX);
    at(kY) = position(kY);
    at(kTheta) = f(kTheta, kTheta) * theta + f(kTheta, kYawBias) * bias + f(kTheta, kOdometryOmega) * omega;
  }
}

GROMA_CLONES void correct_cross(double* cross, int rows, const CoreVector& d_core, const CoreVector& gain_of,
                                double* q) noexcept {
  static_assert(kCoreSize == 9);
  double* const c = aligned(cross);
  double* const __restrict out = aligned(q);
  // Copies, which the stores to `c` cannot change: the loop is vectorized.
  const CoreVector d = d_core;      // NOLINT(performance-unnecessary-copy-initialization)
  const CoreVector gain = gain_of;  // NOLINT(performance-unnecessary-copy-initialization)
  const int end = padded(rows);
  for (int i = 0; i < end; ++i) {
    std::array<double, kCoreSize> v;
    for (std::size_t k = 0; k < kCoreSize; ++k) v[k] = c[i + static_cast<std::ptrdiff_t>(k) * kCrossStride];
    const double sum = ((out[i] + v[0] * d(0)) + (v[1] * d(1) + v[2] * d(2))) +
                       ((v[3] * d(3) + v[4] * d(4)) + (v[5] * d(5) + v[6] * d(6))) +
                       (v[7] * d(7) + v[8] * d(8));
    out[i] = sum;
    for (std::size_t k = 0; k < kCoreSize; ++k)
      c[i + static_cast<std::ptrdiff_t>(k) * kCrossStride] = v[k] - sum * gain[static_cast<Eigen::Index>(k)];
  }
}

GROMA_CLONES void subtract_square(double* lower, int stride, int size, const double* g) noexcept {
  const double* const __restrict v = g;
  const int end = padded(size);
  // Four columns at once, from the aligned row group of the diagonal on; nothing reads what is above it.
  for (int j = 0; j < size; j += 4) {
    double* const column = aligned(lower) + static_cast<std::ptrdiff_t>(j) * stride;
    double* const __restrict p0 = aligned(column);
    double* const __restrict p1 = aligned(column + stride);
    double* const __restrict p2 = aligned(column + 2 * static_cast<std::ptrdiff_t>(stride));
    double* const __restrict p3 = aligned(column + 3 * static_cast<std::ptrdiff_t>(stride));
    const double g0 = v[j], g1 = v[j + 1], g2 = v[j + 2], g3 = v[j + 3];
    for (int line = j - j % kKernelStep; line < end; line += kKernelStep) {
      for (int i = line; i < line + kKernelStep; ++i) {
        const double at = v[i];
        p0[i] -= g0 * at;
        p1[i] -= g1 * at;
        p2[i] -= g2 * at;
        p3[i] -= g3 * at;
      }
    }
  }
}

GROMA_CLONES void subtract_column(double* column, int from, int size, double scale,
                                  const double* g) noexcept {
  double* const __restrict p = column;
  const double* const __restrict v = g;
  for (int i = from; i < size; ++i) p[i] -= scale * v[i];
}

GROMA_CLONES void add_columns(const double* lower, int stride, int size, int first, int count,
                              const double* w, double* out) noexcept {
  double* const __restrict sum = out;
  std::array<double, kMaxAnchorSize> weight{};
  std::array<int, kMaxAnchorSize> at{};
  std::size_t weights = 0;
  for (int k = 0; k < count; ++k) {
    if (w[k] == 0.0) continue;
    weight[weights] = w[k];
    at[weights++] = first + k;
  }
  for (int i = 0; i < first; ++i) {
    const double* const row = lower + static_cast<std::ptrdiff_t>(i) * stride;
    double dot = 0.0;
    for (std::size_t k = 0; k < weights; ++k) dot += weight[k] * row[at[k]];
    sum[i] += dot;
  }
  for (std::size_t k = 0; k < weights; ++k) {
    const double* const __restrict column = lower + static_cast<std::ptrdiff_t>(at[k]) * stride;
    const double factor = weight[k];
    for (int i = first + count; i < size; ++i) sum[i] += factor * column[i];
  }
}

}  // namespace groma::filter
