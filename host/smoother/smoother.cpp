#include "host/smoother/smoother.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <map>
#include <utility>

#include <Eigen/Core>
#include <Eigen/Eigenvalues>

#include "host/filter/dead_reckoning.hpp"
#include "host/filter/odometry_gate.hpp"
#include "host/filter/propagation.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/pose.hpp"
#include "host/model/range_model.hpp"
#include "host/smoother/chain_problem.hpp"

namespace groma::smoother {
namespace {

constexpr int kMaxRounds = 50;  // by hand; a result that needs more is reported as not converged
// Levenberg-Marquardt damping of the common parameters: an anchor's height near that of the tags is far from
// linear. Numerics: the first damping, its factors after a better and after a worse step, and the share of
// the cost that is rounding. A step that lowers the cost by less than kConvergedCost is the last: 0.05
// sigmas.
constexpr double kFirstDamping = 10.0;
constexpr double kLessDamping = 0.3;
constexpr double kMoreDamping = 10.0;
constexpr double kCostRounding = 1e-9;
constexpr double kConvergedCost = 1e-3;
constexpr Eigen::Index kPose = 3;
// The error of an anchor's position acts on its ranges alike for as long as its direction stays: at 5 m, this
// way turns it by 22 degrees. With 1.5 m Smoothing.IsBetterThanTheFilterAndConsistent is overconfident; with
// 3 m the demo's second drives (simulated), seeds 1 to 20, are worse by 2 %.
constexpr double kMapLength_m = 2.0;

using model::square;

Eigen::Index tag_slot(const std::vector<model::Tag>& tags, model::NodeId id) noexcept {
  for (std::size_t slot = 0; slot < tags.size(); ++slot) {
    if (tags[slot].id == id) return static_cast<Eigen::Index>(slot);
  }
  return -1;
}

// Square root of a positive semidefinite covariance.
Eigen::MatrixXd root_of(const Eigen::MatrixXd& covariance) {
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(covariance);
  return eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0.0).cwiseSqrt().asDiagonal();
}

// Position and terms of an anchor, without the common frame.
struct Anchor {
  const model::AnchorCalibration* calibrated = nullptr;
  Eigen::VectorXd values;
  Eigen::MatrixXd root;  // of their covariance
  Eigen::Index at = -1;  // first index among the parameters common to all poses; -1: not estimated
};

// Parameters common to all poses: the odometry's scale and yaw-rate bias, the delay, then position and terms
// of each anchor that is estimated, then the lever arms, then the frame. They are whitened by their prior:
// values = mean + root * unknowns, where the unknowns have unit prior covariance.
class Shared {
 public:
  Shared(const std::vector<model::Tag>& tags, const model::Calibration& calibration,
         const filter::Config& config)
      : tags_(static_cast<Eigen::Index>(tags.size())) {
    std::vector<model::NodeId> ids;
    ids.reserve(tags.size());
    for (const model::Tag& tag : tags) ids.push_back(tag.id);
    Eigen::Index size = kDelay + 1;
    for (const model::AnchorCalibration& anchor : calibration.anchors) {
      if (!model::has_position(anchor)) continue;
      const Eigen::MatrixXd to = model::selection(ids, anchor);
      const Eigen::MatrixXd own = model::own_covariance(anchor, calibration.common_frame_covariance);
      Anchor& added = anchors_.emplace_back();
      added.calibrated = &anchor;
      added.values = to * model::values_of(anchor);
      added.root = root_of(to * own * to.transpose());
      if (config.model == filter::Model::kJoint || anchor.verdict != model::AnchorVerdict::kOk) {
        added.at = size;
        size += model::anchor_size(tags_);
      }
    }
    lever_arms_ = size;
    size += 3 * tags_ + filter::kFrameSize;
    mean.setZero(size);
    root.setZero(size, size);
    root(0, 0) = config.scale_sigma;
    root(1, 1) = config.yaw_rate_bias_radps;
    const bool delay_is_observed = calibration.range_delay_sigma_s > 0.0;
    delays = {.range_s = delay_is_observed ? calibration.range_delay_s : config.range_delay_s,
              .range_sigma_s = delay_is_observed
                                   ? std::hypot(calibration.range_delay_sigma_s, filter::kRangeDelayChange_s)
                                   : config.range_delay_sigma_s,
              .odometry_sigma_s = config.odometry_delay_sigma_s};
    mean(kDelay) = delays.range_s;
    root(kDelay, kDelay) = std::sqrt(delays.difference_variance_s2());
    for (const Anchor& anchor : anchors_) {
      if (anchor.at < 0) continue;
      mean.segment(anchor.at, anchor.values.size()) = anchor.values;
      root.block(anchor.at, anchor.at, anchor.values.size(), anchor.values.size()) = anchor.root;
    }
    for (Eigen::Index tag = 0; tag < tags_; ++tag) {
      mean.segment<3>(lever_arm(tag)) = tags[static_cast<std::size_t>(tag)].lever_arm_m;
      root.diagonal().segment<3>(lever_arm(tag)).setConstant(config.lever_arm_sigma_m);
    }
    for (const model::TagCalibration& calibrated : calibration.tags) {
      const Eigen::Index tag = tag_slot(tags, calibrated.id);
      if (tag >= 0 && calibrated.lever_arm)
        mean.segment<3>(lever_arm(tag)) = calibrated.lever_arm->position_m;
    }
    root.block<filter::kFrameSize, filter::kFrameSize>(frame(), frame()) =
        root_of(calibration.common_frame_covariance);
  }

