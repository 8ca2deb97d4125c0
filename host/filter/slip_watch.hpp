// Detects a displacement of the robot that its odometry does not show, from the ranges of several anchors:
// wheels that slip as gently as a robot accelerates, or a robot that is carried. One anchor alone may be
// NLOS, and so may several anchors whose ranges are all too long. A single displacement that explains the
// ranges of at least three anchors, some of them too short, is attributed to the robot.
//
// The excess e of a range is its innovation minus the pair's recent mean LOS innovation, so that a constant
// bias is no displacement. Each anchor has a window with exponential forgetting, in which its mean excess is
// z standard deviations. For a displacement d, with h the mean derivative of the range w.r.t. x and y and w
// the sum of 1/S,
//
//   z(d) = (sum e/S - w h d)/√w,     cost(d) = sum over anchors of min(z²/2, c),
//
// where c is the cost of another cause: low for too long (NLOS), high for too short. A slip is detected if
// the best d has a lower cost than d = 0 by the prior odds against a slip.
#pragma once

#include <array>
#include <cstddef>
#include <limits>
#include <optional>

#include <Eigen/Core>

#include "host/filter/odometry_gate.hpp"
#include "host/filter/state.hpp"

namespace groma::filter {

class SlipWatch {
 public:
  static constexpr double kWindow_s = 0.4;  // time constant of an anchor's sums. By hand; Slip.* (simulated)

  // odds: ln of the prior odds against a slip.
  explicit SlipWatch(double odds) : odds_(odds) {}

  // Called for each range of a pair (slot, tag), before the update, with the innovation, its variance S, the
  // gate's weight and the derivative of the range w.r.t. x and y. Returns the displacement (m, map frame) of
  // the robot from the estimated position when a slip is detected.
  std::optional<Eigen::Vector2d> observe(int anchor, int tag, double t_s, double innovation_m,
                                         double variance_m2, double weight,
                                         const Eigen::RowVector2d& by_position) noexcept;

  // Forgets a slot's history: another anchor is active there.
  void renew(int anchor) noexcept;

 private:
  struct Sums {
    double t_s = 0.0;
    double n = 0.0;    // ranges
    double w = 0.0;    // sum 1/S
    double off = 0.0;  // sum e/S
    double x = 0.0;    // sum h/S
    double y = 0.0;
  };
  struct Usual {
    double t_s = -std::numeric_limits<double>::infinity();
    double innovation_m = 0.0;
  };

  static void fade(Sums& sums, double until_s) noexcept;
  [[nodiscard]] std::optional<Eigen::Vector2d> find_displacement(double t_s) noexcept;

  double odds_;
  std::array<Sums, kMaxAnchors> anchors_{};
  std::array<Usual, kMaxPairs> usual_{};
};

// Inflates the odometry noise for a while after a slip, and for longer if slips repeat.
class SlipInflation {
 public:
  // By hand; Slip.* (simulated).
  static constexpr double kLasts_s = 0.5;    // time constant; doubled with each repetition
  static constexpr double kTurnPer_m = 0.5;  // yaw-rate error in rad/s per m/s

  // A slip by this displacement was detected.
  void begin(double displacement_m, double t_s) noexcept;
  // Additional variances of an odometry sample, gap_s after the previous one.
  OdometryInflation judge(double gap_s) noexcept;
  [[nodiscard]] bool is_open() const noexcept { return excess_mps_ > 0.0; }

 private:
  double excess_mps_ = 0.0;
  double lasts_s_ = 0.0;
  double last_s_ = -std::numeric_limits<double>::infinity();
};

}  // namespace groma::filter
