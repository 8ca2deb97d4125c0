#include "test/host/calibration/site_simulation.hpp"

namespace groma::test {

namespace {

constexpr double kLap_s = 80.0;

}  // namespace

std::vector<model::Anchor> table_one_anchors() {
  return {{4, {2.510, 1.830, 2.780}},   {5, {3.370, 12.900, 3.070}},   {6, {9.570, 2.300, 3.250}},
          {7, {16.000, 13.000, 3.080}}, {8, {16.600, 6.010, 0.462}},   {9, {16.600, 6.000, 2.060}},
          {10, {20.200, 6.030, 0.429}}, {11, {19.700, 6.430, 2.430}},  {12, {21.900, 6.200, 0.625}},
          {13, {21.300, 6.530, 2.670}}, {14, {21.700, 10.600, 2.940}}, {15, {21.100, 9.960, 0.605}}};
}

Eigen::Vector2d place_on(Route route, double t_s) {
  const double turn = 2.0 * std::numbers::pi * t_s;
  switch (route) {
    case Route::kWaves:
      return {11.0 + 7.5 * std::sin(turn / 97.0), 7.5 + 4.0 * std::sin(turn / 61.0 + 0.5)};
    case Route::kEight:
      return {11.0 + 8.0 * std::sin(turn / 120.0), 7.5 + 4.0 * std::sin(turn / 60.0)};
    case Route::kRectangle: {
      constexpr double kLength_m = 16.0;
      constexpr double kWidth_m = 8.0;
      double way_m = 2.0 * (kLength_m + kWidth_m) * (t_s / kLap_s - std::floor(t_s / kLap_s));
      if (way_m < kLength_m) return {3.0 + way_m, 3.5};
      way_m -= kLength_m;
      if (way_m < kWidth_m) return {3.0 + kLength_m, 3.5 + way_m};
      way_m -= kWidth_m;
      if (way_m < kLength_m) return {3.0 + kLength_m - way_m, 3.5 + kWidth_m};
      return {3.0, 3.5 + kWidth_m - (way_m - kLength_m)};
    }
    case Route::kEllipse:
      return {11.5 + 8.0 * std::cos(turn / kLap_s), 7.5 + 4.5 * std::sin(turn / kLap_s)};
  }
  return Eigen::Vector2d::Zero();
}

model::PoseSample true_pose(double t_s, Route route) {
  const Eigen::Vector2d place_m = place_on(route, t_s);
  const Eigen::Vector2d way_m = place_on(route, t_s + 0.3) - place_on(route, t_s - 0.3);
  model::PoseSample pose;
  pose.t_s = t_s;
  pose.x_m = place_m.x();
  pose.y_m = place_m.y();
  pose.yaw_rad = std::atan2(way_m.y(), way_m.x());
  return pose;
}

SimulatedSite simulate_site(const SiteSettings& settings, std::uint64_t seed) {
  Random random(seed);
  SimulatedSite site;
  site.settings = settings;
  site.anchors = table_one_anchors();
  site.tags = three_tags();

  const double pose_step_s = 0.05;
  const double keep = std::exp(-pose_step_s / settings.pose_correlation_s);
  const double frequency = 1.0 / settings.pose_correlation_s;
  Eigen::Vector3d error = random.gaussians(3);
  Eigen::Vector3d error_rate = Eigen::Vector3d::Zero();
  if (settings.pose_damping_ratio) error_rate = frequency * random.gaussians(3);
  for (double t_s = 0.0; t_s < settings.duration_s + 2.0 * pose_step_s; t_s += pose_step_s) {
    model::PoseSample pose = true_pose(t_s, settings.route);
    site.truth.push_back(pose);
    if (settings.pose_damping_ratio) {
      const double loss = 2.0 * *settings.pose_damping_ratio * frequency;
      error_rate += pose_step_s * (-loss * error_rate - frequency * frequency * error) +
                    frequency * std::sqrt(2.0 * loss * pose_step_s) * random.gaussians(3);
      error += pose_step_s * error_rate;
    } else {
      error = keep * error + std::sqrt(1.0 - keep * keep) * random.gaussians(3);
    }
    pose.x_m += settings.pose_sigma_m * error.x();
    pose.y_m += settings.pose_sigma_m * error.y();
    pose.yaw_rad = model::wrap_angle(pose.yaw_rad + settings.pose_yaw_sigma_rad * error.z());
    site.poses.push_back(pose);
  }

  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    site.beta_m.emplace_back();
    site.gamma.emplace_back();
    for (std::size_t j = 0; j < site.tags.size(); ++j) {
      site.beta_m.back().push_back(settings.beta_sigma_m * random.gaussian());
      site.gamma.back().push_back(1.0 + settings.gamma_sigma * random.gaussian());
    }
  }
  std::vector<model::Tag> true_tags = site.tags;
  for (model::Tag& tag : true_tags) {
    site.lever_arm_error_m.emplace_back(Eigen::Vector3d::Zero());
    site.pattern_m.emplace_back(model::PatternTerms::Zero());
    if (settings.lever_arm_sigma_m > 0.0) {
      site.lever_arm_error_m.back() = settings.lever_arm_sigma_m * random.gaussians(3);
    }
    if (settings.pattern_sigma_m > 0.0) {
      site.pattern_m.back() = settings.pattern_sigma_m * random.gaussians(model::kPatternTerms);
    }
    tag.lever_arm_m += site.lever_arm_error_m.back();
  }
  std::vector<PlaceError> place_errors;
  for (std::size_t a = 0; settings.place_error_m > 0.0 && a < site.anchors.size(); ++a) {
    place_errors.emplace_back(settings.place_error_m, random);
  }
  const std::size_t pairs = site.anchors.size() * site.tags.size();
  const double step_s = settings.duration_s / static_cast<double>(settings.ranges_per_pair * pairs);
  double t_s = settings.range_delay_s;
  for (std::size_t k = 0; k < settings.ranges_per_pair; ++k) {
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      for (std::size_t j = 0; j < site.tags.size(); ++j, t_s += step_s) {
        const model::PoseSample pose = true_pose(t_s - settings.range_delay_s, settings.route);
        const Eigen::Vector3d antenna_m = antenna_of(pose, true_tags[j]);
        const Eigen::Vector3d to_anchor_m = site.anchors[a].position_m - antenna_m;
        double range_m =
            site.gamma[a][j] * to_anchor_m.norm() + site.beta_m[a][j] + settings.sigma_m * random.gaussian();
        const Eigen::Vector3d in_body =
            Eigen::AngleAxisd(-pose.yaw_rad, Eigen::Vector3d::UnitZ()) * to_anchor_m.normalized();
        range_m += model::pattern_terms(in_body).dot(site.pattern_m[j]);
        if (!place_errors.empty()) range_m += place_errors[a].at(antenna_m.head<2>());
        if (random.uniform() < settings.outlier_share) {
          range_m += settings.excess_mean_m > 0.0 ? -settings.excess_mean_m * std::log(1.0 - random.uniform())
                                                  : random.uniform(0.5, 3.5);
        }
        site.ranges.push_back(
            {.t_s = t_s, .tag_id = site.tags[j].id, .anchor_id = site.anchors[a].id, .range_m = range_m});
      }
    }
  }
  return site;
}