  Eigen::VectorXd mean;
  Eigen::MatrixXd root;
  filter::LinkDelays delays;  // kDelay is the ranges' delay minus the odometry's

  static constexpr Eigen::Index kScale = 0;
  static constexpr Eigen::Index kYawBias = 1;
  static constexpr Eigen::Index kDelay = 2;

  [[nodiscard]] Eigen::Index lever_arm(Eigen::Index tag) const noexcept { return lever_arms_ + 3 * tag; }
  [[nodiscard]] Eigen::Index frame() const noexcept { return lever_arm(tags_); }
  // Number of the last parameters that can be considered: lever arms and frame.
  [[nodiscard]] Eigen::Index considered() const noexcept { return mean.size() - lever_arms_; }
  // Null if the anchor is unknown or the calibration lacks its pair with that tag.
  [[nodiscard]] const Anchor* find(model::NodeId id, model::NodeId tag_id) const noexcept {
    const auto is_it = [id](const Anchor& anchor) { return anchor.calibrated->id == id; };
    const auto found = std::find_if(anchors_.begin(), anchors_.end(), is_it);
    if (found == anchors_.end()) return nullptr;
    const auto& pairs = found->calibrated->pairs;
    const bool known = std::any_of(pairs.begin(), pairs.end(),
                                   [tag_id](const model::PairBias& pair) { return pair.tag_id == tag_id; });
    return known ? &*found : nullptr;
  }

 private:
  std::vector<Anchor> anchors_;
  Eigen::Index tags_;
  Eigen::Index lever_arms_ = 0;
};

// A range that the filter used or gated, with its weight and the noise that the filter had found by then.
struct Weighed {
  const model::RangeSample* range = nullptr;
  double weight = 0.0;
  double white_m2 = 0.0;
};

// An odometry sample as the filter held it.
struct Held {
  model::OdometrySample sample;  // at its row's time
  Eigen::Vector3d variances;     // of vx, vy and omega, as the filter had tuned them and found jumps and slip
  double stale_s = 0.0;          // age, if a later sample was implausible
};

// A range between the odometry samples `row` and `row + 1`.
struct Sighting {
  const model::RangeSample* range = nullptr;
  const Anchor* anchor = nullptr;
  Eigen::Index tag = 0;
  std::size_t row = 0;
  double way_m = 0.0;          // driven so far, horizontally
  double weight = 0.0;         // the gate's
  double white_m2 = 0.0;       // variance of its own noise
  double of_the_pair = 1.0;    // number of ranges that share the slow bias, by weight
  double of_the_anchor = 1.0;  // number of ranges that share the error of the anchor's position
  double variance_m2 = 0.0;    // of all these
};

class Smoother {
 public:
  Smoother(const filter::Run& run, const filter::ReplayOptions& options, std::vector<Held> rows)
      : surface_(*run.surface),
        config_(options.config),
        start_(options.start),
        tags_(run.tags.begin(), run.tags.end()),
        rows_(std::move(rows)),
        shared_(tags_, *run.calibration, config_),
        patterns_m_(tags_.size(), model::PatternTerms::Zero()),
        unknowns_(Eigen::VectorXd::Zero(shared_.mean.size())) {
    if (run.calibration->range_noise) {
      bias_sigma_m_ = run.calibration->range_noise->bias_sigma_m * config_.range_bias_growth;
      bias_length_m_ = run.calibration->range_noise->bias_length_m;
    }
    for (const model::TagCalibration& calibrated : run.calibration->tags) {
      const Eigen::Index tag = tag_slot(tags_, calibrated.id);
      if (tag >= 0 && calibrated.pattern_m)
        patterns_m_[static_cast<std::size_t>(tag)] = *calibrated.pattern_m;
    }
  }

