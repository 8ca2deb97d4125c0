#include "host/diagnosis/constellation.hpp"

#include <algorithm>
#include <cmath>
#include <span>
#include <utility>
#include <vector>

#include <Eigen/Geometry>

#include "host/diagnosis/anchor_scene.hpp"
#include "host/diagnosis/dead_reckoning.hpp"
#include "host/diagnosis/thresholds.hpp"

namespace groma::diagnosis {
namespace {

// By hand: long enough to see anchors from several sides, short enough for dead reckoning to drift by less
// than kReckonedNear_m.
constexpr double kPiece_s = 60.0;
constexpr std::size_t kPieces = 3;
constexpr std::size_t kPieceRows = 1500;
constexpr double kPosePeriod_s = 0.1;
// Anchors that a turn and a shift may be compared with; two determine them.
constexpr std::size_t kMinCompared = 4;
// Pairs of this many anchors with most ranges give turns and shifts to try, so that the cost is bounded.
constexpr std::size_t kMostTried = 12;

struct Place {
  model::NodeId id = 0;
  Eigen::Vector2d position_m = Eigen::Vector2d::Zero();
  double near_m = 0.0;
  std::size_t ranges = 0;
};

// By hand: dead reckoning and estimate are better than this, or where the anchor is far away, than a share of
// the way.
constexpr double kReckonedNear_m = 1.0;
constexpr double kReckonedNearShare = 0.07;

std::vector<Place> calibrated_places(const model::Calibration& calibration) {
  std::vector<Place> out;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (model::has_position(anchor)) out.push_back({anchor.id, anchor.position_m.head<2>()});
  }
  return out;
}

// The drive from begin_s on, with dead reckoning in place of poses.
Data piece_of(const Data& data, const DeadReckoning& path, double begin_s) {
  Data out{.tags = data.tags, .priors = data.priors, .surface = model::Plane(0.0, {0.0, 0.0, 1.0})};
  for (double t_s = begin_s; t_s <= begin_s + kPiece_s; t_s += kPosePeriod_s) {
    const DeadReckoning::Place place = path.at(t_s);
    if (!std::isfinite(place.heading_rad)) continue;
    out.poses.push_back({.t_s = t_s,
                         .x_m = place.position_m.x(),
                         .y_m = place.position_m.y(),
                         .z_m = 0.0,
                         .yaw_rad = place.heading_rad});
  }
  for (const model::RangeSample& range : data.ranges) {
    if (range.t_s >= begin_s && range.t_s < begin_s + kPiece_s) out.ranges.push_back(range);
  }
  return out;
}

// The anchors that a piece of the drive shows and that are calibrated; none if its ranges do not fit.
std::vector<Place> solved_places(const Data& piece, const model::Calibration& calibration) {
  const AnchorScene scene(piece, kPieceRows);
  if (scene.rows().empty()) return {};
  const RangeFit fit = fit_ranges(scene, {}, 20);
  if (2 * fit.rows < scene.rows().size() || fit.scale_m > kMostSigmas * piece.priors.sigma_m) return {};
  std::vector<Place> out(scene.block_count());
  for (const RangeRow& row : scene.rows()) {
    Place& place = out[row.block];
    place.near_m = std::max({place.near_m, kReckonedNear_m, kReckonedNearShare * row.range_m});
    ++place.ranges;
  }
  for (std::size_t i = 0; i < out.size(); ++i) {
    out[i].id = scene.anchors()[i];
    out[i].position_m = fit.blocks[i].head<2>();
  }
  std::erase_if(out, [&](const Place& place) {
    const model::AnchorCalibration* anchor = model::find_anchor(calibration, place.id);
    return anchor == nullptr || !model::has_position(*anchor);
  });
  std::stable_sort(out.begin(), out.end(),
                   [](const Place& a, const Place& b) { return a.ranges > b.ranges; });
  return out;
}

class Matcher {
 public:
  Matcher(std::span<const Place> solved, std::span<const Place> calibrated)
      : solved_(solved), calibrated_(calibrated), tried_(std::min(solved.size(), kMostTried)) {
    for (const Place& place : solved_) {
      own_.push_back(
          static_cast<std::size_t>(std::find_if(calibrated_.begin(), calibrated_.end(),
                                                [&](const Place& other) { return other.id == place.id; }) -
                                   calibrated_.begin()));
    }
  }

