#include "host/model/geographic.hpp"

#include <cmath>
#include <numbers>

#include "host/model/types.hpp"

namespace groma::model {

namespace {

constexpr double kA_m = 6378137.0;
constexpr double kFlattening = 1.0 / 298.257223563;
constexpr double kE2 = kFlattening * (2.0 - kFlattening);
constexpr double kDegree = std::numbers::pi / 180.0;

Eigen::Vector3d ecef(const Datum& place) noexcept {
  const double latitude_rad = place.latitude_deg * kDegree;
  const double longitude_rad = place.longitude_deg * kDegree;
  const double n_m = kA_m / std::sqrt(1.0 - kE2 * square(std::sin(latitude_rad)));
  const double height_m = place.height_m;
  return {(n_m + height_m) * std::cos(latitude_rad) * std::cos(longitude_rad),
          (n_m + height_m) * std::cos(latitude_rad) * std::sin(longitude_rad),
          (n_m * (1.0 - kE2) + height_m) * std::sin(latitude_rad)};
}

// Of east, north, up.
Eigen::Matrix3d to_ecef(const Datum& datum) noexcept {
  const double latitude_rad = datum.latitude_deg * kDegree;
  const double longitude_rad = datum.longitude_deg * kDegree;
  Eigen::Matrix3d out;
  out << -std::sin(longitude_rad), -std::sin(latitude_rad) * std::cos(longitude_rad),
      std::cos(latitude_rad) * std::cos(longitude_rad),  //
      std::cos(longitude_rad), -std::sin(latitude_rad) * std::sin(longitude_rad),
      std::cos(latitude_rad) * std::sin(longitude_rad),  //
      0.0, std::cos(latitude_rad), std::sin(latitude_rad);
  return out;
}

}  // namespace

bool is_on_earth(const Datum& place) noexcept {
  return std::abs(place.latitude_deg) <= 90.0 && std::abs(place.longitude_deg) <= 180.0;
}

Eigen::Vector3d geographic(const Eigen::Vector3d& place_m, const Datum& datum) noexcept {
  const Eigen::Vector3d at = ecef(datum) + to_ecef(datum) * place_m;
  // Latitude by iteration; it converges by a factor of 1/300 a step.
  const double radius_m = at.head<2>().norm();
  double found_rad = std::atan2(at.z(), radius_m * (1.0 - kE2));
  double height_m = 0.0;
  constexpr int kSteps = 10;
  for (int i = 0; i < kSteps; ++i) {
    const double n_m = kA_m / std::sqrt(1.0 - kE2 * square(std::sin(found_rad)));
    height_m = radius_m * std::cos(found_rad) + at.z() * std::sin(found_rad) -
               n_m * (1.0 - kE2 * square(std::sin(found_rad)));
    found_rad = std::atan2(at.z() + kE2 * n_m * std::sin(found_rad), radius_m);
  }
  return {std::atan2(at.y(), at.x()) / kDegree, found_rad / kDegree, height_m};
}

Eigen::Vector3d place_in_map(const Datum& place, const Datum& datum) noexcept {
  return to_ecef(datum).transpose() * (ecef(place) - ecef(datum));
}

}  // namespace groma::model
