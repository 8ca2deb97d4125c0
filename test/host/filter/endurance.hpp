// Endurance test: a given number of updates in all operating conditions. Stationary and driving phases,
// nearly noise-free ranges, starts at wrong poses until divergence is suspected, silence, and exchanges of
// anchors.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <memory>
#include <numbers>

#include <Eigen/Eigenvalues>

#include "host/filter/filter.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter::testing {

// Expects the joint covariance to be exactly symmetric. Returns the smallest eigenvalue of the correlation
// matrix, which does not depend on units.
inline double smallest_eigenvalue(const Filter& filter) {
  const Eigen::MatrixXd p = whole(filter);
  EXPECT_EQ((p - p.transpose()).cwiseAbs().maxCoeff(), 0.0);
  EXPECT_GE(p.diagonal().minCoeff(), 0.0);
  const Eigen::VectorXd sigma = p.diagonal().cwiseSqrt();
  const Eigen::VectorXd scale = (sigma.array() > 0.0).select(sigma.cwiseInverse(), 0.0);
  const Eigen::MatrixXd correlation = scale.asDiagonal() * p * scale.asDiagonal();
  return Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd>(correlation, Eigen::EigenvaluesOnly)
      .eigenvalues()
      .minCoeff();
}

// Returns the minimum of smallest_eigenvalue() over the run.
inline double endure(Model model, std::size_t updates, double white_sigma_m, std::uint64_t seed) {
  constexpr int kAnchors = 12;
  constexpr int kActive = 8;
  std::vector<model::Anchor> ring;
  ring.reserve(kAnchors);
  for (int i = 0; i < kAnchors; ++i) {
    const double angle = 2.0 * std::numbers::pi * i / kAnchors;
    ring.push_back({static_cast<model::NodeId>(10 + i),
                    {12.0 * std::cos(angle), 12.0 * std::sin(angle), 1.0 + 0.5 * (i % 4)}});
  }
  model::Calibration calibration =
      model::surveyed_calibration(ring, three_tags(), {.beta_m = {0.0, 0.05}, .gamma = {1.0, 0.002}}, 0.1);
  calibration.common_frame_covariance.diagonal() << 4e-4, 4e-4, 1e-4, 1e-6;
  for (model::AnchorCalibration& anchor : calibration.anchors)
    model::add_common_frame(anchor, calibration.common_frame_covariance);
  calibration.range_noise = {.white_sigma_m = white_sigma_m, .bias_sigma_m = 0.02, .bias_length_m = 5.0};
  calibration.range_delay_sigma_s = 1e-3;
  Config config;
  config.model = model;
  config.active_anchors = kActive;
  const auto filter = std::make_unique<Filter>(model::Surface(), three_tags(), calibration, config);

  test::Random random(seed);
  model::PlanarPose at{};
  double t_s = 0.0;
  double least = 1.0;
  const std::size_t check_every = std::max<std::size_t>(updates / 50, 1);
  std::size_t given = 0;
  for (std::size_t phase = 0; given < updates; ++phase) {
    // In each phase the robot is stationary or drives, receives some of the anchors, and may start at a wrong
    // pose or after a silence.
    const bool stands = phase % 2 == 0;
    const Eigen::Vector3d velocity = stands ? Eigen::Vector3d::Zero() : Eigen::Vector3d(0.8, 0.1, 0.4);
    const int first = phase % 3 == 0 ? 0 : 4;
    const double step_s = phase % 5 == 0 ? 1e-5 : 5e-3;
    if (phase % 7 == 3) t_s += 20.0;
    if (phase % 11 == 0) {
      const double off_m = phase % 22 == 0 ? 0.0 : 3.0;
      filter->start({.t_s = t_s, .pose = {at.x_m + off_m, at.y_m, at.theta_rad}, .position_sigma_m = 0.05});
    }
    const std::size_t length = 2000 + 4000 * (phase % 4);
    for (std::size_t i = 0; i < length && given < updates; ++i, ++given) {
      t_s += step_s;
      at = integrate(model::Surface(), at, velocity, step_s, 1);
      if (i % 10 == 0) filter->process(model::OdometrySample{t_s, velocity.x(), velocity.y(), velocity.z()});
      const int anchor = (first + static_cast<int>(i % kActive)) % kAnchors;
      const model::Tag tag = three_tags()[i / kActive % 3];
      const model::SurfacePose pose = model::pose_on_surface(model::Surface(), at);
      const double range_m =
          model::predict_range(pose.pose, tag.lever_arm_m, ring[static_cast<std::size_t>(anchor)].position_m,
                               model::values_of(model::PairBias{}))
              .range_m;
      filter->process({.t_s = t_s,
                       .tag_id = tag.id,
                       .anchor_id = ring[static_cast<std::size_t>(anchor)].id,
                       .range_m = range_m + white_sigma_m * random.gaussian()});
      if (given % check_every != 0) continue;
      least = std::min(least, smallest_eigenvalue(*filter));
      EXPECT_TRUE(filter->core().allFinite());
    }
  }
  const Counters& counters = filter->counters();
  EXPECT_GT(counters.ranges[RangeOutcome::kUsed], updates / 4);
  EXPECT_GT(counters.anchor_exchanges, 4U);
  EXPECT_GT(counters.divergences, 0U);
  return std::min(least, smallest_eigenvalue(*filter));
}

}  // namespace groma::filter::testing
