// Calibration while driving: the whole of what the store kept is solved as one drive, and the anchors in use
// are looked for where they are said to be.
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

struct DriveStoreLimits {
  double segment_s = 1.0;            // the drive is kept and let go of in pieces of this length
  std::size_t segments = 600;        // that are kept for their places
  std::size_t recent_segments = 60;  // the last ones, whatever their places
  std::size_t pair_ranges = 4;       // of one pair in a segment
  std::size_t segment_ranges = 256;  // of all pairs in a segment
  std::size_t segment_poses = 100;
};

class DriveStore {
 public:
  explicit DriveStore(const DriveStoreLimits& limits = {}) : limits_(limits) {}

  // In the order of time, late ones by kLateness_s at most.
  static constexpr double kLateness_s = 1.0;
  void add(const model::RangeSample& range);
  void add(const model::PoseSample& pose);
  // Takes in what is still open: the drive is over, or what is there has to do.
  void close();
  void clear();

  // Ranges to this anchor before t_s no longer count: it was moved.
  void forget(model::NodeId anchor, double before_s);

  // Samples by time, as calibrate() takes them. Where a stretch of the drive was let go of, the times after
  // it are moved up to kGap_s behind it: poses before and after hang together no more than that.
  static constexpr double kGap_s = 5.0;
  struct Samples {
    std::vector<model::RangeSample> ranges;
    std::vector<model::PoseSample> poses;
  };

  // What the store has at one instant; cheap to take and to copy, and untouched by what comes later.
  class Snapshot {
   public:
    [[nodiscard]] Samples samples() const;
    [[nodiscard]] std::size_t segments() const noexcept { return segments_.size(); }

   private:
    friend class DriveStore;
    struct Segment {
      std::int64_t index = 0;                           // t_s over segment_s
      Eigen::Vector4d place = Eigen::Vector4d::Zero();  // x, y, z in m; a metre a radian of yaw
      std::vector<model::RangeSample> ranges;
      std::vector<model::PoseSample> poses;  // and the one before, and the one after
    };
    double segment_s_ = 1.0;
    std::vector<std::shared_ptr<const Segment>> segments_;  // by index
    std::map<model::NodeId, double> forgotten_;
  };
  [[nodiscard]] Snapshot places() const;
  [[nodiscard]] Snapshot recent() const;

  // Closed segments so far, since the last clear(): a measure of how much came.
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
  std::vector<model::PoseSample> poses_;  // of the last few seconds, as they came
  std::vector<std::shared_ptr<const Segment>> kept_;
  std::vector<std::shared_ptr<const Segment>> recent_;
  std::map<model::NodeId, double> forgotten_;
  std::size_t closed_ = 0;
  double last_s_ = 0.0;
  bool any_ = false;
};

struct LearningInput {
  std::optional<DriveStore::Snapshot> places;  // none: nothing is learnt in this step
  DriveStore::Snapshot recent;
  model::Calibration live;  // anchors in use
  std::vector<model::Tag> tags;
  model::Surface surface;
  model::RangePriors priors;
};

struct LearningStep {
  std::optional<Result> learnt;  // from all places, where they were given; its fitted ranges are left out
  DriveStore::Samples samples;   // that it was learnt from
  std::vector<AnchorChange>
      rechecked;  // anchors in use against the last of the drive; none as long as it is short
};

// Fewer segments do not tell whether an anchor was moved.
inline constexpr std::size_t kMinRecheckSegments = 20;

// As calibrate() of the samples that the store has. Its time and memory are bounded by the store's limits.
[[nodiscard]] LearningStep learn(const LearningInput& input);

// How much of what an anchor needs is there, 0 to 1: 1 once its verdict lets it be used; until then the least
// of its share of ranges and of the information (1/sigma^2) that the verdict asks for.
[[nodiscard]] double coverage(const model::AnchorCalibration& anchor);

// Whether a filter may use the anchor.
[[nodiscard]] bool carries(const model::AnchorCalibration& anchor) noexcept;

}  // namespace groma::calibration
