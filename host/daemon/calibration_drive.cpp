#include "host/daemon/calibration_drive.hpp"

#include <algorithm>
#include <utility>

#include "host/daemon/sample_digest.hpp"
#include "host/io/version.hpp"
#include "host/model/samples.hpp"

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
  model::sort_ranges(ranges_);
  model::sort_poses(poses_);
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
