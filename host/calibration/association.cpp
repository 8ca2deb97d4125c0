#include "host/calibration/association.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <map>
#include <optional>
#include <utility>

#include "host/model/ablation.hpp"
#include "host/model/samples.hpp"

namespace groma::calibration {
namespace {

// A longer two-way range is a wrapped timestamp, not a distance. By hand: beyond the reach of the radios.
constexpr double kMaxRange_m = 1000.0;
// By hand: at 1 m/s^2, linear interpolation over the gap is off by up to gap^2/8 = 0.011 m.
constexpr double kMaxPoseGap_s = 0.3;

bool is_finite(const model::PoseSample& pose) noexcept {
  return std::isfinite(pose.t_s) && std::isfinite(pose.x_m) && std::isfinite(pose.y_m) &&
         std::isfinite(pose.z_m) && std::isfinite(pose.yaw_rad);
}

bool is_range(const model::RangeSample& sample) noexcept {
  return std::isfinite(sample.t_s) && sample.range_m > 0.0 && sample.range_m <= kMaxRange_m;
}

std::vector<model::PoseSample> clean_poses(std::span<const model::PoseSample> poses) {
  std::vector<model::PoseSample> out;
  out.reserve(poses.size());
  std::copy_if(poses.begin(), poses.end(), std::back_inserter(out), is_finite);
  model::sort_poses(out);
  for (model::PoseSample& pose : out) {
    if (pose.covariance && !model::is_covariance(*pose.covariance)) pose.covariance.reset();
    if (model::is_ablated(model::Mechanism::kCalibrationKnots)) pose.covariance.reset();
  }
  return out;
}

double blend_angle(double from_rad, double to_rad, double fraction) noexcept {
  return from_rad + fraction * model::wrap_angle(to_rad - from_rad);
}

// Covariance of an antenna's x and y, as in Observation: M C M^T with M = [I, yaw_arm].
Eigen::Vector3f antenna_spread(const Eigen::Matrix3d& covariance, const Eigen::Vector2d& yaw_arm_m) noexcept {
  Eigen::Matrix<double, 2, 3> by_pose;
  by_pose << Eigen::Matrix2d::Identity(), yaw_arm_m;
  const Eigen::Matrix2d spread = by_pose * covariance * by_pose.transpose();
  return Eigen::Vector3d(spread(0, 0), spread(0, 1), spread(1, 1)).cast<float>();
}

// The observation of a range; none outside the poses or in a gap longer than kMaxPoseGap_s. Tag and index are
// not set.
std::optional<Observation> observe(const model::RangeSample& sample, const Eigen::Vector3d& lever_arm_m,
                                   std::span<const model::PoseSample> poses, const model::Surface& surface,
                                   HeightSource height) {
  if (poses.size() < 2) return std::nullopt;
  const auto next =
      std::lower_bound(poses.begin() + 1, poses.end() - 1, sample.t_s,
                       [](const model::PoseSample& pose, double t_s) { return pose.t_s < t_s; });
  const model::PoseSample& from = *(next - 1);
  const model::PoseSample& to = *next;
  const double gap_s = to.t_s - from.t_s;
  if (sample.t_s < from.t_s || sample.t_s > to.t_s) return std::nullopt;
  if (gap_s > kMaxPoseGap_s) return std::nullopt;
  const double fraction = (sample.t_s - from.t_s) / gap_s;
  const model::RigidPose pose = interpolate_pose(from, to, fraction, surface, height);
  const Eigen::Vector3d arm_m = pose.rotation * lever_arm_m;  // R_WR r_RS of eq. (12)
  Observation row{.t_s = sample.t_s, .range_m = sample.range_m, .tag_m = pose.position_m + arm_m};
  row.yaw_arm_m = {-arm_m.y(), arm_m.x()};
  row.attitude = Eigen::Quaterniond(pose.rotation).cast<float>();
  if (from.covariance && to.covariance) {
    const Eigen::Matrix3d covariance =
        (1.0 - fraction) * model::to_matrix(*from.covariance) + fraction * model::to_matrix(*to.covariance);
    row.pose_spread_m2 = antenna_spread(covariance, row.yaw_arm_m);
  }
  row.velocity_mps = Eigen::Vector3d(to.x_m - from.x_m, to.y_m - from.y_m, to.z_m - from.z_m) / gap_s;
  row.velocity_mps.head<2>() += model::wrap_angle(to.yaw_rad - from.yaw_rad) / gap_s * row.yaw_arm_m;
  row.power_class = model::power_class(sample);
  return row;
}

}  // namespace

model::RigidPose interpolate_pose(const model::PoseSample& from, const model::PoseSample& to, double fraction,
                                  const model::Surface& surface, HeightSource height) noexcept {
  const double x_m = from.x_m + fraction * (to.x_m - from.x_m);
  const double y_m = from.y_m + fraction * (to.y_m - from.y_m);
  const double yaw_rad = blend_angle(from.yaw_rad, to.yaw_rad, fraction);
  const double roll_rad = blend_angle(from.roll_rad, to.roll_rad, fraction);
  const double pitch_rad = blend_angle(from.pitch_rad, to.pitch_rad, fraction);
  const bool roll_known = std::isfinite(roll_rad);
  const bool pitch_known = std::isfinite(pitch_rad);

  model::RigidPose pose;
  pose.position_m = {x_m, y_m, from.z_m + fraction * (to.z_m - from.z_m)};
  if (roll_known && pitch_known && height == HeightSource::kPose) {
    pose.rotation = model::rotation_from_zyx(yaw_rad, pitch_rad, roll_rad);
    return pose;
  }
  const model::SurfacePoint ground = surface.at(x_m, y_m, surface.nearest(x_m, y_m, pose.position_m.z()));
  if (height == HeightSource::kSurface) pose.position_m.z() = ground.z_m;
  if (!roll_known && !pitch_known) {
    const double c = std::cos(yaw_rad);
    const double s = std::sin(yaw_rad);
    Eigen::Matrix3d heading;
    heading << c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0;
    pose.rotation = model::surface_rotation(ground.gradient) * heading;
    return pose;
  }
  // With a ZYX yaw, the slope ahead gives the pitch and the slope to the left gives the roll of a robot on
  // the ground.
  const double slope_ahead =
      ground.gradient.x() * std::cos(yaw_rad) + ground.gradient.y() * std::sin(yaw_rad);
  const double slope_left = ground.gradient.y() * std::cos(yaw_rad) - ground.gradient.x() * std::sin(yaw_rad);
  const double ground_pitch_rad = -std::atan(slope_ahead);
  const double ground_roll_rad = std::atan(slope_left * std::cos(ground_pitch_rad));
  pose.rotation = model::rotation_from_zyx(yaw_rad, pitch_known ? pitch_rad : ground_pitch_rad,
                                           roll_known ? roll_rad : ground_roll_rad);
  return pose;
}

Association associate(const Drive& drive, HeightSource height) {
  Association out;
  out.tags.assign(drive.tags.begin(), drive.tags.end());
  std::erase_if(out.tags, [](const model::Tag& tag) { return !tag.lever_arm_m.allFinite(); });
  const auto smaller_id = [](const auto& a, const auto& b) { return a.id < b.id; };
  std::stable_sort(out.tags.begin(), out.tags.end(), smaller_id);
  const auto same_id = [](const auto& a, const auto& b) { return a.id == b.id; };
  out.tags.erase(std::unique(out.tags.begin(), out.tags.end(), same_id), out.tags.end());

  std::map<model::NodeId, std::size_t> count;
  for (const model::RangeSample& sample : drive.ranges) ++count[sample.anchor_id];
  std::map<model::NodeId, std::size_t> index;
  for (const auto& [id, n] : count) {
    index[id] = out.anchors.size();
    out.anchors.push_back({.id = id});
    out.anchors.back().rows.reserve(n);
  }

  const model::Surface flat;
  const model::Surface& surface = drive.surface != nullptr ? *drive.surface : flat;
  const std::vector<model::PoseSample> poses = clean_poses(drive.poses);
  for (const model::PoseSample& pose : poses) {
    if (pose.covariance)
      out.pose_spreads.push_back({.t_s = pose.t_s, .covariance = model::to_matrix(*pose.covariance)});
  }
  for (const model::RangeSample& sample : drive.ranges) {
    AnchorObservations& anchor = out.anchors[index.at(sample.anchor_id)];
    const auto tag = std::lower_bound(out.tags.begin(), out.tags.end(), sample.tag_id,
                                      [](const model::Tag& a, model::NodeId id) { return a.id < id; });
    const bool known_tag = tag != out.tags.end() && tag->id == sample.tag_id;
    std::optional<Observation> row;
    if (known_tag && is_range(sample)) row = observe(sample, tag->lever_arm_m, poses, surface, height);
    if (!row) {
      ++anchor.rejected;
      continue;
    }
    row->tag = static_cast<std::uint32_t>(tag - out.tags.begin());
    row->index = static_cast<std::uint32_t>(anchor.rows.size());
    anchor.rows.push_back(*row);
  }
  return out;
}

std::vector<Observation> spread_along_the_way(std::span<const Observation> rows, std::size_t tag_count,
                                              std::size_t max_rows_per_tag) {
  struct Way {
    std::size_t rows = 0;
    double length_m = 0.0;
    const Observation* last = nullptr;
    double walked_m = 0.0;  // so far; spent_m of it by the observations taken
    double spent_m = 0.0;
  };
  std::vector<Way> ways(tag_count);
  // Adds a millimetre per observation, so that a stationary robot has a path too.
  const auto step_to = [](const Observation& row, Way& way) {
    const Observation* last = std::exchange(way.last, &row);
    return 1e-3 + (last != nullptr ? (row.tag_m - last->tag_m).norm() : 0.0);
  };
  for (const Observation& row : rows) {
    ++ways[row.tag].rows;
    ways[row.tag].length_m += step_to(row, ways[row.tag]);
  }
  for (Way& way : ways) way.last = nullptr;
  std::vector<Observation> out;
  out.reserve(std::min(rows.size(), tag_count * max_rows_per_tag));
  for (const Observation& row : rows) {
    Way& way = ways[row.tag];
    way.walked_m += step_to(row, way);
    const double step_m = way.length_m / static_cast<double>(max_rows_per_tag);
    if (way.rows > max_rows_per_tag && way.walked_m < way.spent_m + step_m) continue;
    way.spent_m = std::max(way.spent_m + step_m, way.walked_m - step_m);
    out.push_back(row);
  }
  return out;
}

double height_disagreement_m(const Drive& drive) noexcept {
  if (drive.surface == nullptr) return 0.0;
  double square_m2 = 0.0;
  std::size_t n = 0;
  for (const model::PoseSample& pose : drive.poses) {
    if (!is_finite(pose)) continue;
    const int chart = drive.surface->nearest(pose.x_m, pose.y_m, pose.z_m);
    const double difference_m = pose.z_m - drive.surface->at(pose.x_m, pose.y_m, chart).z_m;
    square_m2 += difference_m * difference_m;
    ++n;
  }
  return n > 0 ? std::sqrt(square_m2 / static_cast<double>(n)) : 0.0;
}

}  // namespace groma::calibration
