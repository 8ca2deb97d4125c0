#include "host/daemon/calibration_drive.hpp"

#include <algorithm>
#include <tuple>
#include <utility>

#include "host/daemon/sample_digest.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
CalibrationDrive::CalibrationDrive(std::vector<model::Tag> tags, model::Surface surface,
                                   model::RangePriors priors)
    : tags_(std::move(tags)), surface_(std::move(surface)), priors_(priors) {}

void CalibrationDrive::on_range(const model::RangeSample& range) {
  const bool known =
      std::any_of(tags_.begin(), tags_.end(), [&](const model::Tag& tag) { return tag.id == range.tag_id; });
  if (!known) {
    ++unknown_tags_;
  } else if (ranges_.size() < kMaxRanges) {
    ranges_.push_back(range);
  }
}

void CalibrationDrive::on_pose_prior(const model::PoseSample& pose) {
  if (poses_.size() < kMaxPoses) poses_.push_back(pose);
}

void CalibrationDrive::on_clock_set() {
  ranges_.clear();
  poses_.clear();
}

double CalibrationDrive::duration_s() const noexcept {
  return poses_.empty() ? 0.0 : poses_.back().t_s - poses_.front().t_s;
}

calibration::Result CalibrationDrive::solve(const calibration::Options& options) {
  std::stable_sort(ranges_.begin(), ranges_.end(), [](const auto& a, const auto& b) {
    return std::tie(a.t_s, a.tag_id, a.anchor_id) < std::tie(b.t_s, b.tag_id, b.anchor_id);
  });
  std::stable_sort(poses_.begin(), poses_.end(), [](const auto& a, const auto& b) { return a.t_s < b.t_s; });
  // A pose told twice tells nothing new, and an interval of no length could not be interpolated.
  const auto repeated =
      std::unique(poses_.begin(), poses_.end(), [](const auto& a, const auto& b) { return a.t_s == b.t_s; });
  poses_.erase(repeated, poses_.end());

  const calibration::Drive drive{.ranges = ranges_,
                                 .poses = poses_,
                                 .tags = tags_,
                                 .surface = &surface_,
                                 .priors = priors_,
                                 .anchor_ranges = {},
                                 .known_anchors = {}};
  calibration::Result result = calibration::calibrate(drive, options);
  result.calibration.input_sha256 = sample_digest(ranges_, poses_);
  result.calibration.program_version = io::program_version();
  return result;
}

}  // namespace groma::daemon
