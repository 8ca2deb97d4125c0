// The factor graph over poses and calibration, solved by Ceres: all data up to now, or a sliding window of
// it.
#pragma once

#include <deque>
#include <memory>
#include <vector>

#include <Eigen/Core>

#include "test/baseline/method.hpp"

namespace groma::baseline {

// Odometry since a keyframe, in its frame, with scale and bias zero.
struct Increment {
  Eigen::Vector3d moved = Eigen::Vector3d::Zero();    // x, y, theta
  Eigen::Vector2d by_bias = Eigen::Vector2d::Zero();  // of x, y, by the yaw-rate bias
  double passed_s = 0.0;
  Eigen::Vector3d velocity = Eigen::Vector3d::Zero();    // base_link's, in the keyframe's frame, and yaw rate
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // of `moved`
};

struct GraphOptions {
  double keyframe_s = 0.2;
  double window_s = 0.0;  // 0: all data
  Parameters parameters;
};

// Unknowns: the pose at each keyframe; the odometry's scale and yaw-rate bias and the ranges' delay; of each
// anchor its position and terms, of each tag its lever arm, the frame that all anchors share; and, where the
// calibration has one, each anchor's slow range bias, constant over half of its correlation length. Their
// priors are those of the calibration file and of the filter's configuration.
//
// Ranges between two keyframes refer to the earlier one by the odometry since. The noise of that odometry is
// neglected against the ranges' (a few millimetres), and it is in the factor between the keyframes.
class Graph {
 public:
  Graph(const Drive& drive, const GraphOptions& options);
  Graph(const Graph&) = delete;
  Graph& operator=(const Graph&) = delete;
  ~Graph();

  void hold(const Held& held) { held_ = held; }
  void move(double dt_s);
  void add(const Range& range);
  // A keyframe now; nothing if no time passed since the last.
  void add_keyframe();
  // Of the last keyframe.
  [[nodiscard]] double since_keyframe_s() const noexcept { return increment_.passed_s; }
  // Optimizes all unknowns; with a window, marginalizes the keyframes that left it.
  void solve();
  // Covariance of the last keyframe's pose at the last solve().
  [[nodiscard]] Eigen::Matrix3d covariance() const;
  // Pose now, by odometry since the last keyframe, with its covariance from that of the keyframe.
  [[nodiscard]] model::PlanarEstimate predict(double t_s, const Eigen::Matrix3d& keyframe_covariance) const;

 private:
  class Model;

  const Drive& drive_;  // NOLINT(*-avoid-const-or-ref-data-members)
  GraphOptions options_;
  Held held_;
  Increment increment_;
  std::unique_ptr<Model> model_;
};

// A sliding window: keyframes of keyframe_s, solved at each.
class CeresWindow final : public Method {
 public:
  CeresWindow(const Drive& drive, const Parameters& parameters);
  void hold(const Held& held) override;
  void move(double dt_s) override;
  bool measure(const Range& range) override;
  model::PlanarEstimate estimate(double t_s) override;

 private:
  Graph graph_;
  Eigen::Matrix3d covariance_;
};

// The causal reference: a solve over all data up to the last odometry sample at or before each instant.
// Without given instants, one each second.
class CeresBatch final : public Method {
 public:
  CeresBatch(const Drive& drive, const Parameters& parameters, std::vector<double> instants_s = {});
  void hold(const Held& held) override;
  void move(double dt_s) override;
  bool measure(const Range& range) override;
  model::PlanarEstimate estimate(double t_s) override;
  [[nodiscard]] bool has_row(double t_s) override;

 private:
  Graph graph_;
  std::deque<double> rows_s_;  // times of the rows that are left
};

}  // namespace groma::baseline
