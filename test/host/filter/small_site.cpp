#include "test/host/filter/small_site.hpp"

namespace groma::filter::testing {

model::Surface hills(double height_m) {
  const model::BSpline::Grid grid{.x0_m = -20.0, .y0_m = -20.0, .dx_m = 4.0, .dy_m = 4.0, .nx = 13, .ny = 13};
  Random random(77);
  std::vector<double> heights(169);
  for (double& height : heights) height = height_m * random.gaussian();
  return model::BSpline(grid, heights);
}

model::Calibration calibration_of(const std::vector<model::Anchor>& anchors, double scale) {
  model::Calibration calibration = model::surveyed_calibration(
      anchors, three_tags(), {.sigma_m = 0.1, .beta_m = {0.2, 0.05}, .gamma = {1.0, 0.002}}, 0.1);
  Random random(78);
  for (model::AnchorCalibration& anchor : calibration.anchors) {
    const Eigen::Index size = anchor.covariance.rows();
    Eigen::MatrixXd mix = Eigen::MatrixXd::Identity(size, size);
    for (Eigen::Index i = 0; i < size; ++i) mix.row(i) += 0.5 * random.gaussians(size).transpose();
    const Eigen::VectorXd sigmas = scale * anchor.covariance.diagonal().cwiseSqrt();
    const Eigen::MatrixXd root = sigmas.asDiagonal() * mix / 1.5;
    anchor.covariance = root * root.transpose();
    for (model::PairBias& pair : anchor.pairs) pair.beta_m += 0.2 * random.gaussian();
  }
  calibration.common_frame_covariance.diagonal() << 4e-4, 4e-4, 1e-4, 1e-6;
  calibration.common_frame_covariance *= scale * scale;
  for (model::AnchorCalibration& anchor : calibration.anchors)
    model::add_common_frame(anchor, calibration.common_frame_covariance);
  return calibration;
}

model::Calibration six_anchors(double scale) {
  return calibration_of({{11, {-12.0, -11.0, 2.5}},
                         {12, {13.0, -9.0, 3.0}},
                         {13, {12.0, 12.0, 0.6}},
                         {14, {-11.0, 13.0, 2.8}},
                         {15, {1.0, -14.0, 1.5}},
                         {16, {0.5, 15.0, 3.2}}},
                        scale);
}

model::PlanarPose integrate(const model::Surface& surface, const model::PlanarPose& from,
                            const Eigen::Vector3d& velocity, double dt_s, int steps) {
  const auto rate = [&](const Eigen::Vector3d& at) {
    const model::SurfacePose pose = model::pose_on_surface(surface, {at.x(), at.y(), at.z()});
    const Eigen::Vector3d moved = pose.pose.rotation * Eigen::Vector3d(velocity.x(), velocity.y(), 0.0);
    return Eigen::Vector3d(moved.x(), moved.y(), velocity.z());
  };
  Eigen::Vector3d at(from.x_m, from.y_m, from.theta_rad);
  const double h = dt_s / steps;
  for (int i = 0; i < steps; ++i) {
    const Eigen::Vector3d k1 = rate(at);
    const Eigen::Vector3d k2 = rate(at + 0.5 * h * k1);
    const Eigen::Vector3d k3 = rate(at + 0.5 * h * k2);
    const Eigen::Vector3d k4 = rate(at + h * k3);
    at += h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4);
  }
  return {at.x(), at.y(), at.z()};
}

