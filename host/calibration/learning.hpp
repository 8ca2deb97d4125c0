// Calibration while driving: solves all that the drive store holds as one drive, and checks whether the
// anchors in use are still where the live calibration has them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/calibrate.hpp"
#include "host/calibration/comparison.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// By hand. With them one step over a drive of 1200 s takes 0.45 s of CPU time (docs/measurements.md).
struct DriveStoreLimits {
  double segment_s = 1.0;            // the drive is stored and dropped in segments of this length
  std::size_t segments = 600;        // kept for the places they cover
  std::size_t recent_segments = 60;  // the latest ones, wherever they are
  std::size_t pair_ranges = 4;       // per pair and segment
  std::size_t segment_ranges = 256;  // per segment
  std::size_t segment_poses = 100;
};

class DriveStore {
 public:
  explicit DriveStore(const DriveStoreLimits& limits = {}) : limits_(limits) {}

  // Samples come in time order; one may be late by kMaxDelay_s at most (by hand).
  static constexpr double kMaxDelay_s = 1.0;
  void add(const model::RangeSample& range);
  void add(const model::PoseSample& pose);
  // Closes all open segments: at the end of the drive, or when the samples so far have to do.
  void close();
  void clear();

  // Ignores ranges to this anchor before `before_s`, because it was moved.
  void forget(model::NodeId anchor, double before_s);

  // Samples sorted by time, as calibrate() takes them. Where segments were dropped, the later times are
  // shifted so that a gap of kGap_s remains: pose errors before and after it count as that far apart.
  // By hand: short, to keep the knots of the drive's error close together.
  static constexpr double kGap_s = 5.0;
  struct Samples {
    std::vector<model::RangeSample> ranges;
    std::vector<model::PoseSample> poses;
  };

  // Content of the store at one instant. Cheap to take and to copy; later samples do not change it.
  class Snapshot {
   public:
    [[nodiscard]] Samples samples() const;
    [[nodiscard]] std::size_t segments() const noexcept { return segments_.size(); }

   private:
    friend class DriveStore;
    struct Segment {
      std::int64_t index = 0;                           // floor(t_s / segment_s)
      Eigen::Vector4d place = Eigen::Vector4d::Zero();  // x, y, z in m, yaw in rad
      std::vector<model::RangeSample> ranges;
      std::vector<model::PoseSample> poses;  // with one before and one after the segment
    };
    double segment_s_ = 1.0;
    std::vector<std::shared_ptr<const Segment>> segments_;  // ascending by index
    std::map<model::NodeId, double> forgotten_;
  };
  [[nodiscard]] Snapshot places() const;
  [[nodiscard]] Snapshot recent() const;

  // Segments with ranges and poses closed since the last clear().
  [[nodiscard]] std::size_t closed() const noexcept { return closed_; }
  [[nodiscard]] double last_s() const noexcept { return last_s_; }

 private:
  using Segment = Snapshot::Segment;

  void reach(double t_s);
  void close_first();
  void make_room();
  [[nodiscard]] std::int64_t index_of(double t_s) const;

  DriveStoreLimits limits_;
  std::map<std::int64_t, Segment> open_;
  std::vector<model::PoseSample> poses_;  // of the last few seconds, in order of arrival
  std::vector<std::shared_ptr<const Segment>> kept_;
  std::vector<std::shared_ptr<const Segment>> recent_;
  std::map<model::NodeId, double> forgotten_;
  std::size_t closed_ = 0;
  double last_s_ = 0.0;
  bool any_ = false;
};

struct LearningInput {
  std::optional<DriveStore::Snapshot> places;  // none: this step does not calibrate
  DriveStore::Snapshot recent;
  model::Calibration live;  // anchors in use
  std::vector<model::Tag> tags;
  model::Surface surface;
  model::RangePriors priors;
};

struct LearningStep {
  std::optional<Result> calibrated;     // calibration from `places`, if given; `fitted` is empty
  DriveStore::Samples samples;          // that `calibrated` was estimated from
  std::vector<AnchorChange> rechecked;  // anchors in use against the recent drive; empty while that is short
};

// Fewest recent segments that can show whether an anchor was moved. By hand;
// anchor_learner_test holds with it.
inline constexpr std::size_t kMinRecheckSegments = 20;

// Runs calibrate() on the store's samples. Time and memory are bounded by the store's limits.
[[nodiscard]] LearningStep learn(const LearningInput& input);

// Progress of an anchor, 0 to 1. It is 1 once the verdict allows use. Before that it is the smaller of two
// shares of what the verdict requires: of ranges, and of horizontal information (1/sigma^2).
[[nodiscard]] double coverage(const model::AnchorCalibration& anchor);

// Whether a filter may use the anchor.
[[nodiscard]] bool carries(const model::AnchorCalibration& anchor) noexcept;

}  // namespace groma::calibration