  void begin(const filter::ReplayResult& beginning) {
    const std::vector<model::PlanarEstimate>& first = beginning.rows;
    charts_.assign(rows_.size(), start_.pose.chart);
    states_.assign(rows_.size(), Eigen::Vector3d::Zero());
    // The sample before the start, if any, gets the start's pose.
    std::size_t k = 0;
    while (k < rows_.size() && rows_[k].sample.t_s < first.front().t_s) ++k;
    for (std::size_t i = k; i < rows_.size(); ++i) {
      const model::PlanarEstimate& row = first[i - k];
      states_[i] << row.x_m, row.y_m, row.yaw_rad;
      charts_[i] = beginning.spatial[i - k].chart;
      // Unwrapped heading.
      if (i > k) states_[i](2) = states_[i - 1](2) + model::wrap_angle(row.yaw_rad - states_[i - 1](2));
    }
    if (k == 1) {
      states_[0] << start_.pose.x_m, start_.pose.y_m,
          states_[1](2) + model::wrap_angle(start_.pose.theta_rad - states_[1](2));
    }
  }

  void take(const Weighed& weighed) {
    const model::RangeSample& range = *weighed.range;
    const Eigen::Index tag = tag_slot(tags_, range.tag_id);
    const Anchor* anchor = shared_.find(range.anchor_id, range.tag_id);
    if (tag < 0 || anchor == nullptr) return;
    sightings_.push_back({.range = &range,
                          .anchor = anchor,
                          .tag = tag,
                          .weight = weighed.weight,
                          .white_m2 = weighed.white_m2});
  }

  Result solve() {
    Result result;
    const Eigen::Index shared = shared_.mean.size();
    ChainProblem problem(rows_.size(), kPose, shared,
                         config_.model == filter::Model::kJoint ? 0 : shared_.considered());
    locate();
    count_alike();
    weigh();
    double damping = 0.0;
    double cost = std::numeric_limits<double>::infinity();
    Eigen::VectorXd best = unknowns_;
    std::vector<Eigen::Vector3d> best_states = states_;
    // Fills the problem where the last step has led, or, if that is worse, where it began. Returns the gain.
    const auto fill_at_better = [&] {
      locate();
      fill(problem);
      const double gain = cost - problem.cost();
      if (gain >= -kCostRounding * problem.cost()) {
        best = unknowns_;
        best_states = states_;
        damping = damping > kFirstDamping ? kLessDamping * damping : 0.0;
        cost = problem.cost();
        return gain;
      }
      unknowns_ = best;
      states_ = best_states;
      damping = std::max(kMoreDamping * damping, kFirstDamping);
      locate();
      fill(problem);
      return std::numeric_limits<double>::infinity();
    };
    for (result.rounds = 0; result.rounds < kMaxRounds; ++result.rounds) {
      result.converged = fill_at_better() < kConvergedCost;
      if (result.converged) break;
      const ChainProblem::Solution step = problem.solve(damping);
      unknowns_ += step.shared;
      for (std::size_t k = 0; k < states_.size(); ++k) states_[k] += step.blocks[k];
    }
    if (!result.converged) fill_at_better();
    static_cast<void>(problem.solve());  // for the covariances
    const Eigen::VectorXd values = shared_values();
    result.scale_error = values(Shared::kScale);
    result.yaw_rate_bias_radps = values(Shared::kYawBias);
    result.odometry_delay_s = shared_.delays.odometry_s(values(Shared::kDelay));
    result.range_delay_s = values(Shared::kDelay) + result.odometry_delay_s;
    result.ranges.reserve(sightings_.size());
    for (const Sighting& sighting : sightings_) {
      result.ranges.push_back({*sighting.range, sighting.weight});
      result.ranges_los += sighting.weight;
    }
    const std::vector<Eigen::MatrixXd> covariances =
        problem.covariances({Shared::kScale, Shared::kYawBias, Shared::kDelay});
    for (std::size_t k = 0; k < rows_.size(); ++k) {
      if (rows_[k].sample.t_s >= start_.t_s) result.rows.push_back(present(k, values, covariances[k]));
    }
    return result;
  }

