// Where the robot is when no start is given: the poses that the ranges of the last seconds agree with, joined
// by the odometry between them.
//
// Starts on rings about the nearest anchors, in all headings and on each chart of the surface, are judged
// coarsely. The best of each chart are refined by robust Gauss-Newton steps on a part of the ranges, and what
// ends apart on all of them. What ends at one place is one hypothesis; one that is far less likely than the
// best is given up. No clock, no allocation after construction; the same inputs give the same hypotheses.
#pragma once

#include <array>
#include <limits>
#include <optional>
#include <vector>

#include "host/filter/range_measurement.hpp"

namespace groma::filter {

class StartSearch {
 public:
  static constexpr std::size_t kMaxRanges = 512;
  static constexpr std::size_t kMaxHypotheses = 8;
  // The mean weight of a hypothesis from which it explains the ranges.
  static constexpr double kExplainedShare = 0.5;

  struct Hypothesis {
    model::PlanarPose pose;  // at the newest input
    // Of x_m, y_m, theta_rad: by the noise of ranges and odometry, and by the calibration's common errors.
    Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();
    double cost = 0.0;         // -ln of the likelihood, without the common errors
    double mean_weight = 0.0;  // 1: all ranges as expected
  };

  // As Filter's.
  StartSearch(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
              const Config& config);

  // Odometry older than the newest input is ignored, as are ranges older by 0.5 s, unknown ids, and what is
  // not finite.
  void process(const model::OdometrySample& row) noexcept;
  void process(const model::RangeSample& range) noexcept;
  // Forgets the ranges.
  void clear() noexcept;
  // Forgets odometry and time, too.
  void stop() noexcept;

  // The hypotheses as of the newest input, the likeliest first; none with fewer than three ranges.
  std::span<const Hypothesis> search() noexcept;
  // Those near one place, on each chart that covers it.
  std::span<const Hypothesis> search_floors(const model::PlanarPose& about) noexcept;
  // Whether the last search left one hypothesis, with small covariance.
  [[nodiscard]] bool settled() const noexcept { return settled_; }
  // Cost of a pose at the newest input, where the cost of one anchor grows with its logarithm: one wall is in
  // the way of all its ranges, to all tags, for as long as the robot is behind it.
  [[nodiscard]] double cautious_cost(const model::PlanarPose& pose) noexcept;

  [[nodiscard]] double t_s() const noexcept { return t_s_; }
  [[nodiscard]] std::size_t ranges() const noexcept { return count_; }

 private:
  // Motion since the last clear(), dead reckoned on a plane, and the variance by the noise of odometry.
  struct Odometer {
    Eigen::Vector3d pose = Eigen::Vector3d::Zero();
    double path_m = 0.0;
    double position_variance_m2 = 0.0;
    double heading_variance_rad2 = 0.0;
  };
  struct Seen {
    double t_s = 0.0;
    int anchor = 0;
    int tag = 0;
    double range_m = 0.0;
    model::OdometrySample row;
    Odometer at;  // when the antennas met: the link's delay ago
    // What does not depend on the hypothesis, as of the last relate().
    Eigen::Vector3d back = Eigen::Vector3d::Zero();  // pose then, from the newest one's frame
    double cos_back = 1.0;                           // of its heading
    double sin_back = 0.0;
    double drift_variance_m2 = 0.0;
    double variance_m2 = 0.0;  // as of the last linearize() with new variances
  };
  struct Frame;
  struct Residual {
    RangeMeasurement predicted;
    double e_m = 0.0;           // measured less predicted
    Eigen::RowVector3d d_pose;  // of the predicted range, by the pose now
  };
  // Of a refinement at one pose.
  struct Sums {
    Eigen::Matrix3d information;
    Eigen::Vector3d gradient = Eigen::Vector3d::Zero();
    double cost = 0.0;
    double weights = 0.0;
  };
  // Derivative of a pose by the parameters of an anchor.
  using ByAnchor = Eigen::Matrix<double, 3, Eigen::Dynamic, Eigen::ColMajor, 3, kMaxAnchorSize>;

  void advance(double t_s) noexcept;
  [[nodiscard]] Seen& seen(std::size_t i) noexcept { return seen_[(first_ + i) % kMaxRanges]; }
  void drop_oldest() noexcept;
  // Forgets what is old, and relates the rest to the newest input.
  void relate() noexcept;
  // Calls each(seen, chart) for every n-th range, with the chart that the robot was on at its time if it has
  // that pose on `chart` now.
  template <class Each>
  void walk_back(const Eigen::Vector3d& pose, int chart, std::size_t every, const Each& each) noexcept;
  [[nodiscard]] Residual residual(const Seen& seen, const Frame& now, int chart) const noexcept;
  [[nodiscard]] double variance_m2(const Seen& seen, const RangeMeasurement& predicted,
                                   int chart) const noexcept;
  // Above `most`: of some of the ranges only.
  [[nodiscard]] double coarse_cost(const Eigen::Vector3d& pose, int chart, double width_m,
                                   double most) noexcept;
  // Of every n-th range at a pose; with new variances, or with those of the last time.
  Sums linearize(const Eigen::Vector3d& pose, int chart, std::size_t every, bool new_variances) noexcept;
  Hypothesis refine(const model::PlanarPose& start, std::size_t every, int steps) noexcept;
  // Refines starts_, and keeps where they end.
  void refine_starts() noexcept;
  // The likeliest of the starts about the nearest anchors, on one chart of the surface.
  void try_chart(int chart) noexcept;
  // Starts at what a line of anchors, or one tag's straight path, cannot separate from the hypotheses.
  void try_mirrored() noexcept;
  [[nodiscard]] bool is_same(const model::PlanarPose& a, const model::PlanarPose& b) const noexcept;
  void add_calibration(Hypothesis& hypothesis) noexcept;
  void keep(const Hypothesis& hypothesis) noexcept;
  // False where there are too few ranges.
  bool begin_search() noexcept;
  // Gives up what is unlikely.
  std::span<const Hypothesis> end_search() noexcept;

  model::Surface surface_;
  Config config_;
  Site site_;
  std::array<Seen, kMaxRanges> seen_;  // a ring
  std::size_t first_ = 0;
  std::size_t count_ = 0;
  std::vector<double> last_taken_s_;                          // of each pair
  std::vector<double> anchor_costs_;                          // scratch
  std::vector<ByAnchor> by_anchor_;                           // scratch, zero between uses
  std::vector<const Seen*> shortest_;                         // of each anchor in range, the nearest first
  std::vector<std::pair<double, model::PlanarPose>> starts_;  // with their coarse costs
  std::vector<Hypothesis> rough_;
  std::vector<Hypothesis> hypotheses_;
  Odometer now_;
  std::optional<model::OdometrySample> row_;
  double t_s_ = -std::numeric_limits<double>::infinity();
  bool settled_ = false;
};

}  // namespace groma::filter
