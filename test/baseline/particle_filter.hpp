// A particle filter over pose, odometry scale and yaw-rate bias, with the adapted range model.
#pragma once

#include <cstdint>
#include <vector>

#include <Eigen/Core>

#include "test/baseline/method.hpp"

namespace groma::baseline {

// Each particle draws the errors of each odometry sample, which hold over the sample's interval. The ground
// is its tangent plane at the mean. Systematic resampling below half of the effective particles, each time
// with the kernel of Liu and West (2001), which keeps mean and covariance: without it a start of 0.1 m
// collapses to a few particles.
class ParticleFilter final : public Method {
 public:
  ParticleFilter(const Drive& drive, const Parameters& parameters, std::uint64_t seed);
  void hold(const Held& held) override;
  void move(double dt_s) override;
  bool measure(const Range& range) override;
  model::PlanarEstimate estimate(double t_s) override;

 private:
  struct Particles {
    explicit Particles(Eigen::Index count)
        : x_m(count),
          y_m(count),
          theta_rad(count),
          cos(count),
          sin(count),
          scale(count),
          bias_radps(count),
          vx_mps(count),
          vy_mps(count),
          omega_radps(count),
          log_weight(count) {}
    Eigen::ArrayXd x_m, y_m, theta_rad, cos, sin, scale, bias_radps;
    Eigen::ArrayXd vx_mps, vy_mps, omega_radps;  // of the held sample, with the particle's errors
    Eigen::ArrayXd log_weight;
  };

  static constexpr int kStates = 5;  // x, y, theta, scale, bias
  using Vector = Eigen::Vector<double, kStates>;
  using Covariance = Eigen::Matrix<double, kStates, kStates>;
  struct Moments {
    Vector mean;
    Covariance covariance;
  };

  void turn_all();
  [[nodiscard]] Eigen::ArrayXd weights();  // their sum is 1
  [[nodiscard]] Moments moments(const Eigen::ArrayXd& weights) const;
  void resample();

  const model::Surface& surface_;  // NOLINT(*-avoid-const-or-ref-data-members)
  Random random_;
  Particles particles_;
  Eigen::Vector3d sigmas_;
  double variance_m2_;
  double outlier_share_;
  model::PlanarPose mean_;  // at the last odometry sample
};

}  // namespace groma::baseline
