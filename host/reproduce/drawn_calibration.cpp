#include "host/reproduce/drawn_calibration.hpp"

#include <cmath>
#include <map>
#include <numbers>
#include <numeric>
#include <utility>
#include <vector>

#include "firmware/sim/keyed_random.hpp"
#include "host/model/median.hpp"
#include "host/reproduce/paper.hpp"

namespace groma::reproduce {

namespace {

enum Purpose : std::uint64_t { kErrorDirection = 0x4361, kErrorSize };

// Of an error: how much of it is height. The paper says only "larger in z".
constexpr double kHeightShare = 0.9;
// Sigmas of biases that a calibration estimated from hundreds of ranges, and of those that are means over the
// run itself. By hand.
constexpr double kEstimatedBeta_m = 0.05;
constexpr double kMeanBeta_m = 0.02;
constexpr double kGammaSigma = 0.002;

using Pair = std::pair<model::NodeId, model::NodeId>;  // anchor, tag

double mean(const std::vector<double>& values) {
  return std::accumulate(values.begin(), values.end(), 0.0) / static_cast<double>(values.size());
}
double median(const std::vector<double>& values) {
  return model::median(values);
}

// `average` of range less distance from the antenna's true place to `places`, of each pair.
std::map<Pair, double> biases(const sim::World& world, const io::Dataset& drive,
                              const std::map<model::NodeId, Eigen::Vector3d>& places,
                              double (*average)(const std::vector<double>&)) {
  std::map<Pair, std::vector<double>> seen;
  for (const model::RangeSample& range : drive.ranges) {
    const auto antenna_m = world.antenna_m(range.tag_id, range.t_s);
    seen[{range.anchor_id, range.tag_id}].push_back(range.range_m -
                                                    (*antenna_m - places.at(range.anchor_id)).norm());
  }
  std::map<Pair, double> out;
  for (const auto& [pair, values] : seen) out[pair] = average(values);
  return out;
}

model::AnchorCalibration anchor_of(model::NodeId id, const Eigen::Vector3d& place_m, double variance_m2,
                                   std::span<const model::Tag> tags, const std::map<Pair, double>& betas_m,
                                   double beta_sigma_m) {
  model::AnchorCalibration out{.id = id, .position_m = place_m};
  for (const model::Tag& tag : tags) {
    const auto beta_m = betas_m.find({id, tag.id});
    if (beta_m == betas_m.end()) continue;
    out.pairs.push_back({.tag_id = tag.id,
                         .beta_m = beta_m->second,
                         .beta_sigma_m = beta_sigma_m,
                         .gamma = 1.0,
                         .gamma_sigma = kGammaSigma});
  }
  const Eigen::Index count = std::ssize(out.pairs);
  Eigen::VectorXd variances(model::anchor_size(count));
  variances.head<3>().setConstant(variance_m2);
  for (Eigen::Index i = 0; i < count; ++i) {
    variances(model::term_index(model::kBeta, i, count)) = beta_sigma_m * beta_sigma_m;
    variances(model::term_index(model::kGamma, i, count)) = kGammaSigma * kGammaSigma;
  }
  out.covariance = variances.asDiagonal();
  out.verdict = out.pairs.empty() ? model::AnchorVerdict::kNoData : model::AnchorVerdict::kOk;
  return out;
}

}  // namespace

model::Calibration drawn_calibration(const sim::World& world, const io::Dataset& drive,
                                     std::span<const model::Anchor> anchors, std::uint64_t seed) {
  std::map<model::NodeId, Eigen::Vector3d> places;
  const sim::KeyedRandom random(seed);
  for (const PaperAnchor& row : kTable1) {
    for (const model::Anchor& anchor : anchors) {
      if (anchor.id != row.id) continue;
      const sim::KeyedRandom draw = random.of(kErrorDirection, row.id);
      const double turn_rad = draw.of(0).uniform(0.0, 2.0 * std::numbers::pi);
      const double side = draw.of(1).uniform() < 0.5 ? -1.0 : 1.0;
      const double flat = std::sqrt(1.0 - kHeightShare * kHeightShare);
      places[row.id] =
          anchor.position_m + row.error_m * Eigen::Vector3d(flat * std::cos(turn_rad),
                                                            flat * std::sin(turn_rad), side * kHeightShare);
    }
  }
  const std::map<Pair, double> betas_m = biases(world, drive, places, median);
  model::Calibration out;
  for (const PaperAnchor& row : kTable1)
    out.anchors.push_back(
        anchor_of(row.id, places.at(row.id), row.variance_m2, drive.tags, betas_m, kEstimatedBeta_m));
  out.verdict = model::Verdict::kUsable;
  return out;
}

model::Calibration pre_calibration(const sim::World& world, const io::Dataset& drive,
                                   std::span<const model::Anchor> anchors, double most_m,
                                   std::uint64_t seed) {
  std::map<model::NodeId, Eigen::Vector3d> places;
  const sim::KeyedRandom random(seed);
  for (const model::Anchor& anchor : anchors) {
    const sim::KeyedRandom draw = random.of(kErrorDirection, anchor.id);
    const Eigen::Vector3d way(draw.of(0).normal(), draw.of(1).normal(), draw.of(2).normal());
    places[anchor.id] =
        anchor.position_m + random.of(kErrorSize, anchor.id).uniform() * most_m * way.normalized();
  }
  const std::map<Pair, double> betas_m = biases(world, drive, places, mean);
  model::Calibration out;
  const double sigma_m = most_m / 3.0;  // each axis of a uniform length in a uniform direction
  for (const model::Anchor& anchor : anchors)
    out.anchors.push_back(
        anchor_of(anchor.id, places.at(anchor.id), sigma_m * sigma_m, drive.tags, betas_m, kMeanBeta_m));
  out.verdict = model::Verdict::kUsable;
  return out;
}

}  // namespace groma::reproduce
