// Learns anchors while the robot drives, and looks whether those in use are where they were. Solving has a
// thread of its own; whoever feeds the learner never waits for it.
#pragma once

#include <cstddef>
#include <future>
#include <limits>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/calibration/learning.hpp"
#include "host/daemon/measurement_sink.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

enum class AnchorState {
  kKnown,     // by an earlier calibration; in use
  kLearning,  // not yet good enough to be used
  kLive,      // learnt on this drive; in use
  kMoved,     // was in use, and is not where it was; learnt anew
};

// "known", "learning", "live" or "moved".
[[nodiscard]] std::string_view state_word(AnchorState state) noexcept;

// What a driver is told of an anchor.
struct AnchorProgress {
  model::NodeId id = 0;
  AnchorState state = AnchorState::kLearning;
  double coverage = 0.0;  // share of what is needed, 0 to 1; see calibration::coverage()
  model::AnchorVerdict verdict = model::AnchorVerdict::kNoData;
  std::string advice;
  std::size_t ranges_used = 0;
  std::optional<double> sigma_m;  // the larger of x and y
};

class AnchorLearner : public MeasurementSink {
 public:
  // Whose poses the anchors are learnt from.
  enum class Poses {
    kPriors,  // the robot's own, by on_pose_prior()
    kFilter,  // those of a filter that tracks by known anchors, by on_filter_pose()
  };
  struct Setup {
    std::vector<model::Tag> tags;
    model::Surface surface;
    model::RangePriors priors;
    model::Calibration earlier;  // its anchors are kept as they are, until one is found moved
    Poses poses = Poses::kPriors;
    calibration::DriveStoreLimits limits{};
    double step_s = 5.0;   // time of the drive between steps, at least; anchors in use are rechecked in each
    bool threaded = true;  // false: service() solves by itself, and the same drive gives the same result
  };
  // All places are solved anew when the drive is this much longer, or after so long at most.
  static constexpr double kLonger = 0.05;
  static constexpr double kMostBetween_s = 60.0;
  // An anchor has to be found elsewhere so often in a row.
  static constexpr int kMovedSteps = 3;
  // Anchors that are in use are replaced by better ones of a longer drive when a sigma has shrunk so much.
  static constexpr double kBetter = 0.75;

  explicit AnchorLearner(Setup setup);

  void on_odometry(const model::OdometrySample& /*row*/) override {}
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& pose) override;
  void on_clock_set() override;  // what was measured so far is let go of; what was learnt stays
  void on_filter_pose(const model::PoseSample& pose);

  // Starts a step that is due, and takes in one that is done. True if the anchors in use have changed.
  [[nodiscard]] bool service();
  // Waits for the step under way and solves all that came; for the end of a drive that is over.
  [[nodiscard]] bool finish();

  // Anchors in use, their verdict for the site, and the covariance of their frame.
  [[nodiscard]] const model::Calibration& live() const noexcept { return live_; }
  // Of all anchors that are in use or were heard, by id.
  [[nodiscard]] std::vector<AnchorProgress> progress() const;
  // One line for each event since the last call: what was learnt, what was found moved.
  [[nodiscard]] std::vector<std::string> take_news();
  [[nodiscard]] std::size_t steps() const noexcept { return steps_; }

 private:
  [[nodiscard]] calibration::LearningInput input(bool all_places) const;
  [[nodiscard]] bool take(calibration::LearningStep step, bool last);
  [[nodiscard]] bool take_out_moved(const std::vector<calibration::AnchorChange>& rechecked);
  [[nodiscard]] bool take_in_learnt(bool last);
  [[nodiscard]] bool is_earlier(model::NodeId id) const;

  Setup setup_;
  calibration::DriveStore store_;
  model::Calibration live_;
  calibration::Result learnt_;              // of the last step
  std::map<model::NodeId, int> suspicion_;  // steps in a row that found it elsewhere
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
