// Where the robot is when nobody tells: the poses that the ranges of the last seconds agree with, joined by
// the odometry between them.
//
// Starts on rings about the nearest anchors, in all headings and on each chart of the surface, are judged
// coarsely; the best of each chart are refined by robust Gauss-Newton steps on a part of the ranges, and what
// ends apart on all of them. What ends at one place is one hypothesis; one that is far less likely than the
// best is given up. No clock, no allocation after construction; the same inputs give the same hypotheses.
#pragma once

#include <array>
#include <cstddef>
#include <limits>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/filter/config.hpp"
#include "host/filter/range_measurement.hpp"
#include "host/filter/site.hpp"
#include "host/filter/state.hpp"
#include "host/model/calibration.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

struct StartSearchConfig {
  double window_s = 6.0;        // older ranges are forgotten
  double spacing_s = 0.25;      // between the ranges of one pair that are looked at
  double correlation_s = 1.0;   // of the errors of one pair: within it they tell one thing
  double latest_s = 0.5;        // by how much a range may be older than the newest input
  double excess_knee = 1.5;     // beyond so many sigmas a range too long tells less and less,
  double shortfall_knee = 3.0;  // and beyond these one too short
  double odds = 8.0;            // ln of the odds at which a hypothesis is given up
  double anchor_say = 4.0;      // ln of the odds from which one anchor's cautious cost counts less and less
  // A hypothesis is a pose when it is surer than these and the mean weight of its ranges is above the share.
  double position_sigma_m = 0.5;
  double heading_sigma_rad = 0.2;
  double weight_share = 0.5;
};

class StartSearch {
 public:
  static constexpr std::size_t kMaxRanges = 512;
  static constexpr std::size_t kMaxHypotheses = 8;

  struct Hypothesis {
    model::PlanarPose pose;  // at the newest input
    // Of x_m, y_m, theta_rad: by the ranges' noise, the odometry's and the calibration's, which all share.
    Eigen::Matrix3d covariance = Eigen::Matrix3d::Identity();
    double cost = 0.0;         // -ln of the likelihood, but for what all share
    double mean_weight = 0.0;  // 1: all ranges as expected
  };

  // As Filter's.
  StartSearch(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
              const Config& config, const StartSearchConfig& search = {});

  // Rows older than the newest input are passed over, and ranges older by latest_s; so is what is unknown or
  // not a number.
  void process(const model::OdometrySample& row) noexcept;
  void process(const model::RangeSample& range) noexcept;
  // Forgets the ranges.
  void clear() noexcept;
  // Forgets the rows and the time, too.
  void stop() noexcept;

  // The hypotheses as of the newest input, the likeliest first; none with fewer than three ranges.
  std::span<const Hypothesis> search() noexcept;
  // The same of what is near one place alone, on each of the charts that cover it.
  std::span<const Hypothesis> search_floors(const model::PlanarPose& about) noexcept;
  // Whether the last search left one alone, and that one sure.
  [[nodiscard]] bool settled() const noexcept { return settled_; }
  // Cost of a pose at the newest input, where what one anchor says counts less the more of it there is: one
  // wall is in the way of all its ranges, to all tags, for as long as the robot is behind it.
  [[nodiscard]] double cautious_cost(const model::PlanarPose& pose) noexcept;

  // The mean weight of a hypothesis from which it explains the ranges.
  [[nodiscard]] double explained_share() const noexcept { return search_.weight_share; }
  [[nodiscard]] double t_s() const noexcept { return t_s_; }
  [[nodiscard]] std::size_t ranges() const noexcept { return count_; }

