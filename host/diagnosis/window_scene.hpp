// Ranges of a drive whose anchors are known and whose poses are not: dead reckoning in windows, each at an
// unknown place.
#pragma once

#include <cstddef>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/diagnosis/data.hpp"
#include "host/diagnosis/dead_reckoning.hpp"
#include "host/diagnosis/range_fit.hpp"
#include "host/model/anchor_parameters.hpp"
#include "host/model/calibration.hpp"

namespace groma::diagnosis {

// A block: x, y (m) and heading (rad) of the window's begin. Within a window, the odometry is integrated with
// the scales of the mistake. `data` and `calibration` must outlive the scene.
class WindowScene final : public Scene {
 public:
  // Ranges of pairs with a calibrated bias, evenly thinned to about most_rows.
  WindowScene(const Data& data, const model::Calibration& calibration, std::size_t most_rows);

  [[nodiscard]] std::size_t block_count() const override { return windows_.size(); }
  void locate(const Mistake& mistake, std::vector<Eigen::Vector3d>& antennas_m) const override;
  [[nodiscard]] double predict_m(const RangeRow& row, const Eigen::Vector3d& antenna_m,
                                 const Eigen::VectorXd& block, RangeDerivatives& out) const override;
  [[nodiscard]] std::vector<Eigen::VectorXd> starts(
      std::span<const RangeRow> rows, std::span<const Eigen::Vector3d> antennas_m) const override;
  // Begin of each block's window, s.
  [[nodiscard]] std::span<const double> windows() const noexcept { return windows_; }
  // The pose (x, y in m, heading in rad) at to_s of a robot that is at `pose` at from_s, before or after
  // that, by dead reckoning; NaN without odometry.
  [[nodiscard]] Eigen::Vector3d carried(const Eigen::Vector3d& pose, double from_s, double to_s) const;

 private:
  struct Pair {
    Eigen::Vector3d anchor_m;
    model::TermVector terms;
  };
  // Since the begin of a row's window, in the axes of base_link there; before scales of the speed.
  struct Motion {
    Eigen::Vector2d way_m;
    Eigen::Matrix2d turn;
  };
  struct Motions {
    model::ClockError clock;
    DeadReckoning::YawRateError yaw_rate;
    std::vector<Motion> of_rows;
  };
  [[nodiscard]] const Motions& motions(const model::ClockError& clock,
                                       const DeadReckoning::YawRateError& yaw_rate) const;

  const Data& data_;
  std::vector<model::OdometrySample> odometry_;  // joined
  std::vector<double> windows_;                  // begin of each, s
  std::vector<Pair> pairs_;                      // RangeRow::anchor is the index here
  // Those that were asked for last, and before: a numerical derivative needs both in turn.
  mutable Motions motions_;
  mutable Motions former_motions_;
  // Rows of a block are asked for one after the other.
  mutable double turn_rad_ = 0.0;
  mutable Eigen::Matrix2d turn_ = Eigen::Matrix2d::Identity();
};

}  // namespace groma::diagnosis
