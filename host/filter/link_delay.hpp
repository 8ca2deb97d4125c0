// Ranges and odometry each come late by a time of their own. What the two see of the motion tells the
// difference alone; what is known beforehand of each parts it.
#pragma once

namespace groma::filter {

// Independent priors: of the ranges' delay a mean and sigma, of the odometry's a sigma about zero, s.
struct LinkDelays {
  double range_s = 0.0;
  double range_sigma_s = 0.0;
  double odometry_sigma_s = 0.0;

  // Variance of the difference, ranges' less odometry's, whose mean is range_s.
  [[nodiscard]] double difference_variance_s2() const noexcept;
  // How much of a surprise in the difference is the odometry's, 0 .. 1: by that share its delay is shorter
  // where the difference is larger.
  [[nodiscard]] double odometry_share() const noexcept;
  // The odometry's delay by a difference, and its variance were that difference known.
  [[nodiscard]] double odometry_s(double difference_s) const noexcept;
  [[nodiscard]] double odometry_variance_s2() const noexcept;
};

}  // namespace groma::filter