 private:
  // The pose at a sample's timestamp, corrected for the odometry delay. covariance: of the sample's states,
  // then scale, yaw-rate bias and delay, these three in units of their prior sigmas.
  [[nodiscard]] model::PlanarEstimate present(std::size_t k, const Eigen::VectorXd& values,
                                              const Eigen::MatrixXd& covariance) const {
    constexpr std::array<filter::CoreIndex, 3> kShared{filter::kScale, filter::kYawBias, filter::kDelay};
    filter::CoreVector core = filter::CoreVector::Zero();
    core.head<kPose>() = states_[k];
    Eigen::MatrixXd from = Eigen::MatrixXd::Zero(filter::kCoreSize, kPose + 3);
    from.topLeftCorner<kPose, kPose>().setIdentity();
    for (Eigen::Index i = 0; i < 3; ++i) {
      const filter::CoreIndex at = kShared[static_cast<std::size_t>(i)];
      core(at) = values(i);
      from(at, kPose + i) = shared_.root(i, i);
    }
    const filter::PresentPose now =
        filter::present_pose(surface_, core, rows_[k].sample, shared_.delays, charts_[k]);
    const Eigen::MatrixXd by = now.d_core * from;
    const Eigen::Matrix3d moved = by * covariance * by.transpose();
    return {rows_[k].sample.t_s, now.pose.x(), now.pose.y(), model::wrap_angle(now.pose.z()),
            0.5 * (moved + moved.transpose()) + now.noise};
  }

  // Predicted range, with derivatives w.r.t. the interpolated pose, the delay and the calibration.
  struct Prediction {
    double range_m = 0.0;
    double share = 0.0;  // weight of the later sample in the interpolation, 0 .. 1 between the samples
    Eigen::RowVector3d by_pose;
    double by_delay = 0.0;
    model::RangePrediction range;
    Eigen::RowVector3d turned;
  };

  [[nodiscard]] Eigen::VectorXd shared_values() const { return shared_.mean + shared_.root * unknowns_; }

  [[nodiscard]] Eigen::Vector3d pose_between(std::size_t row, double share) const {
    const Eigen::Vector3d first = states_[row];
    return first + share * (states_[row + 1] - first);
  }

  [[nodiscard]] Prediction predict(const Sighting& sighting, const Eigen::VectorXd& values) const {
    Prediction out;
    const double row_s = rows_[sighting.row + 1].sample.t_s - rows_[sighting.row].sample.t_s;
    out.share = (sighting.range->t_s - values(Shared::kDelay) - rows_[sighting.row].sample.t_s) / row_s;
    const Eigen::Vector3d pose = pose_between(sighting.row, out.share);
    const auto tags = static_cast<Eigen::Index>(tags_.size());
    const Anchor& anchor = *sighting.anchor;
    const Eigen::VectorXd own =
        anchor.at < 0 ? anchor.values : Eigen::VectorXd(values.segment(anchor.at, anchor.values.size()));
    const Eigen::Vector3d surveyed = own.head<3>();
    const Eigen::Vector4d frame = values.segment<4>(shared_.frame());
    out.turned = Eigen::RowVector3d(-surveyed.y(), surveyed.x(), 0.0);
    const Eigen::Vector3d anchor_m = surveyed + frame.head<3>() + frame(3) * out.turned.transpose();
    const Eigen::Vector3d lever_arm_m = values.segment<3>(shared_.lever_arm(sighting.tag));
    const model::SurfacePose on =
        model::pose_on_surface(surface_, {pose.x(), pose.y(), pose.z(), charts_[sighting.row]});
    out.range =
        model::predict_range(on.pose, lever_arm_m, anchor_m, model::terms_of(own, sighting.tag, tags));
    out.by_pose = model::range_by_planar_pose(out.range, on, lever_arm_m);
    const Eigen::Vector3d way = states_[sighting.row + 1] - states_[sighting.row];
    out.by_delay = -out.by_pose.dot(way) / row_s;
    const Eigen::Vector3d in_body = on.pose.rotation.transpose() * out.range.direction;
    out.range_m = out.range.range_m +
                  model::pattern_terms(in_body).dot(patterns_m_[static_cast<std::size_t>(sighting.tag)]);
    return out;
  }

