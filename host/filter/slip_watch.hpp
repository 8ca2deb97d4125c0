// Whether the robot went another way than its odometry, by what the ranges of many anchors say together:
// wheels slip as gently as a robot accelerates, or it is carried. An anchor alone is blocked, and so are
// several that are all too far; one displacement that explains what at least three of them see, some of them
// from too near, is the robot's.
//
// Of each range counts by how much its innovation is above what its pair's in sight was of late, so that what
// an anchor is always off by is no displacement. In a window that fades, an anchor is off by z deviations of
// its mean. Of a displacement d, with h the mean derivative by x and y and w the sum of 1/S,
//
//   z(d) = (sum e/S - w h d)/√w,     cost(d) = sum over anchors of min(z²/2, c),
//
// c what it costs to have another reason: little to be too far (a wall), much to be too near. The odometry is
// wrong where the best d costs less than none by as much as a slip is unlikely.
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
  static constexpr double kWindow_s = 0.4;

  // odds: ln of how unlikely a slip is.
  explicit SlipWatch(double odds) : odds_(odds) {}

  // Of a pair of slots, before the range is used: innovation and its variance, the gate's weight, and the
  // derivative of the range by x and y. The displacement (m, map) by which the pose is wrong, where that
  // shows.
  std::optional<Eigen::Vector2d> observe(int anchor, int tag, double t_s, double innovation_m,
                                         double variance_m2, double weight,
                                         const Eigen::RowVector2d& by_position) noexcept;

  // Another anchor comes into a slot.
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
    double t_s = 0.0;
    double innovation_m = 0.0;
    bool heard = false;
  };

  static void fade(Sums& sums, double until_s) noexcept;
  [[nodiscard]] std::optional<Eigen::Vector2d> find_displacement(double t_s) noexcept;

  double odds_;
  std::array<Sums, kMaxAnchors> anchors_{};
  std::array<Usual, kMaxPairs> usual_{};
};

// How far odometry is to be believed since a slip showed: not for a while, and longer where it shows again.
class SlipDoubt {
 public:
  static constexpr double kLasts_s = 0.5;    // at first; twice as long each time that it shows again
  static constexpr double kTurnPer_m = 0.5;  // rad/s of the yaw rate's doubt for each m/s

  // A displacement by so much showed.
  void begin(double displacement_m, double t_s) noexcept;
  // Of a row, gap_s after the one before.
  OdometryDoubt judge(double gap_s) noexcept;
  [[nodiscard]] bool is_open() const noexcept { return excess_mps_ > 0.0; }

 private:
  double excess_mps_ = 0.0;
  double lasts_s_ = 0.0;
  double last_s_ = -std::numeric_limits<double>::infinity();
};

}  // namespace groma::filter