Eigen::MatrixXd cramer_rao_bound(const SimulatedSite& site, std::size_t a) {
  const std::size_t tags = site.tags.size();
  const auto size = static_cast<Eigen::Index>(3 + 2 * tags);
  Eigen::MatrixXd information = Eigen::MatrixXd::Zero(size, size);
  for (std::size_t j = 0; j < tags; ++j) {
    const auto beta = static_cast<Eigen::Index>(3 + j);
    const auto gamma = static_cast<Eigen::Index>(3 + tags + j);
    information(beta, beta) += 1.0 / std::pow(site.settings.beta_sigma_m, 2);
    information(gamma, gamma) += 1.0 / std::pow(site.settings.gamma_sigma, 2);
    for (const model::RangeSample& range : site.ranges) {
      if (range.anchor_id != site.anchors[a].id || range.tag_id != site.tags[j].id) continue;
      const Eigen::Vector3d antenna_m =
          antenna_of(true_pose(range.t_s - site.settings.range_delay_s, site.settings.route), site.tags[j]);
      const Eigen::Vector3d to_anchor_m = site.anchors[a].position_m - antenna_m;
      Eigen::VectorXd row = Eigen::VectorXd::Zero(size);
      row.head<3>() = site.gamma[a][j] * to_anchor_m / to_anchor_m.norm();
      row(beta) = 1.0;
      row(gamma) = to_anchor_m.norm();
      information += row * row.transpose() / std::pow(site.settings.sigma_m, 2);
    }
  }
  return information.ldlt().solve(Eigen::MatrixXd::Identity(size, size));
}

}  // namespace groma::test