  // Finds the two samples around each range with the current delay.
  void locate() {
    const double delay_s = shared_values()(Shared::kDelay);
    for (Sighting& sighting : sightings_) {
      const double t_s = sighting.range->t_s - delay_s;
      const auto after =
          std::upper_bound(rows_.begin(), rows_.end(), t_s,
                           [](double instant_s, const Held& row) { return instant_s < row.sample.t_s; });
      const auto next =
          std::clamp<std::ptrdiff_t>(after - rows_.begin(), 1, static_cast<std::ptrdiff_t>(rows_.size()) - 1);
      sighting.row = static_cast<std::size_t>(next - 1);
    }
  }

  // Counts the ranges that share errors with each range.
  void count_alike() {
    std::vector<double> ways_m{0.0};
    for (std::size_t k = 1; k < states_.size(); ++k)
      ways_m.push_back(ways_m.back() + (states_[k] - states_[k - 1]).head<2>().norm());
    for (Sighting& sighting : sightings_) sighting.way_m = ways_m[sighting.row];
    std::map<const Anchor*, std::vector<Sighting*>> anchors;
    std::map<std::pair<const Anchor*, Eigen::Index>, std::vector<Sighting*>> pairs;
    for (Sighting& sighting : sightings_) {
      anchors[sighting.anchor].push_back(&sighting);
      pairs[{sighting.anchor, sighting.tag}].push_back(&sighting);
    }
    for (const auto& [anchor, members] : anchors)
      count_within(members, kMapLength_m, &Sighting::of_the_anchor);
    for (const auto& [pair, members] : pairs) count_within(members, bias_length_m_, &Sighting::of_the_pair);
  }

  // For each of the ranges, sorted by time: one and the weights of the others within this way of it.
  static void count_within(const std::vector<Sighting*>& members, double length_m, double Sighting::*count) {
    std::size_t first = 0;
    std::size_t end = 0;
    double weights = 0.0;
    for (Sighting* member : members) {
      for (; end < members.size() && members[end]->way_m <= member->way_m + length_m; ++end)
        weights += members[end]->weight;
      for (; members[first]->way_m < member->way_m - length_m; ++first) weights -= members[first]->weight;
      member->*count = 1.0 + std::max(0.0, weights - member->weight);
    }
  }

  // The ranges' variances, by the directions that the filter found.
  void weigh() {
    const Eigen::VectorXd values = shared_values();
    for (Sighting& sighting : sightings_) {
      // n ranges that share an error of variance s^2 say as much about it as n ranges with white errors of
      // variance n s^2.
      sighting.variance_m2 = sighting.white_m2 + sighting.of_the_pair * square(bias_sigma_m_);
      if (sighting.anchor->at >= 0 || !(sighting.weight > 0.0)) continue;
      const Eigen::RowVectorXd d_anchor =
          by_anchor(sighting, predict(sighting, values), values(shared_.frame() + 3));
      sighting.variance_m2 += sighting.of_the_anchor * (d_anchor * sighting.anchor->root).squaredNorm();
    }
  }

  void fill(ChainProblem& problem) const {
    const Eigen::VectorXd values = shared_values();
    problem.clear();
    problem.add_shared_prior(unknowns_);
    add_start(problem);
    for (std::size_t k = 0; k + 1 < rows_.size(); ++k) add_row(problem, k, values);
    for (const Sighting& sighting : sightings_) add_range(problem, sighting, values);
  }

  void add_start(ChainProblem& problem) const {
    const double row_s = rows_[1].sample.t_s - rows_[0].sample.t_s;
    const double share = (start_.t_s - rows_[0].sample.t_s) / row_s;
    const Eigen::Vector3d pose = pose_between(0, share);
    ChainProblem::Term term(kPose, kPose, 0);
    term.by_first = (1.0 - share) * Eigen::Matrix3d::Identity();
    term.by_second = share * Eigen::Matrix3d::Identity();
    term.residual = Eigen::Vector3d(start_.pose.x_m - pose.x(), start_.pose.y_m - pose.y(),
                                    model::wrap_angle(start_.pose.theta_rad - pose.z()));
    term.information =
        Eigen::Vector3d(1.0 / square(start_.position_sigma_m), 1.0 / square(start_.position_sigma_m),
                        1.0 / square(start_.heading_sigma_rad))
            .asDiagonal();
    problem.add(0, term);
  }

