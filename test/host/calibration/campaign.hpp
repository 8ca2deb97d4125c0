// Calibrates many simulated drives: errors relative to the Cramer-Rao bound and to the covariance.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include <Eigen/Cholesky>

#include "host/calibration/calibrate.hpp"
#include "test/host/calibration/site_simulation.hpp"

namespace groma::test {

// Cramer-Rao bounds of all anchors' positions where poses drift, for an estimator that knows the drift's
// statistics. The drift is linear between knots a second apart and common to all anchors.
inline std::vector<Eigen::Matrix3d> bounds_with_drift(const SimulatedSite& site) {
  constexpr double kStep_s = 1.0;
  const SiteSettings& settings = site.settings;
  const std::size_t tags = site.tags.size();
  const auto size = static_cast<Eigen::Index>(3 + 2 * tags);
  const auto knots = static_cast<Eigen::Index>(settings.duration_s / kStep_s) + 2;
  const double keep = std::exp(-kStep_s / settings.pose_correlation_s);
  Eigen::MatrixXd drift = Eigen::MatrixXd::Zero(3 * knots, 3 * knots);
  for (Eigen::Index axis = 0; axis < 3; ++axis) {
    const double sigma = axis < 2 ? settings.pose_sigma_m : settings.pose_yaw_sigma_rad;
    drift(axis, axis) += 1.0 / (sigma * sigma);
    // Each step acts as an observation: the error minus what is kept of the one before.
    const double information = 1.0 / (sigma * sigma * (1.0 - keep * keep));
    for (Eigen::Index k = axis; k + 3 < 3 * knots; k += 3) {
      drift(k + 3, k + 3) += information;
      drift(k, k) += keep * keep * information;
      drift(k, k + 3) -= keep * information;
      drift(k + 3, k) -= keep * information;
    }
  }
  std::vector<Eigen::MatrixXd> own;
  std::vector<Eigen::MatrixXd> gains;
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    Eigen::MatrixXd information = Eigen::MatrixXd::Zero(size, size);
    Eigen::MatrixXd cross = Eigen::MatrixXd::Zero(size, 3 * knots);
    for (std::size_t j = 0; j < tags; ++j) {
      const auto beta = static_cast<Eigen::Index>(3 + j);
      const auto gamma = static_cast<Eigen::Index>(3 + tags + j);
      information(beta, beta) = 1.0 / std::pow(settings.beta_sigma_m, 2);
      information(gamma, gamma) = 1.0 / std::pow(settings.gamma_sigma, 2);
    }
    for (const model::RangeSample& range : site.ranges) {
      if (range.anchor_id != site.anchors[a].id) continue;
      const std::size_t j = range.tag_id - site.tags.front().id;
      const model::PoseSample pose = true_pose(range.t_s, settings.route);
      const Eigen::Vector3d antenna_m = antenna_of(pose, site.tags[j]);
      const Eigen::Vector3d to_antenna_m = antenna_m - site.anchors[a].position_m;
      const Eigen::Vector3d by_antenna = site.gamma[a][j] * to_antenna_m / to_antenna_m.norm();
      Eigen::VectorXd row = Eigen::VectorXd::Zero(size);
      row.head<3>() = -by_antenna;
      row(static_cast<Eigen::Index>(3 + j)) = 1.0;
      row(static_cast<Eigen::Index>(3 + tags + j)) = to_antenna_m.norm();
      const Eigen::Vector3d by_error(
          by_antenna.x(), by_antenna.y(),
          by_antenna.y() * (antenna_m.x() - pose.x_m) - by_antenna.x() * (antenna_m.y() - pose.y_m));
      const auto knot = std::min(static_cast<Eigen::Index>(range.t_s / kStep_s), knots - 2);
      const double fraction = range.t_s / kStep_s - static_cast<double>(knot);
      Eigen::Matrix<double, 6, 1> by_knots;
      by_knots << (1.0 - fraction) * by_error, fraction * by_error;
      const double weight = 1.0 / std::pow(settings.sigma_m, 2);
      information += weight * row * row.transpose();
      cross.middleCols<6>(3 * knot) += weight * row * by_knots.transpose();
      drift.block<6, 6>(3 * knot, 3 * knot) += weight * by_knots * by_knots.transpose();
    }
    own.emplace_back(information.ldlt().solve(Eigen::MatrixXd::Identity(size, size)));
    gains.emplace_back(own.back() * cross);
    drift -= cross.transpose() * gains.back();
  }
  const Eigen::LLT<Eigen::MatrixXd> rest(drift);
  std::vector<Eigen::Matrix3d> out;
  for (std::size_t a = 0; a < own.size(); ++a) {
    const Eigen::MatrixXd gain = gains[a].topRows<3>();
    out.emplace_back(own[a].topLeftCorner<3, 3>() + gain * rest.solve(gain.transpose()));
  }
  return out;
}

