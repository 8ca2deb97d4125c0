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

GROMA_CLONES void move_cross(double* cross, int rows, const PoseRows& f) noexcept {
  double* const c = aligned(cross);
  double* const __restrict x = c + kX * kCrossStride;
  double* const __restrict y = c + kY * kCrossStride;
  double* const __restrict theta = c + kTheta * kCrossStride;
  const double* const __restrict scale = c + kScale * kCrossStride;
  const double* const __restrict bias = c + kYawBias * kCrossStride;
  const double* const __restrict row_vx = c + kRowVx * kCrossStride;
  const double* const __restrict row_vy = c + kRowVy * kCrossStride;
  const double* const __restrict row_omega = c + kRowOmega * kCrossStride;
  const int end = padded(rows);
  const double xx = f(0, kX), xy = f(0, kY), xt = f(0, kTheta), xs = f(0, kScale), xb = f(0, kYawBias);
  const double xu = f(0, kRowVx), xv = f(0, kRowVy), xo = f(0, kRowOmega);
  const double yx = f(1, kX), yy = f(1, kY), yt = f(1, kTheta), ys = f(1, kScale), yb = f(1, kYawBias);
  const double yu = f(1, kRowVx), yv = f(1, kRowVy), yo = f(1, kRowOmega);
  const double tt = f(2, kTheta), tb = f(2, kYawBias), to = f(2, kRowOmega);
  for (int i = 0; i < end; ++i) {
    const double cx = x[i], cy = y[i], ct = theta[i], cs = scale[i], cb = bias[i];
    const double cu = row_vx[i], cv = row_vy[i], co = row_omega[i];
    x[i] = xx * cx + xy * cy + xt * ct + xs * cs + xb * cb + xu * cu + xv * cv + xo * co;
    y[i] = yx * cx + yy * cy + yt * ct + ys * cs + yb * cb + yu * cu + yv * cv + yo * co;
    theta[i] = tt * ct + tb * cb + to * co;
  }
}

GROMA_CLONES void correct_cross(double* cross, int rows, const CoreVector& d, const CoreVector& gain,
                                double* q) noexcept {
  static_assert(kCoreSize == 9);
  double* const c = aligned(cross);
  double* const __restrict out = aligned(q);
  double* const __restrict c0 = c;
  double* const __restrict c1 = c + 1 * kCrossStride;
  double* const __restrict c2 = c + 2 * kCrossStride;
  double* const __restrict c3 = c + 3 * kCrossStride;
  double* const __restrict c4 = c + 4 * kCrossStride;
  double* const __restrict c5 = c + 5 * kCrossStride;
  double* const __restrict c6 = c + 6 * kCrossStride;
  double* const __restrict c7 = c + 7 * kCrossStride;
  double* const __restrict c8 = c + 8 * kCrossStride;
  const double d0 = d(0), d1 = d(1), d2 = d(2), d3 = d(3), d4 = d(4), d5 = d(5), d6 = d(6), d7 = d(7),
               d8 = d(8);
  const double g0 = gain(0), g1 = gain(1), g2 = gain(2), g3 = gain(3), g4 = gain(4), g5 = gain(5),
               g6 = gain(6), g7 = gain(7), g8 = gain(8);
  const int end = padded(rows);
  for (int i = 0; i < end; ++i) {
    const double v0 = c0[i], v1 = c1[i], v2 = c2[i], v3 = c3[i], v4 = c4[i], v5 = c5[i], v6 = c6[i],
                 v7 = c7[i], v8 = c8[i];
    const double sum = ((out[i] + v0 * d0) + (v1 * d1 + v2 * d2)) +
                       ((v3 * d3 + v4 * d4) + (v5 * d5 + v6 * d6)) + (v7 * d7 + v8 * d8);
    out[i] = sum;
    c0[i] = v0 - sum * g0;
    c1[i] = v1 - sum * g1;
    c2[i] = v2 - sum * g2;
    c3[i] = v3 - sum * g3;
    c4[i] = v4 - sum * g4;
    c5[i] = v5 - sum * g5;
    c6[i] = v6 - sum * g6;
    c7[i] = v7 - sum * g7;
    c8[i] = v8 - sum * g8;
  }
}

GROMA_CLONES void subtract_square(double* lower, int stride, int size, const double* g) noexcept {
  const double* const __restrict v = g;
  const int end = padded(size);
  // Four columns at once, from the line of the first one's row on: what is above the diagonal is never read.
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