Drive drive(const model::Surface& surface, const model::Calibration& calibration,
            const model::PlanarPose& start, const DriveOptions& options, Random& random) {
  const double scale = options.scale_sigma * random.gaussian();
  const double bias = options.yaw_rate_bias_sigma_radps * random.gaussian();
  const double delay = options.range_delay_sigma_s * random.gaussian();
  const Eigen::VectorXd frame = random.gaussians(calibration.common_frame_covariance);
  std::vector<model::Tag> tags = three_tags();
  for (model::Tag& tag : tags) tag.lever_arm_m += options.lever_arm_sigma_m * random.gaussians(3);
  std::vector<Eigen::VectorXd> sites;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    Eigen::VectorXd site =
        random.gaussians(model::own_covariance(anchor, calibration.common_frame_covariance));
    site += model::values_of(anchor);
    const Eigen::Vector3d turned(-site(1), site(0), 0.0);
    site.head<3>() += frame.head<3>() + frame(3) * turned;
    sites.push_back(site);
  }

  // Gauss-Markov range bias of each anchor, with transitions by the way from range to range.
  const model::RangeNoise noise =
      calibration.range_noise.value_or(model::RangeNoise{options.range_sigma_m, 0.0, 1.0});
  std::vector<double> slow_m;
  for (std::size_t i = 0; i < sites.size(); ++i) {
    slow_m.push_back(noise.bias_sigma_m > 0.0 ? noise.bias_sigma_m * random.gaussian() : 0.0);
  }
  Drive out;
  model::PlanarPose at = start;
  double next_range_s = options.range_s > 0.0 ? 0.5 * options.range_s : options.duration_s + 1.0;
  std::size_t turn = 0;
  const int rows = static_cast<int>(std::lround(options.duration_s / options.row_s));
  for (int i = 0; i < rows; ++i) {
    const double t_s = i * options.row_s;
    const Eigen::Vector3d velocity = true_velocity(t_s);
    out.odometry.push_back({t_s,
                            (velocity.x() + options.noise.sigma_vx_mps * random.gaussian()) / (1.0 + scale),
                            (velocity.y() + options.noise.sigma_vy_mps * random.gaussian()) / (1.0 + scale),
                            velocity.z() + bias + options.noise.sigma_omega_radps * random.gaussian()});
    out.truth.push_back(at);
    for (; next_range_s < t_s + options.row_s; next_range_s += options.range_s) {
      if (noise.bias_sigma_m > 0.0) {
        const double fade = std::exp(-velocity.head<2>().norm() * options.range_s / noise.bias_length_m);
        for (double& error_m : slow_m) {
          error_m = fade * error_m + std::sqrt(1.0 - fade * fade) * noise.bias_sigma_m * random.gaussian();
        }
      }
      const std::size_t anchor = turn % sites.size();
      const std::size_t tag = turn / sites.size() % tags.size();
      ++turn;
      // Range timestamps are late by the delay.
      const model::PlanarPose when = integrate(surface, at, velocity, next_range_s - delay - t_s, 2);
      const Eigen::VectorXd& site = sites[anchor];
      const auto prediction =
          model::predict_range(model::pose_on_surface(surface, when).pose, tags[tag].lever_arm_m,
                               site.head<3>(), model::terms_of(site, static_cast<Eigen::Index>(tag), 3));
      out.ranges.push_back({next_range_s, tags[tag].id, calibration.anchors[anchor].id,
                            prediction.range_m + slow_m[anchor] + noise.white_sigma_m * random.gaussian()});
    }
    at = integrate(surface, at, velocity, options.row_s, 10);
  }
  return out;
}

Eigen::MatrixXd prior_covariance(const Site& site, const Parameters& parameters,
                                 const model::Calibration& calibration) {
  Eigen::MatrixXd covariance = Eigen::MatrixXd::Zero(parameters.size(), parameters.size());
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    const int slot = site.anchor_index(anchor.id);
    if (slot < 0) continue;
    std::vector<int> at{parameters.position(slot), parameters.position(slot) + 1,
                        parameters.position(slot) + 2};
    for (std::size_t term = 0; term < model::kPairTerms.size(); ++term) {
      for (const model::PairBias& pair : anchor.pairs)
        at.push_back(parameters.pair_indices(slot, site.tag_slot(pair.tag_id))[3 + term]);
    }
    covariance(at, at) = model::own_covariance(anchor, calibration.common_frame_covariance);
    if (!calibration.range_noise) continue;
    covariance(parameters.range_bias(slot), parameters.range_bias(slot)) =
        std::pow(calibration.range_noise->bias_sigma_m, 2);
  }
  for (int tag = 0; tag < parameters.tag_count(); ++tag)
    covariance.diagonal().segment<3>(parameters.lever_arm(tag)).setConstant(site.lever_arm_variance_m2);
  covariance.block<4, 4>(parameters.frame(), parameters.frame()) = calibration.common_frame_covariance;
  return covariance;
}

Eigen::MatrixXd whole(const Filter& filter) {
  const Eigen::MatrixXd cross = filter.covariance().cross();
  Eigen::MatrixXd p(kCoreSize + cross.rows(), kCoreSize + cross.rows());
  p << filter.covariance().core(), cross.transpose(), cross,
      filter.covariance().parameters(filter.site(), filter.parameters());
  return p;
}

Estimate predict(const Filter& filter, std::span<const MotionInput> ahead) {
  Filter::Prediction then = filter.prediction();
  for (const MotionInput& input : ahead) filter.carry(then, input);
  return filter.estimate(then);
}

double squared_error(const Estimate& estimate, const model::PlanarPose& truth) {
  const Eigen::Vector3d e(estimate.pose.x_m - truth.x_m, estimate.pose.y_m - truth.y_m,
                          model::wrap_angle(estimate.pose.theta_rad - truth.theta_rad));
  return e.dot(estimate.covariance.inverse() * e);
}

}  // namespace groma::filter::testing
