// A short simulated drive for tests without shared data: a figure of eight among six anchors, two tags,
// biased ranges, odometry with a scale error.
#pragma once

#include <array>
#include <cmath>
#include <cstdint>
#include <numbers>

#include "host/io/dataset.hpp"
#include "host/model/pose.hpp"
#include "host/model/range_model.hpp"

namespace groma::test {

// Standard normal, identical on every machine.
class SmallNoise {
 public:
  explicit SmallNoise(std::uint64_t seed) : state_(seed) {}
  double operator()() {
    const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
    return radius * std::cos(2.0 * std::numbers::pi * uniform());
  }

 private:
  double uniform() {
    state_ += 0x9e3779b97f4a7c15U;
    std::uint64_t z = state_;
    z = (z ^ (z >> 30U)) * 0xbf58476d1ce4e5b9U;
    z = (z ^ (z >> 27U)) * 0x94d049bb133111ebU;
    return static_cast<double>((z ^ (z >> 31U)) >> 11U) * 0x1p-53;
  }
  std::uint64_t state_;
};

inline double small_run_beta_m(model::NodeId tag, model::NodeId anchor) {
  return 0.3 + 0.15 * std::sin(3.0 * tag + 1.3 * anchor);
}

// The drive's first `duration_s` seconds; the seed determines the noise.
inline io::Dataset make_small_run(double duration_s, std::uint64_t seed) {
  io::Dataset run;
  run.name = "small";
  run.origin = "simulated";
  run.odometry_noise = {0.02, 0.02, 0.006};
  run.range_priors = {0.08, {0.2, 0.3}, {1.0, 0.005}};
  run.surface = model::Plane(0.25, {0.0, 0.0, 1.0});
  run.tags = {{1, {0.7, 0.4, 1.9}}, {2, {-0.7, -0.4, 0.5}}};
  run.surveyed_anchors = {{4, {-1.0, -2.0, 2.8}}, {5, {5.0, -5.0, 0.6}}, {6, {12.0, -3.0, 3.1}},
                          {7, {12.0, 4.0, 0.4}},  {8, {5.0, 5.5, 2.6}},  {9, {-1.5, 3.0, 0.9}}};
  SmallNoise noise(seed);
  const auto pose_at = [](double t_s) {
    // The path is x = 5 + 5 sin(w t), y = 2 sin(2 w t); the heading is tangential.
    constexpr double kW = 2.0 * std::numbers::pi / 40.0;
    const double dx = 5.0 * kW * std::cos(kW * t_s);
    const double dy = 4.0 * kW * std::cos(2.0 * kW * t_s);
    return model::PoseSample{t_s, 5.0 + 5.0 * std::sin(kW * t_s), 2.0 * std::sin(2.0 * kW * t_s), 0.25,
                             std::atan2(dy, dx)};
  };
  constexpr double kOdometry_s = 0.05;
  for (int i = 0; i * kOdometry_s < duration_s; ++i) {
    const double t_s = i * kOdometry_s;
    const model::PoseSample now = pose_at(t_s);
    const model::PoseSample next = pose_at(t_s + kOdometry_s);
    const double turn = model::wrap_angle(next.yaw_rad - now.yaw_rad);
    const double middle = now.yaw_rad + 0.5 * turn;
    const double dx = next.x_m - now.x_m;
    const double dy = next.y_m - now.y_m;
    run.odometry.push_back(
        {t_s, 1.005 * (std::cos(middle) * dx + std::sin(middle) * dy) / kOdometry_s + 0.02 * noise(),
         (std::cos(middle) * dy - std::sin(middle) * dx) / kOdometry_s + 0.02 * noise(),
         turn / kOdometry_s + 0.0005 + 0.006 * noise()});
    run.ground_truth.push_back(now);
    if (i % 2 == 0) {
      run.pose_prior.push_back(
          {t_s, now.x_m + 0.01 * noise(), now.y_m + 0.01 * noise(), now.z_m, now.yaw_rad + 0.002 * noise()});
    }
  }
  constexpr double kRange_s = 0.01;
  for (int i = 0; i * kRange_s < duration_s - kOdometry_s; ++i) {
    const double t_s = i * kRange_s;
    const model::PoseSample truth = pose_at(t_s);
    const model::Tag& tag = run.tags[static_cast<std::size_t>(i) % run.tags.size()];
    const model::Anchor& anchor =
        run.surveyed_anchors[static_cast<std::size_t>(i / 2) % run.surveyed_anchors.size()];
    const model::RigidPose pose{{truth.x_m, truth.y_m, truth.z_m},
                                model::rotation_from_zyx(truth.yaw_rad, 0.0, 0.0)};
    const double range_m =
        model::predict_range(pose, tag.lever_arm_m, anchor.position_m,
                             model::values_of({.beta_m = small_run_beta_m(tag.id, anchor.id)}))
            .range_m;
    run.ranges.push_back({t_s, tag.id, anchor.id, range_m + 0.08 * noise()});
  }
  return run;
}

}  // namespace groma::test