 private:
  // Motion since the last clear(), dead reckoned on a plane, and how sure it is.
  struct Odometer {
    Eigen::Vector3d pose = Eigen::Vector3d::Zero();
    double path_m = 0.0;
    double position_variance_m2 = 0.0;   // by the rows' noise
    double heading_variance_rad2 = 0.0;  // by the rows' noise
  };
  struct Seen {
    double t_s = 0.0;
    int anchor = 0;
    int tag = 0;
    double range_m = 0.0;
    model::OdometrySample row;
    Odometer at;  // when the antennas met: the link's delay ago
  };
  // A range with what does not depend on the hypothesis.
  struct Term {
    const Seen* seen = nullptr;
    Eigen::Vector3d back = Eigen::Vector3d::Zero();  // pose then, from the newest one's frame
    double cos_back = 1.0;                           // of its heading
    double sin_back = 0.0;
    double drift_variance_m2 = 0.0;
  };
  struct Residual {
    RangeMeasurement predicted;
    double e_m = 0.0;                                        // measured less predicted
    Eigen::RowVector3d d_pose = Eigen::RowVector3d::Zero();  // of the predicted range
  };
  // Of a refinement at one pose.
  struct Sums {
    Eigen::Matrix3d information = Eigen::Matrix3d::Zero();
    Eigen::Vector3d gradient = Eigen::Vector3d::Zero();
    double cost = 0.0;
    double weights = 0.0;
  };

  // How a pose depends on the parameters of an anchor.
  using ByAnchor = Eigen::Matrix<double, 3, Eigen::Dynamic, Eigen::ColMajor, 3, kMaxAnchorSize>;

  void advance(double t_s) noexcept;
  [[nodiscard]] Seen& seen(std::size_t i) noexcept { return seen_[(first_ + i) % kMaxRanges]; }
  [[nodiscard]] const Seen& seen(std::size_t i) const noexcept { return seen_[(first_ + i) % kMaxRanges]; }
  [[nodiscard]] Term term_of(const Seen& seen) const noexcept;
  void forget_old() noexcept;
  // What a range tells beside others of its pair that share its error.
  [[nodiscard]] double share() const noexcept;
  // Calls each(i, chart) for every n-th term, with the chart that the robot was on at its time if it has that
  // pose on `chart` now.
  template <class Each>
  void walk_back(const Eigen::Vector3d& pose, int chart, std::size_t every, const Each& each) const noexcept;
  // `then`: the robot's pose at the term's time, if `pose` is the one now.
  [[nodiscard]] Residual residual(const Term& term, const Eigen::Vector3d& pose, const Eigen::Vector3d& then,
                                  int chart) const noexcept;
  // Variance of all that is not the pose, m^2.
  [[nodiscard]] double variance_m2(const Term& term, const RangeMeasurement& predicted,
                                   int chart) const noexcept;
  // Above `most`: of some of the ranges only.
  [[nodiscard]] double coarse_cost(const Eigen::Vector3d& pose, int chart, double width_m,
                                   double most) const noexcept;
  // Of every n-th range at a pose; with new variances, or with those of the last time.
  Sums look(const Eigen::Vector3d& pose, int chart, std::size_t every, bool anew) noexcept;
  Hypothesis refine(const model::PlanarPose& start, std::size_t every, int steps) noexcept;
  // Keeps what the starts lead to.
  void refine_all(std::span<const model::PlanarPose> starts) noexcept;
  // The likeliest of the starts about the nearest anchors, on one chart of the surface.
  void try_chart(int chart, std::ptrdiff_t rings) noexcept;
  [[nodiscard]] bool is_same(const model::PlanarPose& a, const model::PlanarPose& b) const noexcept;
  void add_calibration(Hypothesis& hypothesis) noexcept;
  void keep(const Hypothesis& hypothesis) noexcept;
  // False where there are too few ranges.
  bool begin_search() noexcept;
  // Gives up what is unlikely.
  std::span<const Hypothesis> end_search() noexcept;

  model::Surface surface_;
  Config config_;
  StartSearchConfig search_;
  Site site_;
  std::array<Seen, kMaxRanges> seen_;
  std::size_t first_ = 0;
  std::size_t count_ = 0;
  std::vector<double> last_taken_s_;  // of each pair
  std::array<Term, kMaxRanges> terms_;
  std::array<double, kMaxRanges> variances_m2_;  // scratch
  std::vector<const Term*> shortest_;            // of each anchor
  std::vector<double> anchor_costs_;             // scratch
  std::vector<ByAnchor> by_anchor_;              // scratch, zero between uses
  Odometer now_;
  model::OdometrySample row_{};
  bool has_row_ = false;
  double t_s_ = -std::numeric_limits<double>::infinity();
  std::array<Hypothesis, kMaxHypotheses> hypotheses_;
  std::size_t hypothesis_count_ = 0;
  bool settled_ = false;
};

}  // namespace groma::filter
