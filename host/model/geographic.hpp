// Places on the Earth (WGS84) and in the map, whose x axis points east and y north at its origin.
#pragma once

#include <Eigen/Core>

namespace groma::model {

// The map's origin.
struct Datum {
  double latitude_deg = 0.0;
  double longitude_deg = 0.0;
  double height_m = 0.0;  // above the ellipsoid
};

// Whether its latitude and longitude exist.
[[nodiscard]] bool is_on_earth(const Datum& place) noexcept;

// Longitude and latitude (deg) and height (m) of a place in the map.
[[nodiscard]] Eigen::Vector3d geographic(const Eigen::Vector3d& place_m, const Datum& datum) noexcept;
// The reverse.
[[nodiscard]] Eigen::Vector3d place_in_map(const Datum& place, const Datum& datum) noexcept;

}  // namespace groma::model
