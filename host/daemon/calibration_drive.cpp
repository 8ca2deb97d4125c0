#include "host/daemon/calibration_drive.hpp"

#include <algorithm>
#include <bit>
#include <tuple>
#include <utility>

#include "host/io/input_file.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
namespace {

template <std::size_t kBytes>
void append_little_endian(std::string& out, std::uint64_t value) {
  for (std::size_t i = 0; i < kBytes; ++i) out.push_back(static_cast<char>(value >> (8 * i) & 0xFFU));
}

void append(std::string& out, double value) {
  append_little_endian<8>(out, std::bit_cast<std::uint64_t>(value));
}

std::string digest(const std::vector<model::RangeSample>& ranges,
                   const std::vector<model::PoseSample>& poses) {
  std::string bytes;
  for (const model::RangeSample& range : ranges) {
    append(bytes, range.t_s);
    append_little_endian<2>(bytes, range.tag_id);
    append_little_endian<2>(bytes, range.anchor_id);
    append(bytes, range.range_m);
  }
  for (const model::PoseSample& pose : poses) {
    for (const double value :
         {pose.t_s, pose.x_m, pose.y_m, pose.z_m, pose.yaw_rad, pose.roll_rad, pose.pitch_rad}) {
      append(bytes, value);
    }
  }
  return io::sha256(bytes);
}

}  // namespace

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
                                 .known_anchors = {}};
  calibration::Result result = calibration::calibrate(drive, options);
  result.calibration.input_sha256 = digest(ranges_, poses_);
  result.calibration.program_version = io::program_version();
  return result;
}

}  // namespace groma::daemon
