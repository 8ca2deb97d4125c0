// Calibrates anchors while the robot drives, and checks whether the anchors in use have moved. The solver
// runs in its own thread; callers that feed the learner never wait for it.
#pragma once

#include <cstddef>
#include <future>
#include <limits>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/learning.hpp"
#include "host/daemon/measurement_sink.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

enum class AnchorState {
  kKnown,     // from an earlier calibration; in use
  kLearning,  // not yet good enough to be used
  kLive,      // calibrated on this drive; in use
  kMoved,     // was in use and has moved; being calibrated again
};

// "known", "learning", "live" or "moved".
[[nodiscard]] std::string_view state_word(AnchorState state) noexcept;

// The progress of one anchor's calibration, for the driver.
struct AnchorProgress {
  model::NodeId id = 0;
  AnchorState state = AnchorState::kLearning;
  double coverage = 0.0;  // share of the required data, 0 to 1; see calibration::coverage()
  model::AnchorVerdict verdict = model::AnchorVerdict::kNoData;
  std::string advice;
  std::optional<Eigen::Vector2d> drive_to_m;  // the place that the advice names
  std::size_t ranges_used = 0;
  std::optional<double> sigma_m;  // the larger of x and y; none: no position yet
};

class AnchorLearner : public MeasurementSink {
 public:
  // The source of the poses that anchors are calibrated from.
  enum class Poses {
    kPriors,  // the robot's pose priors, by on_pose_prior()
    kFilter,  // a filter that tracks by known anchors, by on_filter_pose()
  };
  struct Setup {
    std::vector<model::Tag> tags;
    model::Surface surface;
    model::RangePriors priors;
    model::Calibration earlier;  // its anchors stay unchanged until one is found moved
    Poses poses = Poses::kPriors;
    calibration::DriveStoreLimits limits{};
    double step_s = 5.0;   // minimum drive time between steps; each step rechecks the anchors in use
    bool threaded = true;  // false: service() solves in the caller's thread; results are then reproducible
  };
  // The whole drive is solved again once it has grown by this fraction, or after this time at most.
  static constexpr double kLongerShare = 0.05;
  static constexpr double kMaxBetween_s = 60.0;
  // An anchor counts as moved after this many consecutive steps that found it elsewhere.
  static constexpr int kMovedSteps = 3;
  // A new solution replaces the anchors in use once one sigma is below this fraction of its old value.
  static constexpr double kBetterShare = 0.75;

  explicit AnchorLearner(Setup setup);

  void on_odometry(const model::OdometrySample& /*sample*/) override {}
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& pose) override;
  void on_clock_set() override;  // discards the measurements so far; keeps the calibrated anchors
  void on_filter_pose(const model::PoseSample& pose);

  // Starts a step that is due and collects one that is done. True if the anchors in use have changed.
  [[nodiscard]] bool service();
  // At the end of a drive: waits for the running step, then solves the whole drive. True as for service().
  [[nodiscard]] bool finish();

  // Anchors in use, their verdict for the site, and the covariance of their frame.
  [[nodiscard]] const model::Calibration& live() const noexcept { return live_; }
  // All anchors that are in use or were ranged to, by id.
  [[nodiscard]] std::vector<AnchorProgress> progress() const;
  // One line for each event since the last call: an anchor was calibrated or found moved.
  [[nodiscard]] std::vector<std::string> take_news();
  [[nodiscard]] std::size_t steps() const noexcept { return steps_; }

 private:
  [[nodiscard]] calibration::LearningInput input(bool all_places) const;
  [[nodiscard]] bool take(calibration::LearningStep step, bool last);
  [[nodiscard]] bool remove_moved(const std::vector<calibration::AnchorChange>& rechecked);
  [[nodiscard]] bool adopt_calibrated(bool last);
  [[nodiscard]] bool is_earlier(model::NodeId id) const;

  Setup setup_;
  calibration::DriveStore store_;
  model::Calibration live_;
  calibration::Result calibrated_;          // of the last step that solved the whole drive
  std::map<model::NodeId, int> suspicion_;  // consecutive steps that found the anchor elsewhere
  std::map<model::NodeId, double> moved_m_;
  std::future<calibration::LearningStep> solving_;
  double next_step_s_ = -std::numeric_limits<double>::infinity();
  double next_places_s_ = -std::numeric_limits<double>::infinity();
  double begin_s_ = std::numeric_limits<double>::quiet_NaN();
  std::size_t solved_segments_ = 0;
  std::size_t steps_ = 0;
  std::vector<std::string> news_;
};

}  // namespace groma::daemon
