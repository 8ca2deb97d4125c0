#include "host/diagnosis/anchor_scene.hpp"

#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <utility>

#include <Eigen/Eigenvalues>

#include "host/calibration/association.hpp"
#include "host/diagnosis/thresholds.hpp"

namespace groma::diagnosis {
namespace {

constexpr Eigen::Index kGamma = 3;
constexpr Eigen::Index kFirstBeta = 4;
constexpr std::size_t kMinPairRows = 20;

}  // namespace

AnchorScene::AnchorScene(const Data& data, std::size_t most_rows) : data_(data) {
  std::map<model::NodeId, std::uint32_t> tags;
  for (const model::Tag& tag : data.tags) tags.emplace(tag.id, static_cast<std::uint32_t>(tags.size()));
  std::map<std::pair<model::NodeId, model::NodeId>, std::vector<const model::RangeSample*>> pairs;
  for (const model::RangeSample& range : data.ranges) {
    if (tags.contains(range.tag_id)) pairs[{range.anchor_id, range.tag_id}].push_back(&range);
  }
  std::erase_if(pairs, [](const auto& pair) { return pair.second.size() < kMinPairRows; });
  const double begin_s = data.ranges.empty() ? 0.0 : data.ranges.front().t_s;
  const double slice_s =
      data.ranges.empty() ? 0.0 : std::max((data.ranges.back().t_s - begin_s) / kSlices, kShortestSlice_s);
  const std::size_t most = std::max(kMinPairRows, most_rows / std::max<std::size_t>(1, pairs.size()));
  for (const auto& [ids, ranges] : pairs) {
    if (anchors_.empty() || anchors_.back() != ids.first) anchors_.push_back(ids.first);
    const std::size_t count = std::min(most, ranges.size());
    for (std::size_t i = 0; i < count; ++i) {
      const model::RangeSample& range = *ranges[i * ranges.size() / count];
      const auto slice = static_cast<std::uint32_t>(std::min(
          static_cast<double>(kSlices) - 1.0, slice_s > 0.0 ? (range.t_s - begin_s) / slice_s : 0.0));
      rows_.push_back({range.t_s, range.range_m, static_cast<std::uint32_t>(anchors_.size() - 1),
                       tags.at(ids.second), static_cast<std::uint32_t>(anchors_.size() - 1), slice});
    }
  }
  const auto size = kFirstBeta + static_cast<Eigen::Index>(data.tags.size());
  prior_mean_.setZero(size);
  prior_sigma_.setConstant(size, std::numeric_limits<double>::infinity());
  prior_mean_(kGamma) = data.priors.gamma.mean;
  prior_sigma_(kGamma) = data.priors.gamma.sigma;
  prior_mean_.tail(size - kFirstBeta).setConstant(data.priors.beta_m.mean);
  prior_sigma_.tail(size - kFirstBeta).setConstant(data.priors.beta_m.sigma);
}

void AnchorScene::locate(const Mistake& mistake, std::vector<Eigen::Vector3d>& antennas_m) const {
  antennas_m.clear();
  for (const RangeRow& row : rows_) antennas_m.push_back(antenna_m(row, mistake));
}

Eigen::Vector3d AnchorScene::antenna_m(const RangeRow& row, const Mistake& mistake) const {
  const double t_s = mistake.clock.corrected_s(row.t_s);
  const std::vector<model::PoseSample>& poses = data_.poses;
  const auto next = std::upper_bound(poses.begin(), poses.end(), t_s,
                                     [](double t, const model::PoseSample& pose) { return t < pose.t_s; });
  if (next == poses.begin() || next == poses.end() || next->t_s - std::prev(next)->t_s > kMaxPoseGap_s)
    return Eigen::Vector3d::Constant(std::numeric_limits<double>::quiet_NaN());
  const model::PoseSample& from = *std::prev(next);
  const model::RigidPose pose =
      calibration::interpolate_pose(from, *next, (t_s - from.t_s) / (next->t_s - from.t_s), data_.surface);
  Eigen::Vector3d lever_arm_m = data_.tags[row.tag].lever_arm_m;
  if (row.tag == mistake.tag) lever_arm_m -= mistake.lever_arm_m;
  if (mistake.heading_rad != 0.0) {
    lever_arm_m.head<2>() = (Eigen::Rotation2Dd(-mistake.heading_rad) * lever_arm_m.head<2>()).eval();
  }
  return pose.position_m + pose.rotation * lever_arm_m;
}

double AnchorScene::predict_m(const RangeRow& row, const Eigen::Vector3d& antenna_m,
                              const Eigen::VectorXd& block, RangeDerivatives& out) const {
  const Eigen::Vector3d way_m = antenna_m - block.head<3>();
  const double distance_m = std::max(way_m.norm(), 1e-6);
  out.antenna = (block(kGamma) / distance_m) * way_m;
  out.block.setZero();
  out.block.head<3>() = -out.antenna;
  out.block(kGamma) = distance_m;
  out.block(kFirstBeta + row.tag) = 1.0;
  return block(kGamma) * distance_m + block(kFirstBeta + row.tag);
}

// The range's square is linear in the anchor's x, y and the square of its distance, if all antennas are at
// one height: iteratively reweighted least squares. The height above them has two signs, and an anchor beside
// a straight drive two sides.
std::vector<Eigen::VectorXd> AnchorScene::starts(std::span<const RangeRow> rows,
                                                 std::span<const Eigen::Vector3d> antennas_m) const {
  Eigen::Vector3d middle_m = Eigen::Vector3d::Zero();
  std::vector<std::size_t> known;
  for (std::size_t i = 0; i < rows.size(); ++i) {
    if (!antennas_m[i].allFinite()) continue;
    known.push_back(i);
    middle_m += antennas_m[i];
  }
  if (known.size() < kMinPairRows) return {prior_mean_};
  middle_m /= static_cast<double>(known.size());
  const auto n = static_cast<Eigen::Index>(known.size());
  Eigen::MatrixX3d j(n, 3);
  Eigen::VectorXd y(n);
  Eigen::VectorXd distance_m(n);
  Eigen::Matrix2d spread = Eigen::Matrix2d::Zero();
  for (Eigen::Index i = 0; i < n; ++i) {
    const std::size_t at = known[static_cast<std::size_t>(i)];
    const Eigen::Vector3d p = antennas_m[at] - middle_m;
    distance_m(i) = std::max(0.1, (rows[at].range_m - prior_mean_(kFirstBeta)) / prior_mean_(kGamma));
    j.row(i) << -2.0 * p.x(), -2.0 * p.y(), 1.0;
    y(i) = distance_m(i) * distance_m(i) - p.squaredNorm();
    spread += p.head<2>() * p.head<2>().transpose();
  }
  const Eigen::Vector3d solution = laterate(j, y, distance_m, 6);
  const double height_m = std::sqrt(std::max(0.1, solution.z() - solution.head<2>().squaredNorm()));
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> axes(spread);
  const Eigen::Vector2d across = axes.eigenvectors().col(0);
  std::vector<Eigen::VectorXd> out;
  for (const double side : {0.0, 2.0}) {
    for (const double up : {1.0, -1.0}) {
      Eigen::VectorXd& start = out.emplace_back(prior_mean_);
      start.head<2>() =
          middle_m.head<2>() + solution.head<2>() - side * across.dot(solution.head<2>()) * across;
      start(2) = middle_m.z() + up * std::min(height_m, 20.0);
    }
  }
  return out;
}

}  // namespace groma::diagnosis
