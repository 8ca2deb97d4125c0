#include "host/calibration/learning.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <utility>

#include "host/calibration/verdict.hpp"
#include "host/model/pose.hpp"
#include "host/model/samples.hpp"

namespace groma::calibration {
namespace {

template <typename Sample>
void thin(std::vector<Sample>& samples, std::size_t most) {
  if (samples.size() <= most) return;
  std::vector<Sample> kept;
  kept.reserve(most);
  for (std::size_t i = 0; i < most; ++i) kept.push_back(samples[i * samples.size() / most]);
  samples = std::move(kept);
}

// Keeps at most `pair_most` ranges of each pair, spread evenly in time, and `most` of all pairs.
void thin_pairs(std::vector<model::RangeSample>& ranges, std::size_t pair_most, std::size_t most) {
  std::map<std::pair<model::NodeId, model::NodeId>, std::vector<model::RangeSample>> pairs;
  for (const model::RangeSample& range : ranges) pairs[{range.tag_id, range.anchor_id}].push_back(range);
  if (pairs.empty()) return;
  const std::size_t share = std::clamp<std::size_t>(most / pairs.size(), 1, pair_most);
  ranges.clear();
  for (auto& [key, list] : pairs) {
    thin(list, share);
    ranges.insert(ranges.end(), list.begin(), list.end());
  }
  thin(ranges, most);
  model::sort_ranges(ranges);
}

bool is_usable(double t_s) noexcept {
  return std::abs(t_s) < 1e12;  // false for NaN
}

// Largest coverage of an anchor whose verdict does not allow use: any value below 1.
constexpr double kAlmost = 0.99;
// Ranges per anchor and step. Most ranges of a robot that is stationary for long are redundant. By hand; in
// simulation 1800 of 6000 cost 4 % of RMSE, 900 cost 8 % (MeasurementChoice.ADriveOfTenTimesTheRanges...).
constexpr std::size_t kMostAnchorRanges = 4000;

Drive drive_of(const DriveStore::Samples& samples, const LearningInput& input) {
  return {.ranges = samples.ranges,
          .poses = samples.poses,
          .tags = input.tags,
          .surface = &input.surface,
          .priors = input.priors};
}

}  // namespace

std::int64_t DriveStore::index_of(double t_s) const {
  return static_cast<std::int64_t>(std::floor(t_s / limits_.segment_s));
}

void DriveStore::add(const model::RangeSample& range) {
  if (!is_usable(range.t_s)) return;
  reach(range.t_s);
  const auto open = open_.try_emplace(index_of(range.t_s)).first;
  // Far more than are kept: further ones add nothing.
  if (open->second.ranges.size() < 16 * limits_.segment_ranges) open->second.ranges.push_back(range);
}

void DriveStore::add(const model::PoseSample& pose) {
  if (!is_usable(pose.t_s)) return;
  reach(pose.t_s);
  poses_.push_back(pose);
}

void DriveStore::reach(double t_s) {
  if (any_ && t_s < last_s_ - kMaxDelay_s) {
    return;  // reopens its segment, which closes with the next one
  }
  last_s_ = any_ ? std::max(last_s_, t_s) : t_s;
  any_ = true;
  while (!open_.empty() &&
         static_cast<double>(open_.begin()->first + 1) * limits_.segment_s + kMaxDelay_s <= last_s_) {
    close_first();
  }
  const double keep_from_s = last_s_ - 2.0 * (limits_.segment_s + kMaxDelay_s);
  if (!poses_.empty() && poses_.front().t_s < keep_from_s - limits_.segment_s) {
    std::erase_if(poses_, [keep_from_s](const auto& pose) { return pose.t_s < keep_from_s; });
  }
}

void DriveStore::close() {
  while (!open_.empty()) close_first();
}

void DriveStore::clear() {
  *this = DriveStore(limits_);
}

void DriveStore::forget(model::NodeId anchor, double before_s) {
  forgotten_[anchor] = before_s;
}

void DriveStore::close_first() {
  Segment segment = std::move(open_.begin()->second);
  segment.index = open_.begin()->first;
  open_.erase(open_.begin());
  thin_pairs(segment.ranges, limits_.pair_ranges, limits_.segment_ranges);

  const double begin_s = static_cast<double>(segment.index) * limits_.segment_s;
  const double end_s = begin_s + limits_.segment_s;
  const auto earlier = [](const model::PoseSample& a, const model::PoseSample& b) { return a.t_s < b.t_s; };
  std::stable_sort(poses_.begin(), poses_.end(), earlier);
  auto from = std::lower_bound(poses_.begin(), poses_.end(), model::PoseSample{.t_s = begin_s}, earlier);
  auto to = std::lower_bound(poses_.begin(), poses_.end(), model::PoseSample{.t_s = end_s}, earlier);
  if (from != poses_.begin()) --from;
  if (to != poses_.end()) ++to;
  segment.poses.assign(from, to);
  if (segment.ranges.empty() || segment.poses.size() < 2) return;
  thin(segment.poses, limits_.segment_poses);
  const model::PoseSample& middle = segment.poses[segment.poses.size() / 2];
  segment.place = {middle.x_m, middle.y_m, middle.z_m, middle.yaw_rad};

  ++closed_;
  const auto shared = std::make_shared<const Segment>(std::move(segment));
  const auto place = std::upper_bound(kept_.begin(), kept_.end(), shared->index,
                                      [](std::int64_t index, const auto& s) { return index < s->index; });
  kept_.insert(place, shared);
  recent_.push_back(shared);
  if (recent_.size() > limits_.recent_segments) recent_.erase(recent_.begin());
  if (kept_.size() > limits_.segments) make_room();
}

// Drops the older of the two segments whose places are closest to each other.
void DriveStore::make_room() {
  std::size_t redundant = 0;
  double least = std::numeric_limits<double>::infinity();
  for (std::size_t i = 0; i + 1 < kept_.size(); ++i) {
    for (std::size_t j = i + 1; j < kept_.size(); ++j) {
      Eigen::Vector4d apart = kept_[j]->place - kept_[i]->place;
      apart(3) = model::wrap_angle(apart(3));
      const double distance = apart.squaredNorm();
      if (distance < least) {
        least = distance;
        redundant = i;
      }
    }
  }
  kept_.erase(kept_.begin() + static_cast<std::ptrdiff_t>(redundant));
}

DriveStore::Snapshot DriveStore::places() const {
  Snapshot out;
  out.segment_s_ = limits_.segment_s;
  out.segments_ = kept_;
  out.forgotten_ = forgotten_;
  return out;
}

DriveStore::Snapshot DriveStore::recent() const {
  Snapshot out = places();
  out.segments_ = recent_;
  std::stable_sort(out.segments_.begin(), out.segments_.end(),
                   [](const auto& a, const auto& b) { return a->index < b->index; });
  return out;
}

DriveStore::Samples DriveStore::Snapshot::samples() const {
  Samples out;
  double shift_s = 0.0;
  const Segment* before = nullptr;
  for (const auto& segment : segments_) {
    if (before != nullptr) {
      const double gap_s = static_cast<double>(segment->index - before->index - 1) * segment_s_;
      if (gap_s > kGap_s) shift_s += gap_s - kGap_s;
    }
    before = segment.get();
    for (model::RangeSample range : segment->ranges) {
      const auto forgotten = forgotten_.find(range.anchor_id);
      if (forgotten != forgotten_.end() && range.t_s < forgotten->second) continue;
      range.t_s -= shift_s;
      out.ranges.push_back(range);
    }
    for (model::PoseSample pose : segment->poses) {
      pose.t_s -= shift_s;
      out.poses.push_back(pose);
    }
  }
  // Neighbouring segments have poses in common.
  model::sort_poses(out.poses);
  return out;
}

LearningStep learn(const LearningInput& input) {
  LearningStep step;
  if (input.places) {
    step.samples = input.places->samples();
    step.calibrated = calibrate(drive_of(step.samples, input), {.most_anchor_ranges = kMostAnchorRanges});
    step.calibrated->fitted.clear();
  }
  if (input.live.anchors.empty() || input.recent.segments() < kMinRecheckSegments) return step;
  const DriveStore::Samples samples = input.recent.samples();
  model::Calibration recent = calibrate(drive_of(samples, input), {.earlier = &input.live}).calibration;
  // Too few ranges, or NLOS ranges alone, do not show where the anchor is.
  std::erase_if(recent.anchors, [](const model::AnchorCalibration& anchor) {
    return anchor.verdict == model::AnchorVerdict::kNoData ||
           anchor.verdict == model::AnchorVerdict::kNeverLos;
  });
  step.rechecked = compare(input.live, recent).anchors;
  return step;
}

bool carries(const model::AnchorCalibration& anchor) noexcept {
  return model::has_position(anchor) && model::is_usable(anchor.verdict);
}

double coverage(const model::AnchorCalibration& anchor) {
  if (carries(anchor)) return 1.0;
  if (!model::has_position(anchor)) return 0.0;
  double share = std::min(kAlmost, static_cast<double>(anchor.ranges_used) / static_cast<double>(kMinRanges));
  const double variance_m2 = std::max(anchor.covariance(0, 0), anchor.covariance(1, 1));
  if (variance_m2 > 0.0) share = std::min(share, kWeakSigma_m * kWeakSigma_m / variance_m2);
  return share;
}

}  // namespace groma::calibration
