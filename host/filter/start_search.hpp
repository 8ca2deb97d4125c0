// Global localization without a prior: searches for the poses that explain the ranges of the last seconds,
// related to one pose by odometry.
//
// Candidates on rings around the nearest anchors, in all headings and on each chart of the surface, are rated
// coarsely. The best of each chart are refined by robust Gauss-Newton steps on a subset of the ranges, and
// distinct results on all of them. Results at the same pose are one hypothesis; hypotheses far less likely
// than the best are dropped. No clock, no allocation after construction; deterministic.
#pragma once

#include <array>
#include <limits>
#include <optional>
#include <span>
#include <utility>
#include <vector>

#include "host/filter/config.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/model/pose.hpp"
#include "host/model/state_archive.hpp"

namespace groma::filter {

class StartSearch {
 public:
  static constexpr std::size_t kMaxRanges = 512;    // a size; a search over all of them takes 9 to 14 ms
  static constexpr std::size_t kMaxHypotheses = 8;  // a size
  // A hypothesis with a larger mean weight explains the ranges. By hand;
  // StartSearch.InconsistentRangesDoNotSettle (simulated).
  static constexpr double kExplainedShare = 0.5;

  struct Hypothesis {
    model::PlanarPose pose;  // at the newest input
    // Of x_m, y_m, theta_rad: from the noise of ranges and odometry, and from the calibration's errors.
    Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();
    double cost = 0.0;         // -ln of the likelihood, without the calibration's correlations
    double mean_weight = 0.0;  // 1: all ranges as expected
  };

  // As Filter's.
  StartSearch(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
              const Config& config);

  // Ignores odometry older than the newest input, ranges older than it by 0.5 s, unknown ids, values that are
  // not finite, and ranges out of bounds.
  void process(const model::OdometrySample& sample) noexcept;
  void process(const model::RangeSample& range) noexcept;
  // Forgets the ranges.
  void clear() noexcept;
  // Forgets ranges, odometry and time.
  void stop() noexcept;

  // The hypotheses at the newest input, the likeliest first; none with fewer than three ranges. Valid until
  // the next call.
  std::span<const Hypothesis> search() noexcept;
  // The hypotheses near one pose, on each chart that covers it.
  std::span<const Hypothesis> search_floors(const model::PlanarPose& about) noexcept;
  // Whether the last search left a single hypothesis that has a small covariance and explains the ranges.
  [[nodiscard]] bool settled() const noexcept { return settled_; }
  // Cost of a pose at the newest input, in which the cost of each anchor grows only logarithmically: one
  // obstacle makes all ranges of an anchor NLOS, to all tags, for as long as it is in the way.
  [[nodiscard]] double cautious_cost(const model::PlanarPose& pose) noexcept;

  // As Filter's; the result of the last search is not part of it.
  void archive(model::StateArchive& state) {
    state(seen_, first_, count_, last_taken_s_, now_, sample_, t_s_, settled_);
  }

  [[nodiscard]] double t_s() const noexcept { return t_s_; }
  [[nodiscard]] std::size_t ranges() const noexcept { return count_; }

 private:
  // Motion since the last clear(), dead reckoned on a plane, and its variance from the odometry's noise.
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
    Odometer at;  // at the measurement: range_delay_s before the timestamp
    // Independent of the hypothesis, as of the last relate().
    Eigen::Vector3d back = Eigen::Vector3d::Zero();  // pose then, in the frame of the newest pose
    double cos_back = 1.0;                           // cosine and sine of its heading
    double sin_back = 0.0;
    double drift_variance_m2 = 0.0;
    double variance_m2 = 0.0;  // as of the last linearize() with new variances
  };
  struct Frame;
  struct Residual {
    model::SurfaceRange predicted;
    double e_m = 0.0;           // measured minus predicted
    Eigen::RowVector3d d_pose;  // of the predicted range, w.r.t. the pose now
  };
  // Gauss-Newton equations at one pose.
  struct Sums {
    Eigen::Matrix3d information;
    Eigen::Vector3d gradient = Eigen::Vector3d::Zero();
    double cost = 0.0;
    double weights = 0.0;
  };
  // Derivative of a pose w.r.t. the parameters of an anchor.
  using ByAnchor = Eigen::Matrix<double, 3, Eigen::Dynamic, Eigen::ColMajor, 3, kMaxAnchorSize>;

  void advance(double t_s) noexcept;
  [[nodiscard]] Seen& seen(std::size_t i) noexcept { return seen_[(first_ + i) % kMaxRanges]; }
  void drop_oldest() noexcept;
  // Drops old ranges, and relates the others to the newest pose.
  void relate() noexcept;
  // Calls each(seen, chart) for every n-th range, n = every. chart: the one that the robot was on at the
  // range's time if it is now at `pose` on the given chart.
  template <class Each>
  void walk_back(const Eigen::Vector3d& pose, int chart, std::size_t every, const Each& each) noexcept;
  [[nodiscard]] Residual residual(const Seen& seen, const Frame& now, int chart) const noexcept;
  [[nodiscard]] double variance_m2(const Seen& seen, const model::SurfaceRange& predicted,
                                   int chart) const noexcept;
  // Stops early if the cost exceeds `most`; the result is then the partial cost.
  [[nodiscard]] double coarse_cost(const Eigen::Vector3d& pose, int chart, double width_m,
                                   double most) noexcept;
  // Linearizes every n-th range at a pose; new_variances: recomputes their variances, else uses the last
  // ones.
  Sums linearize(const Eigen::Vector3d& pose, int chart, std::size_t every, bool new_variances) noexcept;
  Hypothesis refine(const model::PlanarPose& start, std::size_t every, int steps) noexcept;
  // Refines starts_ and keeps the results.
  void refine_starts() noexcept;
  // Rates the candidates around the nearest anchors on one chart and refines the best.
  void try_chart(int chart) noexcept;
  // Refines the hypotheses' mirror images: a line of anchors, or one tag on a straight path, is ambiguous.
  void try_mirrored() noexcept;
  [[nodiscard]] bool is_same(const model::PlanarPose& a, const model::PlanarPose& b) const noexcept;
  void add_calibration(Hypothesis& hypothesis) noexcept;
  void keep(const Hypothesis& hypothesis) noexcept;
  // False if there are too few ranges.
  bool begin_search() noexcept;
  // Drops unlikely hypotheses, completes the covariances and decides settled_.
  std::span<const Hypothesis> end_search() noexcept;

  model::Surface surface_;
  Config config_;
  Site site_;
  std::array<Seen, kMaxRanges> seen_;  // ring buffer
  std::size_t first_ = 0;
  std::size_t count_ = 0;
  std::vector<double> last_taken_s_;   // of each pair
  std::vector<double> anchor_costs_;   // scratch
  std::vector<ByAnchor> by_anchor_;    // scratch, zero between uses
  std::vector<const Seen*> shortest_;  // shortest of each anchor, nearest first
  std::vector<Hypothesis> starts_;     // candidates: with coarse costs, then roughly refined
  std::vector<Hypothesis> hypotheses_;
  Odometer now_;
  std::optional<model::OdometrySample> sample_;
  double t_s_ = -std::numeric_limits<double>::infinity();
  bool settled_ = false;
};

}  // namespace groma::filter
