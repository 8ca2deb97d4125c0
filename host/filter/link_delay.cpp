#include "host/filter/link_delay.hpp"

namespace groma::filter {

double LinkDelays::difference_variance_s2() const noexcept {
  return range_sigma_s * range_sigma_s + odometry_sigma_s * odometry_sigma_s;
}

double LinkDelays::odometry_share() const noexcept {
  const double variance_s2 = difference_variance_s2();
  return variance_s2 > 0.0 ? odometry_sigma_s * odometry_sigma_s / variance_s2 : 0.0;
}

double LinkDelays::odometry_s(double difference_s) const noexcept {
  return odometry_share() * (range_s - difference_s);
}

double LinkDelays::odometry_variance_s2() const noexcept {
  return odometry_share() * range_sigma_s * range_sigma_s;
}

}  // namespace groma::filter
