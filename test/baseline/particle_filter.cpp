#include "test/baseline/particle_filter.hpp"

#include <cmath>

#include <Eigen/Eigenvalues>

#include "test/baseline/kalman.hpp"

namespace groma::baseline {

namespace {

constexpr double kOutlierWidth_m = 10.0;  // of the uniform error
constexpr double kPi = 3.14159265358979323846;

}  // namespace

ParticleFilter::ParticleFilter(const Drive& drive, const Parameters& parameters, std::uint64_t seed)
    : surface_(*drive.surface),
      random_(seed),
      particles_(static_cast<Eigen::Index>(parameters.particles)),
      sigmas_(variances_of(drive.odometry_noise, parameters.odometry_factor).cwiseSqrt()),
      variance_m2_(model::square(parameters.range_factor * drive.range_sigma_m)),
      outlier_share_(parameters.outlier_share),
      mean_(drive.start.pose) {
  Particles& p = particles_;
  for (Eigen::Index i = 0; i < p.x_m.size(); ++i) {
    p.x_m(i) = mean_.x_m + kStartSigma_m * random_.gaussian();
    p.y_m(i) = mean_.y_m + kStartSigma_m * random_.gaussian();
    p.theta_rad(i) = mean_.theta_rad + kStartSigma_rad * random_.gaussian();
    p.scale(i) = kScaleSigma * random_.gaussian();
    p.bias_radps(i) = kYawRateBiasSigma_radps * random_.gaussian();
  }
  p.log_weight.setZero();
  turn_all();
}

void ParticleFilter::turn_all() {
  particles_.cos = particles_.theta_rad.cos();
  particles_.sin = particles_.theta_rad.sin();
}

void ParticleFilter::hold(const Held& held) {
  held_ = held;
  Particles& p = particles_;
  for (Eigen::Index i = 0; i < p.x_m.size(); ++i) {
    p.vx_mps(i) = (1.0 + p.scale(i)) * held.sample.vx_mps + sigmas_.x() * random_.gaussian();
    p.vy_mps(i) = (1.0 + p.scale(i)) * held.sample.vy_mps + sigmas_.y() * random_.gaussian();
    p.omega_radps(i) = held.sample.omega_radps - p.bias_radps(i) + sigmas_.z() * random_.gaussian();
  }
}

void ParticleFilter::move(double dt_s) {
  Particles& p = particles_;
  const Eigen::Matrix2d flat =
      model::surface_rotation(surface_.at(mean_.x_m, mean_.y_m, mean_.chart).gradient).topLeftCorner<2, 2>();
  // Half a turn before and after: the midpoint rule; the angle is small.
  const Eigen::ArrayXd half = 0.5 * dt_s * p.omega_radps;
  const Eigen::ArrayXd c = p.cos - p.sin * half;
  const Eigen::ArrayXd s = p.sin + p.cos * half;
  const Eigen::ArrayXd dx = dt_s * (c * p.vx_mps - s * p.vy_mps);
  const Eigen::ArrayXd dy = dt_s * (s * p.vx_mps + c * p.vy_mps);
  p.x_m += flat(0, 0) * dx + flat(0, 1) * dy;
  p.y_m += flat(1, 0) * dx + flat(1, 1) * dy;
  p.theta_rad += 2.0 * half;
  turn_all();
}

bool ParticleFilter::measure(const Range& range) {
  Particles& p = particles_;
  const Pair& pair = *range.pair;
  const model::SurfacePoint ground = surface_.at(mean_.x_m, mean_.y_m, mean_.chart);
  const Eigen::Matrix3d tilt = model::surface_rotation(ground.gradient);
  const double variance_m2 =
      variance_m2_ +
      predict(RangeModel::kBiased, surface_, mean_, pair, pair.anchor_m).calibration_variance_m2;
  const Eigen::ArrayXd arm_x = p.cos * pair.lever_arm_m.x() - p.sin * pair.lever_arm_m.y();
  const Eigen::ArrayXd arm_y = p.sin * pair.lever_arm_m.x() + p.cos * pair.lever_arm_m.y();
  const double arm_z = pair.lever_arm_m.z();
  const Eigen::ArrayXd height =
      ground.z_m + ground.gradient.x() * (p.x_m - mean_.x_m) + ground.gradient.y() * (p.y_m - mean_.y_m);
  const auto across = [&](Eigen::Index row) {
    return tilt(row, 0) * arm_x + tilt(row, 1) * arm_y + tilt(row, 2) * arm_z - pair.anchor_m(row);
  };
  const Eigen::ArrayXd distance =
      ((p.x_m + across(0)).square() + (p.y_m + across(1)).square() + (height + across(2)).square()).sqrt();
  const Eigen::ArrayXd residual =
      range.range_m - model::scale_of(pair.terms) * distance - model::offset_m(pair.terms);
  const Eigen::ArrayXd exponent = -0.5 * residual.square() / variance_m2;
  if (outlier_share_ > 0.0) {
    const double peak = (1.0 - outlier_share_) / std::sqrt(2.0 * kPi * variance_m2);
    p.log_weight += (peak * exponent.exp() + outlier_share_ / kOutlierWidth_m).log();
  } else {
    p.log_weight += exponent;
  }
  resample();
  return true;
}

Eigen::ArrayXd ParticleFilter::weights() {
  Particles& p = particles_;
  p.log_weight -= p.log_weight.maxCoeff();
  Eigen::ArrayXd weights = p.log_weight.exp();
  return weights / weights.sum();
}

ParticleFilter::Moments ParticleFilter::moments(const Eigen::ArrayXd& weights) const {
  const Particles& p = particles_;
  Moments out;
  const double theta_rad = std::atan2((weights * p.sin).sum(), (weights * p.cos).sum());
  out.mean << (weights * p.x_m).sum(), (weights * p.y_m).sum(), theta_rad, (weights * p.scale).sum(),
      (weights * p.bias_radps).sum();
  Eigen::Array<double, Eigen::Dynamic, kStates> errors(p.x_m.size(), kStates);
  // Of small angles, the sine.
  errors << p.x_m - out.mean(0), p.y_m - out.mean(1),
      p.sin * std::cos(theta_rad) - p.cos * std::sin(theta_rad), p.scale - out.mean(3),
      p.bias_radps - out.mean(4);
  out.covariance = errors.matrix().transpose() * (errors.colwise() * weights).matrix();
  return out;
}

model::PlanarEstimate ParticleFilter::estimate(double t_s) {
  const Moments now = moments(weights());
  mean_ = {now.mean(0), now.mean(1), now.mean(2), surface_.follow(mean_.chart, now.mean(0), now.mean(1))};
  return {t_s, mean_.x_m, mean_.y_m, mean_.theta_rad, now.covariance.topLeftCorner<3, 3>()};
}

void ParticleFilter::resample() {
  Particles& p = particles_;
  const Eigen::ArrayXd weights = this->weights();
  const Eigen::Index count = weights.size();
  if (1.0 / weights.square().sum() >= 0.5 * static_cast<double>(count)) return;
  const Moments before = moments(weights);
  std::vector<Eigen::Index> kept(static_cast<std::size_t>(count));
  const double offset = random_.uniform();
  double sum = 0.0;
  Eigen::Index from = 0;
  for (Eigen::Index i = 0; i < count; ++i) {
    const double share = (static_cast<double>(i) + offset) / static_cast<double>(count);
    while (from + 1 < count && sum + weights(from) < share) sum += weights(from++);
    kept[static_cast<std::size_t>(i)] = from;
  }
  for (Eigen::ArrayXd* values :
       {&p.x_m, &p.y_m, &p.theta_rad, &p.scale, &p.bias_radps, &p.vx_mps, &p.vy_mps, &p.omega_radps})
    *values = Eigen::ArrayXd((*values)(kept));
  p.log_weight.setZero();

  // Each particle becomes a draw from a Gaussian around it, shrunk towards the mean: mean and covariance
  // stay.
  const double width = std::pow(4.0 / (kStates + 2.0), 1.0 / (kStates + 4.0)) *
                       std::pow(static_cast<double>(count), -1.0 / (kStates + 4.0));
  const double shrink = std::sqrt(1.0 - width * width);
  const Eigen::SelfAdjointEigenSolver<Covariance> axes(before.covariance);
  const Covariance root =
      width * axes.eigenvectors() * axes.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
  for (Eigen::Index i = 0; i < count; ++i) {
    Vector draw;
    for (double& value : draw) value = random_.gaussian();
    Vector error(p.x_m(i), p.y_m(i), p.theta_rad(i), p.scale(i), p.bias_radps(i));
    error -= before.mean;
    error(2) = model::wrap_angle(error(2));
    const Vector moved = before.mean + shrink * error + root * draw;
    p.x_m(i) = moved(0);
    p.y_m(i) = moved(1);
    p.theta_rad(i) = moved(2);
    p.scale(i) = moved(3);
    p.bias_radps(i) = moved(4);
  }
  turn_all();
}

}  // namespace groma::baseline
