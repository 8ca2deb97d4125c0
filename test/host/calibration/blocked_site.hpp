// A simulated site with walls and moving obstacles: replies get lost, and NLOS ranges are too long.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include <Eigen/Core>

#include "test/host/calibration/site_simulation.hpp"

namespace groma::test {

struct PlanWall {
  Eigen::Vector2d from_m;
  Eigen::Vector2d to_m;
};

// How the powers of ranges depend on NLOS.
enum class Powers {
  kNone,      // ranges carry none
  kTrue,      // weaker in NLOS
  kOpposite,  // weaker in LOS
  kNothing,   // weaker at times, independent of NLOS
};

struct Blocking {
  std::vector<PlanWall> walls;  // as high as the hall
  double reply_los = 0.95;
  double long_nlos_reply = 0.45;
  double excess_m = 0.3;                  // least excess behind a wall
  double long_nlos_excess_mean_m = 0.15;  // mean of the exponential excess beyond it
  double short_nlos_reply = 0.6;
  double short_nlos_excess_mean_m = 0.3;
  double shadows_per_s = 0.01;  // short NLOS of each pair, lasting 1 to 10 s
  double gross_share = 0.02;    // 0.5 to 4 m too long
  Powers powers = Powers::kNone;
};

bool crosses(const PlanWall& wall, const Eigen::Vector2d& a, const Eigen::Vector2d& b);

// Settings of a drive whose pairs are polled every 0.12 s.
SiteSettings polled_settings(Route route, double duration_s);

// An anchor is somewhere else for a while.
struct Stay {
  std::size_t anchor = 0;  // index
  Eigen::Vector3d by_m = Eigen::Vector3d::Zero();
  double from_s = 0.0;
  double to_s = std::numeric_limits<double>::infinity();
};

// Sets the powers of a range that is NLOS to the given degree.
void add_powers(Powers powers, double blocked_share, Random& random, model::RangeSample& range);

// Simulates a polled site with NLOS and lost replies.
SimulatedSite blocked_site(const SiteSettings& settings, const Blocking& blocking, std::uint64_t seed,
                           const std::vector<Stay>& stays = {});

// Squared Mahalanobis distance of the error of the anchor's position.
inline double square_sigmas(const model::AnchorCalibration& anchor, const Eigen::Vector3d& truth_m) {
  const Eigen::Vector3d error_m = anchor.position_m - truth_m;
  return error_m.dot(anchor.covariance.topLeftCorner<3, 3>().ldlt().solve(error_m));
}

}  // namespace groma::test