  [[nodiscard]] Constellation match() {
    for (std::size_t i = 0; i < tried_; ++i) {
      for (std::size_t k = i + 1; k < tried_; ++k) try_pair(i, k);
    }
    Constellation out{
        .anchors = solved_.size(), .own = most_own_, .own_mirrored = 0, .any = most_.any, .exchanged = {}};
    for (std::size_t i = 0; i < most_.at.size(); ++i) {
      if (most_.at[i] != kNone && most_.at[i] != own_[i])
        out.exchanged.emplace(solved_[i].id, calibrated_[most_.at[i]].id);
    }
    return out;
  }

 private:
  static constexpr std::size_t kNone = static_cast<std::size_t>(-1);
  struct Match {
    std::size_t any = 0;
    std::size_t own = 0;
    std::vector<std::size_t> at;
  };

  void try_pair(std::size_t i, std::size_t k) {
    const Eigen::Vector2d way_m = solved_[k].position_m - solved_[i].position_m;
    const double near_m = std::max(solved_[i].near_m, solved_[k].near_m);
    if (way_m.norm() < 2.0 * near_m) return;
    for (std::size_t p = 0; p < calibrated_.size(); ++p) {
      for (std::size_t q = 0; q < calibrated_.size(); ++q) {
        const Eigen::Vector2d wanted_m = calibrated_[q].position_m - calibrated_[p].position_m;
        if (p == q || std::abs(wanted_m.norm() - way_m.norm()) > near_m) continue;
        const double turn_rad = std::atan2(wanted_m.y(), wanted_m.x()) - std::atan2(way_m.y(), way_m.x());
        judge(Eigen::Translation2d(0.5 * (calibrated_[p].position_m + calibrated_[q].position_m)) *
              Eigen::Rotation2Dd(turn_rad) *
              Eigen::Translation2d(-0.5 * (solved_[i].position_m + solved_[k].position_m)));
      }
    }
  }

  void judge(const Eigen::Isometry2d& to_map) {
    Match match;
    std::vector<bool> is_taken(calibrated_.size(), false);
    for (std::size_t i = 0; i < solved_.size(); ++i) {
      const Eigen::Vector2d place_m = to_map * solved_[i].position_m;
      std::size_t nearest = kNone;
      double nearest_m = solved_[i].near_m;
      for (std::size_t p = 0; p < calibrated_.size(); ++p) {
        const double distance_m = (calibrated_[p].position_m - place_m).norm();
        // Where two are beside each other, it may be the right one.
        if (p == own_[i] && distance_m < solved_[i].near_m) {
          nearest = p;
          break;
        }
        if (is_taken[p] || !(distance_m < nearest_m)) continue;
        nearest = p;
        nearest_m = distance_m;
      }
      match.at.push_back(nearest);
      if (nearest == kNone) continue;
      is_taken[nearest] = true;
      ++match.any;
      if (nearest == own_[i]) ++match.own;
    }
    most_own_ = std::max(most_own_, match.own);
    // Of several, that in which fewest ids are wrong.
    if (std::pair(match.any, match.own) > std::pair(most_.any, most_.own)) most_ = std::move(match);
  }

  std::span<const Place> solved_;
  std::span<const Place> calibrated_;
  std::size_t tried_;
  std::vector<std::size_t> own_;  // index of each solved one in calibrated_
  Match most_;
  std::size_t most_own_ = 0;
};

}  // namespace

std::optional<Constellation> compare_constellation(const Data& data, const model::Calibration& calibration) {
  if (data.odometry.size() < 2 || data.ranges.empty()) return std::nullopt;
  const std::vector<Place> calibrated = calibrated_places(calibration);
  const DeadReckoning path(data.odometry, {});
  const double begin_s = data.odometry.front().t_s;
  const double last_s = std::max(begin_s, data.odometry.back().t_s - kPiece_s);
  std::optional<Constellation> best;
  for (std::size_t i = 0; i < kPieces; ++i) {
    const double share = static_cast<double>(i) / static_cast<double>(kPieces - 1);
    const Data piece = piece_of(data, path, begin_s + share * (last_s - begin_s));
    std::vector<Place> solved = solved_places(piece, calibration);
    if (solved.size() < kMinCompared) continue;
    Constellation found = Matcher(solved, calibrated).match();
    for (Place& place : solved) place.position_m.y() = -place.position_m.y();
    found.own_mirrored = Matcher(solved, calibrated).match().own;
    // Most anchors in place, of most.
    const auto placed = [](const Constellation& of) { return std::max(of.any, of.own_mirrored); };
    if (!best || placed(found) > placed(*best)) best = std::move(found);
  }
  return best;
}

}  // namespace groma::diagnosis
