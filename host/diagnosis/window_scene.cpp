#include "host/diagnosis/window_scene.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <numbers>
#include <utility>

#include <Eigen/Geometry>

#include "host/diagnosis/thinning.hpp"

namespace groma::diagnosis {
namespace {

// A clock and a yaw rate show by how the course changes within a window. At 0.5 m/s, 10 s raise the log
// likelihood of an offset of 0.1 s by a twentieth of what 60 s do. By hand: on this way dead reckoning drifts
// by less than the noise of a range, and robots turn.
constexpr double kWindowLength_m = 30.0;
constexpr double kShortestWindow_s = 10.0;
constexpr double kLongestWindow_s = 60.0;
// By hand: as many as a window needs to be placed well.
constexpr double kWindowRows = 40.0;
// A window with fewer ranges does not determine its place.
constexpr std::size_t kMinWindowRows = 12;
// By hand: a minute but for its ends. In less, slow NLOS errors of a few anchors look like a mistake (a drift
// on 30 s of a good drive).
constexpr double kLeastReckoned_s = 59.0;

// By hand: at 1 m/s^2 the way is off by a millimetre between two samples.
constexpr double kStep_s = 0.1;

// Pairs whose bias is less certain, such as those of surveyed anchors, would be explained by a mistake. By
// hand: a third of the lever arm that is named.
constexpr double kMostBetaSigma_m = 0.1;

// The drive divided into equal windows.
double window_length_s(const std::vector<model::OdometrySample>& odometry) {
  double way_m = 0.0;
  for (std::size_t i = 1; i < odometry.size(); ++i) {
    way_m +=
        std::hypot(odometry[i - 1].vx_mps, odometry[i - 1].vy_mps) * (odometry[i].t_s - odometry[i - 1].t_s);
  }
  const double duration_s = odometry.back().t_s - odometry.front().t_s;
  const double length_s =
      std::clamp(duration_s * kWindowLength_m / std::max(way_m, 1e-3), kShortestWindow_s, kLongestWindow_s);
  return duration_s / std::max(1.0, std::round(duration_s / length_s));
}

}  // namespace

WindowScene::WindowScene(const Data& data, const model::Calibration& calibration, std::size_t most_rows)
    : data_(data), odometry_(joined(data.odometry, kStep_s)) {
  prior_mean_.setZero(3);
  prior_sigma_.setConstant(3, std::numeric_limits<double>::infinity());
  if (data.odometry.size() < 2 || data.ranges.empty()) return;
  std::map<model::NodeId, std::uint32_t> tags;
  for (const model::Tag& tag : data.tags) tags.emplace(tag.id, static_cast<std::uint32_t>(tags.size()));
  std::map<std::pair<model::NodeId, model::NodeId>, std::uint32_t> pairs;
  const double begin_s = data.odometry.front().t_s;
  const double duration_s = data.odometry.back().t_s - begin_s;
  const double slice_s = std::max(duration_s / kSlices, kShortestSlice_s);
  const double length_s = window_length_s(data.odometry);
  // All ranges of some windows would fit best, but the windows have to show the whole drive.
  const double windows = std::max(1.0, std::round(duration_s / length_s));
  const double kept = std::min(windows, std::ceil(static_cast<double>(most_rows) / kWindowRows));
  const double share = kept / windows;
  const auto is_shown = [&](double window) {
    return std::floor((window + 1.0) * share) > std::floor(window * share);
  };
  const double share_of_ranges =
      static_cast<double>(most_rows) / std::max(1.0, share * static_cast<double>(data.ranges.size()));
  std::map<long, std::vector<RangeRow>> rows_of_windows;
  for (std::size_t i = 0; i < data.ranges.size(); ++i) {
    if (!is_kept(i, share_of_ranges)) continue;
    const model::RangeSample& range = data.ranges[i];
    if (range.t_s < begin_s || range.t_s >= data.odometry.back().t_s) continue;
    const double since_s = range.t_s - begin_s;
    const double window = std::floor(since_s / length_s);
    if (!is_shown(window)) continue;
    const model::AnchorCalibration* anchor = model::find_anchor(calibration, range.anchor_id);
    if (anchor == nullptr || !model::has_position(*anchor) || !tags.contains(range.tag_id)) continue;
    const auto bias = std::find_if(anchor->pairs.begin(), anchor->pairs.end(),
                                   [&](const model::PairBias& pair) { return pair.tag_id == range.tag_id; });
    if (bias == anchor->pairs.end()) continue;
    // A calibration may know a bias and a height together much better than each.
    if (!(bias->beta_sigma_m < kMostBetaSigma_m) && !anchor->held_out_rms_m) continue;
    const auto [pair, is_new] = pairs.try_emplace({range.anchor_id, range.tag_id}, pairs_.size());
    if (is_new) pairs_.push_back({anchor->position_m, model::values_of(*bias)});
    rows_of_windows[std::lround(window)].push_back(
        {range.t_s, range.range_m, 0, tags.at(range.tag_id), pair->second,
         static_cast<std::uint32_t>(std::min(kSlices - 1.0, since_s / slice_s))});
  }
  for (auto& [index, rows] : rows_of_windows) {
    if (rows.size() < kMinWindowRows) continue;
    for (RangeRow& row : rows) {
      row.block = static_cast<std::uint32_t>(windows_.size());
      rows_.push_back(row);
    }
    windows_.push_back(begin_s + length_s * static_cast<double>(index));
  }
  if (static_cast<double>(windows_.size()) * length_s < kLeastReckoned_s) rows_.clear();
}

const WindowScene::Motions& WindowScene::motions(const model::ClockError& clock,
                                                 const DeadReckoning::YawRateError& yaw_rate) const {
  const auto are_these = [&](const Motions& motions) {
    return motions.of_rows.size() == rows_.size() && motions.yaw_rate == yaw_rate &&
           motions.clock.offset_s == clock.offset_s && motions.clock.drift == clock.drift &&
           motions.clock.reference_s == clock.reference_s;
  };
  if (are_these(motions_)) return motions_;
  std::swap(motions_, former_motions_);
  if (are_these(motions_)) return motions_;
  motions_.clock = clock;
  motions_.yaw_rate = yaw_rate;
  motions_.of_rows.clear();
  const DeadReckoning path(odometry_, yaw_rate);
  std::vector<DeadReckoning::Place> begins;
  std::vector<Eigen::Matrix2d> back;
  for (const double begin_s : windows_) {
    begins.push_back(path.at(begin_s));
    back.push_back(Eigen::Rotation2Dd(-begins.back().heading_rad).toRotationMatrix());
  }
  for (const RangeRow& row : rows_) {
    const DeadReckoning::Place now = path.at(clock.corrected_s(row.t_s));
    const DeadReckoning::Place& begin = begins[row.block];
    motions_.of_rows.push_back({back[row.block] * (now.position_m - begin.position_m),
                                Eigen::Rotation2Dd(now.heading_rad - begin.heading_rad).toRotationMatrix()});
  }
  return motions_;
}

void WindowScene::locate(const Mistake& mistake, std::vector<Eigen::Vector3d>& antennas_m) const {
  const std::vector<Motion>& of_rows =
      motions(mistake.clock, {mistake.yaw_rate_scale, mistake.yaw_rate_bias_radps}).of_rows;
  antennas_m.clear();
  for (std::size_t i = 0; i < rows_.size(); ++i) {
    Eigen::Vector3d lever_arm_m = data_.tags[rows_[i].tag].lever_arm_m;
    if (rows_[i].tag == mistake.tag) lever_arm_m -= mistake.lever_arm_m;
    const Eigen::Vector2d place_m =
        of_rows[i].way_m / mistake.speed_scale + of_rows[i].turn * lever_arm_m.head<2>();
    antennas_m.emplace_back(place_m.x(), place_m.y(), lever_arm_m.z() - mistake.height_m);
  }
}

Eigen::Vector3d WindowScene::carried(const Eigen::Vector3d& pose, double from_s, double to_s) const {
  const DeadReckoning path(odometry_, {});
  const DeadReckoning::Place from = path.at(from_s);
  const DeadReckoning::Place to = path.at(to_s);
  const double turn_rad = pose.z() - from.heading_rad;
  const Eigen::Vector2d place_m =
      pose.head<2>() + Eigen::Rotation2Dd(turn_rad) * (to.position_m - from.position_m);
  return {place_m.x(), place_m.y(), to.heading_rad + turn_rad};
}

double WindowScene::predict_m(const RangeRow& row, const Eigen::Vector3d& antenna_m,
                              const Eigen::VectorXd& block, RangeDerivatives& out) const {
  const Pair& pair = pairs_[row.anchor];
  if (block(2) != turn_rad_) {
    turn_rad_ = block(2);
    turn_ = Eigen::Rotation2Dd(turn_rad_).toRotationMatrix();
  }
  const Eigen::Vector2d turned_m = turn_ * antenna_m.head<2>();
  const Eigen::Vector2d place_m = block.head<2>() + turned_m;
  const Eigen::Vector3d way_m =
      Eigen::Vector3d(place_m.x(), place_m.y(),
                      antenna_m.z() + data_.surface.height_m(place_m.x(), place_m.y(), 0)) -
      pair.anchor_m;
  const double distance_m = std::max(way_m.norm(), 1e-6);
  const double gamma = model::scale_of(pair.terms);
  const Eigen::Vector3d by = (gamma / distance_m) * way_m;
  out.antenna << turn_.transpose() * by.head<2>(), by.z();
  out.block << by.x(), by.y(), by.y() * turned_m.x() - by.x() * turned_m.y();
  return gamma * distance_m + model::offset_m(pair.terms);
}

// For each of some headings the squares of the ranges are linear in the window's x, y and their square.
std::vector<Eigen::VectorXd> WindowScene::starts(std::span<const RangeRow> rows,
                                                 std::span<const Eigen::Vector3d> antennas_m) const {
  constexpr int kHeadings = 6;
  std::vector<Eigen::VectorXd> out;
  const auto n = static_cast<Eigen::Index>(rows.size());
  Eigen::MatrixX3d j(n, 3);
  Eigen::VectorXd y(n);
  Eigen::VectorXd distance_m(n);
  for (int k = 0; k < kHeadings; ++k) {
    const double heading_rad = 2.0 * std::numbers::pi * k / kHeadings;
    for (Eigen::Index i = 0; i < n; ++i) {
      const auto index = static_cast<std::size_t>(i);
      const Pair& pair = pairs_[rows[index].anchor];
      Eigen::Vector3d q = antennas_m[index];
      if (!q.allFinite()) q.setZero();
      q.head<2>() = (Eigen::Rotation2Dd(heading_rad) * q.head<2>()).eval();
      q -= pair.anchor_m;
      q.z() += data_.surface.height_m(pair.anchor_m.x(), pair.anchor_m.y(), 0);
      distance_m(i) =
          std::max(0.1, (rows[index].range_m - model::offset_m(pair.terms)) / model::scale_of(pair.terms));
      j.row(i) << 2.0 * q.x(), 2.0 * q.y(), 1.0;
      y(i) = distance_m(i) * distance_m(i) - q.squaredNorm();
    }
    const Eigen::Vector3d solution = laterate(j, y, distance_m, 4);
    out.emplace_back(Eigen::Vector3d(solution.x(), solution.y(), heading_rad));
  }
  return out;
}

}  // namespace groma::diagnosis
