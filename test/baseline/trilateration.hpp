// Loosely coupled localization: a pose fix from the ranges of each short window, fused with odometry.
#pragma once

#include <vector>

#include "test/baseline/kalman.hpp"

namespace groma::baseline {

// Each window of window_s gives a fix by robust least squares (Cauchy's kernel) over x, y and, with several
// tags, theta, the ranges' motion within the window compensated by odometry. An extended Kalman filter with
// the odometry's scale and yaw-rate bias takes the fixes with the covariances of the least squares.
class Trilateration final : public PoseFilter<5> {
 public:
  Trilateration(const Drive& drive, const Parameters& parameters);
  void move(double dt_s) override;
  bool measure(const Range& range) override;
  model::PlanarEstimate estimate(double t_s) override;

 private:
  struct Sighting {
    Range range;
    Eigen::Vector3d moved;  // since the window's begin, in its frame: x, y, theta
  };
  struct Fix {
    Eigen::Vector3d pose;  // at the window's begin
    Eigen::Matrix3d covariance;
    bool has_heading = false;
  };

  void begin_window();
  [[nodiscard]] bool solve(Fix& fix) const;
  void fuse(const Fix& fix);

  double variance_m2_;
  double kernel_;
  double gate_;
  double window_s_;
  double passed_s_ = 0.0;
  model::PlanarPose begin_;
  Eigen::Vector3d moved_ = Eigen::Vector3d::Zero();
  std::vector<Sighting> sightings_;
};

}  // namespace groma::baseline