// Gaussian maximum likelihood of one anchor's position, with the true noise and from the truth as the start:
// without outliers, no estimator does better except by luck.
inline Eigen::Vector3d oracle_position_m(const SimulatedSite& site, std::size_t a) {
  const SiteSettings& settings = site.settings;
  const std::size_t tags = site.tags.size();
  const auto size = static_cast<Eigen::Index>(3 + 2 * tags);
  Eigen::VectorXd anchor = Eigen::VectorXd::Zero(size);
  anchor.head<3>() = site.anchors[a].position_m;
  anchor.tail(static_cast<Eigen::Index>(tags)).setOnes();
  Eigen::VectorXd information_of_priors = Eigen::VectorXd::Zero(size);
  information_of_priors.segment(3, static_cast<Eigen::Index>(tags))
      .setConstant(1.0 / std::pow(settings.beta_sigma_m, 2));
  information_of_priors.tail(static_cast<Eigen::Index>(tags))
      .setConstant(1.0 / std::pow(settings.gamma_sigma, 2));
  const Eigen::VectorXd mean = anchor;
  for (int round = 0; round < 8; ++round) {
    Eigen::MatrixXd information = information_of_priors.asDiagonal();
    Eigen::VectorXd descent = information_of_priors.cwiseProduct(mean - anchor);
    for (const model::RangeSample& range : site.ranges) {
      if (range.anchor_id != site.anchors[a].id) continue;
      const std::size_t j = range.tag_id - site.tags.front().id;
      const auto beta = static_cast<Eigen::Index>(3 + j);
      const auto gamma = static_cast<Eigen::Index>(3 + tags + j);
      const Eigen::Vector3d from_tag_m =
          anchor.head<3>() - antenna_of(true_pose(range.t_s, settings.route), site.tags[j]);
      Eigen::VectorXd row = Eigen::VectorXd::Zero(size);
      row.head<3>() = anchor(gamma) * from_tag_m.normalized();
      row(beta) = 1.0;
      row(gamma) = from_tag_m.norm();
      information += row * row.transpose() / std::pow(settings.sigma_m, 2);
      descent += row * (range.range_m - anchor(gamma) * from_tag_m.norm() - anchor(beta)) /
                 std::pow(settings.sigma_m, 2);
    }
    anchor += information.ldlt().solve(descent);
  }
  return anchor.head<3>();
}

// Sums over sites and their anchors.
struct Campaign {
  double square_m2 = 0.0;
  double bound_m2 = 0.0;
  double oracle_m2 = 0.0;
  double nees_sum = 0.0;
  std::size_t anchors = 0;
  std::size_t inside = 0;  // the ellipsoid of 95 %
  std::size_t lies = 0;    // over 1 m and over 3 sigma off, marked ok

  [[nodiscard]] double rmse_over_bound() const { return std::sqrt(square_m2 / bound_m2); }
  [[nodiscard]] double rmse_over_oracle() const { return std::sqrt(square_m2 / oracle_m2); }
  // Of positions, divided by 3 as in the source paper.
  [[nodiscard]] double mean_nees() const { return nees_sum / (3.0 * static_cast<double>(anchors)); }
  [[nodiscard]] double inside_95() const {
    return static_cast<double>(inside) / static_cast<double>(anchors);
  }

  void record(const char* what) const {
    ::testing::Test::RecordProperty(std::string(what) + "_rmse_over_bound",
                                    std::to_string(rmse_over_bound()));
    if (oracle_m2 > 0.0) {
      ::testing::Test::RecordProperty(std::string(what) + "_rmse_over_oracle",
                                      std::to_string(rmse_over_oracle()));
    }
    ::testing::Test::RecordProperty(std::string(what) + "_mean_nees", std::to_string(mean_nees()));
    ::testing::Test::RecordProperty(std::string(what) + "_inside_95", std::to_string(inside_95()));
  }
};

// Calibrates the settings' site with each seed; computes the oracle if there are neither outliers nor pose
// drift.
inline void add_seeds(const SiteSettings& settings, std::uint64_t first, std::uint64_t last, Campaign& out) {
  const bool drifts = settings.pose_sigma_m > 0.0;
  const bool has_oracle = !drifts && settings.outlier_share == 0.0;
  std::vector<Eigen::Matrix3d> of_drift;  // nearly the same for each seed
  for (std::uint64_t seed = first; seed <= last; ++seed) {
    const SimulatedSite site = simulate_site(settings, seed);
    if (drifts && of_drift.empty()) of_drift = bounds_with_drift(site);
    const calibration::Result result = calibration::calibrate(site.drive());
    ASSERT_EQ(result.calibration.anchors.size(), site.anchors.size());
    for (std::size_t a = 0; a < site.anchors.size(); ++a) {
      const model::AnchorCalibration& found = result.calibration.anchors[a];
      ASSERT_EQ(found.id, site.anchors[a].id);
      const Eigen::Vector3d error_m = found.position_m - site.anchors[a].position_m;
      // Without pose drift all of the common frame's covariance is unobservable error, and these poses have
      // none.
      const Eigen::Matrix3d covariance =
          drifts ? Eigen::Matrix3d(found.covariance.topLeftCorner<3, 3>())
                 : Eigen::Matrix3d(model::own_covariance(found, result.calibration.common_frame_covariance)
                                       .topLeftCorner<3, 3>());
      const double nees = error_m.dot(covariance.ldlt().solve(error_m));
      out.square_m2 += error_m.squaredNorm();
      out.bound_m2 += drifts ? of_drift[a].trace() : cramer_rao_bound(site, a).topLeftCorner<3, 3>().trace();
      if (has_oracle) {
        out.oracle_m2 += (oracle_position_m(site, a) - site.anchors[a].position_m).squaredNorm();
      }
      out.nees_sum += nees;
      if (nees <= 7.815) ++out.inside;
      if (error_m.norm() > 1.0 && nees > 9.0 && found.verdict == model::AnchorVerdict::kOk) ++out.lies;
      ++out.anchors;
    }
  }
}

}  // namespace groma::test
