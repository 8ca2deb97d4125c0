// Calibrates three anchors from ranges and poses that are in memory; the world here is simulated.
#include <cmath>
#include <iostream>
#include <random>
#include <vector>

#include <Eigen/Geometry>
#include <groma/calibration/calibrate.hpp>

int main() {
  namespace model = groma::model;
  namespace calibration = groma::calibration;
  const std::vector<model::Tag> tags{{1, {0.4, 0.0, 0.5}}, {2, {-0.3, 0.2, 1.5}}};  // base_link, m
  const std::vector<model::Anchor> truth{{11, {9, 2, 4}}, {12, {-6, 8, 5}}, {13, {0, -9, 2}}};  // map, m

  // 200 s on a figure eight. Each 0.1 s: a pose, and a range of one tag to one anchor (beta 0.3 m, sigma 0.05
  // m).
  std::mt19937 random(1);
  std::normal_distribution<double> noise(0.3, 0.05);
  std::vector<model::PoseSample> poses;
  std::vector<model::RangeSample> ranges;
  for (std::size_t k = 0; k < 2000; ++k) {
    const double t_s = 0.1 * static_cast<double>(k);
    const double phase = 0.1 * t_s;
    const double yaw_rad = std::atan2(10.0 * std::cos(2.0 * phase), 5.0 * std::cos(phase));
    poses.push_back(
        {.t_s = t_s, .x_m = 5.0 * std::sin(phase), .y_m = 5.0 * std::sin(2.0 * phase), .yaw_rad = yaw_rad});
    const model::Tag& tag = tags[k % 2];
    const model::Anchor& anchor = truth[k % 3];
    const Eigen::Vector3d antenna_m = Eigen::Vector3d(poses.back().x_m, poses.back().y_m, 0) +
                                      Eigen::AngleAxisd(yaw_rad, Eigen::Vector3d::UnitZ()) * tag.lever_arm_m;
    const double range_m = (anchor.position_m - antenna_m).norm() + noise(random);
    ranges.push_back({.t_s = t_s, .tag_id = tag.id, .anchor_id = anchor.id, .range_m = range_m});
  }

  const model::Surface ground;  // the plane z = 0
  const calibration::Result result = calibration::calibrate({.ranges = ranges,
                                                             .poses = poses,
                                                             .tags = tags,
                                                             .surface = &ground,
                                                             .priors = {0.05, {0.0, 0.5}, {1.0, 0.005}}});
  bool all_found = true;
  for (const model::AnchorCalibration& anchor : result.calibration.anchors) {
    const Eigen::Vector3d sigma_m = anchor.covariance.diagonal().head<3>().cwiseSqrt();
    const Eigen::Vector3d error_m = anchor.position_m - truth[anchor.id - 11U].position_m;
    std::cout << "anchor " << anchor.id << ": position " << anchor.position_m.transpose() << " m, sigma "
              << sigma_m.transpose() << " m, error " << error_m.norm() << " m\n";
    all_found = all_found && model::is_usable(anchor.verdict);
  }
  return all_found ? 0 : 1;
}
