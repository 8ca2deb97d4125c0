#include "test/baseline/method.hpp"

#include <cmath>
#include <ctime>
#include <numbers>

namespace groma::baseline {

namespace {

constexpr double kAnchorInterval_s = 1.0;

// CPU time of this thread: other programs do not count.
double cpu_ns() {
  timespec now{};
  ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
  return 1e9 * static_cast<double>(now.tv_sec) + static_cast<double>(now.tv_nsec);
}

}  // namespace

Outcome run(const Drive& drive, Method& method) {
  Outcome out;
  double now_s = drive.start.t_s;
  double anchors_s = now_s;
  double in_ranges_ns = 0.0;
  double in_odometry_ns = 0.0;
  const auto move_to = [&](double t_s) {
    if (t_s > now_s) method.move(t_s - now_s);
    now_s = std::max(now_s, t_s);
  };
  auto range = drive.ranges.begin();
  // Includes the motion up to the range.
  const auto take_ranges = [&](double to_s) {
    const double begin_ns = cpu_ns();
    for (; range != drive.ranges.end() && range->t_s <= to_s; ++range) {
      move_to(range->t_s);
      ++(method.measure(*range) ? out.ranges : out.rejected);
    }
    in_ranges_ns += cpu_ns() - begin_ns;
  };
  for (const model::OdometrySample& sample : drive.odometry) {
    take_ranges(sample.t_s);
    const double begin_ns = cpu_ns();
    move_to(sample.t_s);
    method.hold({sample, drive.odometry_interval_s});
    if (sample.t_s >= drive.start.t_s && method.has_row(sample.t_s))
      out.rows.push_back(method.estimate(sample.t_s));
    in_odometry_ns += cpu_ns() - begin_ns;
    if (now_s < anchors_s) continue;
    const std::vector<Eigen::Vector3d> anchors_m = method.anchors_m();
    for (std::size_t i = 0; i < anchors_m.size(); ++i) out.anchors.push_back({now_s, i, anchors_m[i]});
    anchors_s += kAnchorInterval_s;
  }
  const auto per = [](double sum_ns, std::size_t count) {
    return count == 0 ? 0.0 : sum_ns / static_cast<double>(count);
  };
  const std::size_t ranges = out.ranges + out.rejected;
  out.ns_per_range = per(in_ranges_ns, ranges);
  out.ns_per_odometry = per(in_odometry_ns, drive.odometry.size());
  out.ns_in_all_per_range = per(in_ranges_ns + in_odometry_ns, ranges);
  return out;
}

double Random::uniform() noexcept {
  state_ += 0x9e3779b97f4a7c15U;
  std::uint64_t z = state_;
  z = (z ^ (z >> 30U)) * 0xbf58476d1ce4e5b9U;
  z = (z ^ (z >> 27U)) * 0x94d049bb133111ebU;
  return static_cast<double>((z ^ (z >> 31U)) >> 11U) * 0x1p-53;
}

double Random::gaussian() noexcept {
  if (has_spare_) {
    has_spare_ = false;
    return spare_;
  }
  const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
  const double angle = 2.0 * std::numbers::pi * uniform();
  spare_ = radius * std::sin(angle);
  has_spare_ = true;
  return radius * std::cos(angle);
}

}  // namespace groma::baseline