  // Odometry between the samples k and k + 1.
  void add_row(ChainProblem& problem, std::size_t k, const Eigen::VectorXd& values) const {
    filter::CoreVector core = filter::CoreVector::Zero();
    core.head<kPose>() = states_[k];
    core(filter::kScale) = values(Shared::kScale);
    core(filter::kYawBias) = values(Shared::kYawBias);
    const double row_s = rows_[k + 1].sample.t_s - rows_[k].sample.t_s;
    // The filter's steps.
    const double steps = std::clamp(std::ceil(row_s / filter::kMaxStep_s), 1.0, 400.0);
    Eigen::Matrix<double, filter::kCoreSize, filter::kCoreSize> by_core;
    by_core.setIdentity();
    for (int i = 0; i < static_cast<int>(steps); ++i) {
      const filter::Motion motion = filter::move(surface_, core, rows_[k].sample, row_s / steps, charts_[k]);
      core.head<kPose>() = motion.pose;
      const Eigen::Matrix<double, 3, filter::kCoreSize> rows = motion.d_core * by_core;
      by_core.topRows<3>() = rows;
    }
    Eigen::Vector3d variances = rows_[k].variances;
    // Velocity random walk after max_hold_s, as a constant velocity error with the same position variance.
    const double overdue_s = std::max(row_s - config_.max_hold_s, 0.0);
    double walk = overdue_s * overdue_s * overdue_s / (3.0 * row_s * row_s);
    // The same where implausible samples were dropped: a random walk since the last accepted sample.
    if (rows_[k].stale_s > 0.0)
      walk += (rows_[k].stale_s * (rows_[k].stale_s - row_s) + square(row_s) / 3.0) / row_s;
    variances += walk * Eigen::Vector3d(square(config_.hold_walk_mps), square(config_.hold_walk_mps),
                                        square(config_.hold_walk_radps));
    const Eigen::Matrix3d by_noise = by_core.block<3, 3>(0, filter::kOdometryVx);
    const Eigen::Matrix3d covariance = by_noise * variances.asDiagonal() * by_noise.transpose();

    ChainProblem::Term term(kPose, kPose, 2);
    term.by_first = by_core.topLeftCorner<3, 3>();
    term.by_second = -Eigen::Matrix3d::Identity();
    term.shared = {Shared::kScale, Shared::kYawBias};
    term.by_shared.col(0) = by_core.block<3, 1>(0, filter::kScale) * shared_.root(0, 0);
    term.by_shared.col(1) = by_core.block<3, 1>(0, filter::kYawBias) * shared_.root(1, 1);
    term.residual = states_[k + 1] - core.head<kPose>();
    term.information = covariance.inverse();
    problem.add(k, term);
  }

  // Derivative of a prediction w.r.t. the anchor's position and terms.
  [[nodiscard]] Eigen::RowVectorXd by_anchor(const Sighting& sighting, const Prediction& predicted,
                                             double frame_yaw_rad) const {
    const auto tags = static_cast<Eigen::Index>(tags_.size());
    const Eigen::RowVector3d& d_anchor = predicted.range.d_anchor;
    Eigen::RowVectorXd out = Eigen::RowVectorXd::Zero(model::anchor_size(tags));
    out(model::pair_indices(sighting.tag, tags)) << d_anchor.x() + frame_yaw_rad * d_anchor.y(),
        d_anchor.y() - frame_yaw_rad * d_anchor.x(), d_anchor.z(), predicted.range.d_terms.transpose();
    return out;
  }

