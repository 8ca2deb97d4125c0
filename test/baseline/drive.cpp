#include "test/baseline/drive.hpp"

#include <algorithm>
#include <cmath>
#include <limits>

#include "host/model/plausible.hpp"

namespace groma::baseline {

namespace {

// As the filter has them: the delay's change from drive to drive, and what nobody has measured.
constexpr double kRangeDelayChange_s = 0.005;
constexpr double kRangeDelaySigma_s = 0.01;
constexpr double kOdometryDelaySigma_s = 0.015;

// The heading on the surface of a pose that has roll and pitch is not its ZYX yaw.
model::PlanarPose start_pose(const model::Surface& surface, const model::PoseSample& prior) {
  model::PlanarPose out{prior.x_m, prior.y_m, prior.yaw_rad,
                        surface.nearest(prior.x_m, prior.y_m, prior.z_m)};
  if (!std::isfinite(prior.roll_rad) || !std::isfinite(prior.pitch_rad)) return out;
  const Eigen::Matrix3d tilt = model::surface_rotation(surface.at(prior.x_m, prior.y_m, out.chart).gradient);
  const Eigen::Matrix3d turn =
      tilt.transpose() * model::rotation_from_zyx(prior.yaw_rad, prior.pitch_rad, prior.roll_rad);
  out.theta_rad = std::atan2(turn(1, 0), turn(0, 0));
  return out;
}

bool is_chosen(const std::vector<model::NodeId>& ids, model::NodeId id) {
  return ids.empty() || std::find(ids.begin(), ids.end(), id) != ids.end();
}

double median_interval_s(const std::vector<model::OdometrySample>& odometry) {
  std::vector<double> intervals;
  for (std::size_t i = 1; i < odometry.size(); ++i)
    intervals.push_back(odometry[i].t_s - odometry[i - 1].t_s);
  if (intervals.empty()) return 0.02;
  const auto middle = intervals.begin() + std::ssize(intervals) / 2;
  std::nth_element(intervals.begin(), middle, intervals.end());
  return *middle;
}

}  // namespace

Site::Site(std::span<const model::Tag> tags, const model::Calibration& calibration)
    : tags_(tags.begin(), tags.end()), frame_covariance_(calibration.common_frame_covariance) {
  std::sort(tags_.begin(), tags_.end(), [](const auto& a, const auto& b) { return a.id < b.id; });
  std::vector<model::NodeId> ids;
  for (model::Tag& tag : tags_) {
    ids.push_back(tag.id);
    for (const model::TagCalibration& calibrated : calibration.tags) {
      if (calibrated.id == tag.id && calibrated.lever_arm) tag.lever_arm_m = calibrated.lever_arm->position_m;
    }
  }
  const Eigen::Index count = std::ssize(tags_);
  for (const model::AnchorCalibration& calibrated : calibration.anchors) {
    if (!model::has_position(calibrated)) continue;
    const Eigen::MatrixXd to = model::selection(ids, calibrated);
    const Eigen::MatrixXd whole = to * calibrated.covariance * to.transpose();
    SiteAnchor& anchor = anchors_.emplace_back();
    anchor.id = calibrated.id;
    anchor.values = to * model::values_of(calibrated);
    anchor.own_covariance = to * model::own_covariance(calibrated, frame_covariance_) * to.transpose();
    for (Eigen::Index tag = 0; tag < count; ++tag) {
      const auto indices = model::pair_indices(tag, count);
      Pair pair{.anchor = anchors_.size() - 1,
                .tag = static_cast<std::size_t>(tag),
                .anchor_m = anchor.values.head<3>(),
                .terms = model::terms_of(anchor.values, tag, count),
                .lever_arm_m = tags_[static_cast<std::size_t>(tag)].lever_arm_m,
                .covariance = whole(indices, indices)};
      for (const model::PairBias& bias : calibrated.pairs)
        pair.is_known = pair.is_known || bias.tag_id == ids[static_cast<std::size_t>(tag)];
      pairs_.push_back(pair);
    }
  }
}

const Pair* Site::find(model::NodeId tag_id, model::NodeId anchor_id) const noexcept {
  const auto anchor = std::find_if(anchors_.begin(), anchors_.end(),
                                   [anchor_id](const SiteAnchor& other) { return other.id == anchor_id; });
  const auto tag = std::find_if(tags_.begin(), tags_.end(),
                                [tag_id](const model::Tag& other) { return other.id == tag_id; });
  if (anchor == anchors_.end() || tag == tags_.end()) return nullptr;
  const auto row = static_cast<std::size_t>(anchor - anchors_.begin());
  return &pairs_[row * tags_.size() + static_cast<std::size_t>(tag - tags_.begin())];
}

std::optional<Drive> make_drive(const io::Dataset& dataset, const model::Surface& surface, const Site& site,
                                const model::Calibration& calibration, const DriveOptions& options) {
  const double from_s = options.from_s.value_or(-std::numeric_limits<double>::infinity());
  const double to_s = options.to_s.value_or(std::numeric_limits<double>::infinity());
  const auto prior =
      std::find_if(dataset.pose_prior.begin(), dataset.pose_prior.end(), [&](const model::PoseSample& pose) {
        return pose.t_s >= from_s && pose.t_s <= to_s && model::is_plausible(pose);
      });
  if (prior == dataset.pose_prior.end()) return std::nullopt;
  Drive drive{.surface = &surface,
              .site = &site,
              .start = {prior->t_s, start_pose(surface, *prior)},
              .odometry_noise = dataset.odometry_noise,
              .range_sigma_m = dataset.range_priors.sigma_m,
              .range_noise = {.white_sigma_m = dataset.range_priors.sigma_m},
              .range_delay_sigma_s = kRangeDelaySigma_s};
  if (calibration.range_noise) drive.range_noise = *calibration.range_noise;
  if (calibration.range_delay_sigma_s > 0.0) {
    drive.range_delay_s = calibration.range_delay_s;
    drive.range_delay_sigma_s = std::hypot(calibration.range_delay_sigma_s, kRangeDelayChange_s);
  }
  drive.range_delay_sigma_s = std::hypot(drive.range_delay_sigma_s, kOdometryDelaySigma_s);

  for (const model::OdometrySample& sample : dataset.odometry) {
    if (sample.t_s > to_s || !model::is_plausible(sample)) continue;
    if (sample.t_s <= drive.start.t_s && !drive.odometry.empty()) drive.odometry.clear();
    drive.odometry.push_back(sample);
  }
  if (drive.odometry.empty() || drive.odometry.back().t_s < drive.start.t_s) return std::nullopt;
  drive.odometry_interval_s = median_interval_s(drive.odometry);
  for (const model::RangeSample& sample : dataset.ranges) {
    const double t_s =
        calibration.range_clock ? calibration.range_clock->corrected_s(sample.t_s) : sample.t_s;
    if (t_s < drive.start.t_s || t_s > to_s) continue;
    if (!is_chosen(options.tags, sample.tag_id) || !is_chosen(options.anchors, sample.anchor_id)) continue;
    const Pair* pair = site.find(sample.tag_id, sample.anchor_id);
    if (pair == nullptr || !pair->is_known) {
      ++drive.unknown_ranges;
      continue;
    }
    drive.ranges.push_back({t_s, pair, sample.range_m});
  }
  std::stable_sort(drive.ranges.begin(), drive.ranges.end(),
                   [](const Range& a, const Range& b) { return a.t_s < b.t_s; });
  return drive;
}

}  // namespace groma::baseline