  void add_range(ChainProblem& problem, const Sighting& sighting, const Eigen::VectorXd& values) const {
    if (!(sighting.weight > 0.0)) return;
    const Anchor& anchor = *sighting.anchor;
    const Prediction predicted = predict(sighting, values);
    Eigen::RowVectorXd d_frame(filter::kFrameSize);
    d_frame << predicted.range.d_anchor, predicted.range.d_anchor.dot(predicted.turned);

    ChainProblem::Term term(kPose, 1, 0);
    const auto add = [&](Eigen::Index at, const Eigen::RowVectorXd& by) {
      const auto column = static_cast<Eigen::Index>(term.shared.size());
      term.by_shared.conservativeResize(1, column + by.size());
      term.by_shared.rightCols(by.size()) = by * shared_.root.block(at, at, by.size(), by.size());
      for (Eigen::Index i = 0; i < by.size(); ++i) term.shared.push_back(at + i);
    };
    add(Shared::kDelay, Eigen::RowVectorXd::Constant(1, predicted.by_delay));
    if (anchor.at >= 0) add(anchor.at, by_anchor(sighting, predicted, values(shared_.frame() + 3)));
    add(shared_.lever_arm(sighting.tag), predicted.range.d_lever_arm);
    add(shared_.frame(), d_frame);
    term.by_first = (1.0 - predicted.share) * predicted.by_pose;
    term.by_second = predicted.share * predicted.by_pose;
    term.residual(0) = sighting.range->range_m - predicted.range_m;
    term.information(0, 0) = sighting.weight / sighting.variance_m2;
    problem.add(sighting.row, term);
  }

  const model::Surface& surface_;
  filter::Config config_;
  filter::Start start_;
  std::vector<model::Tag> tags_;
  std::vector<Held> rows_;
  Shared shared_;
  std::vector<model::PatternTerms> patterns_m_;
  double bias_sigma_m_ = 0.0;  // of a pair's slow bias
  double bias_length_m_ = 0.0;
  Eigen::VectorXd unknowns_;
  std::vector<Eigen::Vector3d> states_;  // the pose at each sample
  std::vector<int> charts_;              // of each sample, from the filter
  std::vector<Sighting> sightings_;
};

// An implausible sample counts as standing still, as in the filter.
Held held_at_start(const model::OdometrySample& sample, const filter::Config& config) {
  Held out{.sample = sample,
           .variances = {square(config.odometry.sigma_vx_mps), square(config.odometry.sigma_vy_mps),
                         square(config.odometry.sigma_omega_radps)}};
  if (!filter::OdometryGate{}.accepts(sample)) out.sample = {.t_s = sample.t_s};
  return out;
}

}  // namespace

Result smooth(const filter::Run& run, const filter::ReplayOptions& options) {
  filter::ReplayOptions first = options;
  first.now_ns = nullptr;
  std::vector<model::OdometrySample> odometry;
  odometry.reserve(run.odometry.size());
  for (const model::OdometrySample& row : run.odometry) {
    if (odometry.empty() || row.t_s > odometry.back().t_s) odometry.push_back(row);
  }
  filter::Run once = run;
  once.odometry = odometry;
  std::vector<Held> rows;
  rows.reserve(odometry.size());
  const auto is_later = [&](const model::OdometrySample& row) { return row.t_s > options.start.t_s; };
  const auto after = std::find_if(odometry.begin(), odometry.end(), is_later);
  if (after != odometry.begin()) rows.push_back(held_at_start(*std::prev(after), options.config));
  first.on_odometry = [&](const filter::Tracker& tracker, const model::OdometrySample& row) {
    const filter::Filter& filter = tracker.filter().filter();
    const model::OdometrySample& held = filter.snapshot().odometry;
    const bool is_stale = held.t_s < row.t_s;
    if (row.t_s <= options.start.t_s) rows.clear();
    rows.push_back({.sample = {row.t_s, held.vx_mps, held.vy_mps, held.omega_radps},
                    .variances = is_stale && !rows.empty()
                                     ? rows.back().variances
                                     : Eigen::Vector3d(filter.covariance().core().diagonal().segment<3>(
                                           filter::kOdometryVx)),
                    .stale_s = row.t_s - held.t_s});
  };
  std::vector<Weighed> weighed;
  first.on_range = [&](const filter::Tracker& tracker, const model::RangeSample& range,
                       const filter::RangeResult& result) {
    if (result.outcome != filter::RangeOutcome::kUsed && result.outcome != filter::RangeOutcome::kGated)
      return;
    const filter::RangeTuning& tuning = tracker.filter().filter().snapshot().tuning;
    weighed.push_back({.range = &range,
                       .weight = result.weight,
                       .white_m2 = square(tuning.white_sigma_m()) + result.regained_variance_m2});
  };
  const filter::ReplayResult beginning = filter::replay(once, first);
  if (beginning.rows.empty() || rows.size() < 2) return {};
  Smoother smoother(run, options, std::move(rows));
  smoother.begin(beginning);
  for (const Weighed& range : weighed) smoother.take(range);
  Result result = smoother.solve();
  result.counters = beginning.counters;
  return result;
}

}  // namespace groma::smoother
