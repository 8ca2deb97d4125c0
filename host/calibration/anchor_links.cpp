#include "host/calibration/anchor_links.hpp"

#include <algorithm>
#include <cmath>
#include <map>
#include <utility>

#include <Eigen/Cholesky>

#include "host/calibration/robust_kernel.hpp"

namespace groma::calibration {
namespace {

// Lower limit of the sigma of a pair's mean range, however many ranges it has: systematic errors do not
// average out. By hand; AnchorLinks.ImproveAPoorlyDeterminedSite holds with it (NEES 1.02).
constexpr double kLinkSigmaFloor_m = 0.01;
// Bounds on iterations: by hand; AnchorLinks.EqualADenseUpdateOfAllUnknowns holds with them.
constexpr int kFusingSteps = 8;
constexpr int kFusionRounds = 3;
constexpr int kFlippingRounds = 4;

using model::square;

Eigen::Index position_of(std::size_t anchor) noexcept {
  return 3 * static_cast<Eigen::Index>(anchor);
}

Eigen::Vector3d between(const AnchorLink& link, const Eigen::VectorXd& positions_m) {
  return positions_m.segment<3>(position_of(link.from)) - positions_m.segment<3>(position_of(link.to));
}

double residual_m(const AnchorLink& link, const Eigen::VectorXd& positions_m,
                  const model::RangePriors& priors) {
  const model::TermVector means = model::means_of(priors);
  return link.range_m - model::offset_m(means) - model::scale_of(means) * between(link, positions_m).norm();
}

// Covariance of anchor a's unknowns with the position of anchor b.
Eigen::MatrixXd with_position(const AnchorBelief& belief, std::size_t a, std::size_t b) {
  if (a == b) return belief.covariance[a].leftCols<3>();
  if (belief.gain.empty()) return Eigen::MatrixXd::Zero(belief.mean[a].size(), 3);
  return belief.gain[a] * belief.shared * belief.gain[b].topRows<3>().transpose();
}

// Negative log likelihood of a link, given the covariances of its anchors.
double cost_of(const AnchorLink& link, const Eigen::VectorXd& positions_m, const AnchorBelief& belief,
               const model::RangePriors& priors) {
  const Eigen::Vector3d direction = between(link, positions_m).normalized();
  const Eigen::Matrix3d spread =
      belief.covariance[link.from].topLeftCorner<3, 3>() + belief.covariance[link.to].topLeftCorner<3, 3>();
  const double variance_m2 = link.variance_m2 + direction.dot(spread * direction);
  const RobustKernel kernel(KernelShape{.scale_m = std::sqrt(variance_m2)});
  return -std::log(kernel.at(residual_m(link, positions_m, priors)).density);
}

// From ranges and drive error.
AnchorBelief belief_of(const Site& site) {
  AnchorBelief out;
  for (std::size_t a = 0; a < site.fits.size(); ++a) {
    const AnchorFit& fit = site.fits[a];
    AnchorVector mean = fit.anchor;
    if (!fit.problem.rows.empty() && !fit.problem.position.surveyed) {
      const NormalEquations here = linearize(fit);
      mean -= here.information.ldlt().solve(here.gradient);
    }
    out.mean.push_back(std::move(mean));
    out.covariance.push_back(anchor_covariance(fit.evidence, fit.inflation) + site.error.added_covariance[a]);
  }
  out.gain = site.error.shared_gain;
  out.shared = site.error.shared_covariance;
  return out;
}

// Moves anchors to their mirror hypotheses, one or two at a time, as long as that lowers the cost of links
// and drive together.
void take_sides(Site& site, std::span<const AnchorLink> links, const model::RangePriors& priors) {
  const std::size_t anchors = site.fits.size();
  const AnchorBelief belief = belief_of(site);
  std::vector<bool> flipped(anchors, false);
  const auto cost = [&] {
    Eigen::VectorXd positions_m(position_of(anchors));
    double sum = 0.0;
    for (std::size_t a = 0; a < anchors; ++a) {
      const AnchorVector& anchor = flipped[a] ? site.evidence[a].mirror->anchor : site.fits[a].anchor;
      positions_m.segment<3>(position_of(a)) = anchor.head<3>();
      if (flipped[a]) sum += site.evidence[a].mirror->cost_excess / site.fits[a].inflation;
    }
    for (const AnchorLink& link : links) sum += cost_of(link, positions_m, belief, priors);
    return sum;
  };
  const auto flip = [&](std::size_t a, std::size_t b) {
    flipped[a] = !flipped[a];
    if (b != a) flipped[b] = !flipped[b];
  };
  double best = cost();
  bool better = true;
  for (int round = 0; round < kFlippingRounds && better; ++round) {
    better = false;
    for (std::size_t a = 0; a < anchors; ++a) {
      for (std::size_t b = a; b < anchors; ++b) {
        if (!site.evidence[a].mirror || !site.evidence[b].mirror) continue;
        flip(a, b);
        const double found = cost();
        if (found < best) {
          best = found;
          better = true;
        } else {
          flip(a, b);
        }
      }
    }
  }
  std::vector<double> excess(anchors, 0.0);
  for (std::size_t a = 0; a < anchors; ++a) {
    if (!site.evidence[a].mirror) continue;
    const double here = cost();
    flip(a, a);
    excess[a] = std::max(0.0, cost() - here) * site.fits[a].inflation;
    flip(a, a);
  }
  for (std::size_t a = 0; a < anchors; ++a) {
    std::optional<MirrorHypothesis>& mirror = site.evidence[a].mirror;
    if (!mirror) continue;
    mirror->cost_excess = excess[a];
    if (!flipped[a]) continue;
    std::swap(site.fits[a].anchor, mirror->anchor);
    gather_evidence({&site.fits[a], 1});
  }
}

}  // namespace

std::vector<AnchorLink> gather_links(std::span<const model::AnchorRange> ranges,
                                     std::span<const model::NodeId> anchor_ids,
                                     const model::RangePriors& priors) {
  struct Sum {
    double weight = 0.0;
    double weighted_m = 0.0;
  };
  const auto index_of = [&](model::NodeId id) {
    return static_cast<std::size_t>(std::find(anchor_ids.begin(), anchor_ids.end(), id) - anchor_ids.begin());
  };
  std::map<std::pair<std::size_t, std::size_t>, Sum> sums;
  for (const model::AnchorRange& range : ranges) {
    const std::size_t a = index_of(range.anchor_id);
    const std::size_t b = index_of(range.other_id);
    const bool known = a < anchor_ids.size() && b < anchor_ids.size() && a != b;
    if (!known || !(range.range_m > 0.0) || !std::isfinite(range.range_m) || range.count == 0) continue;
    const double sigma_m =
        std::isfinite(range.sigma_m) && range.sigma_m > 0.0 ? range.sigma_m : priors.sigma_m;
    Sum& sum = sums[std::minmax(a, b)];
    const double weight = static_cast<double>(range.count) / square(sigma_m);
    sum.weight += weight;
    sum.weighted_m += weight * range.range_m;
  }
  std::vector<AnchorLink> out;
  for (const auto& [pair, sum] : sums) {
    const double range_m = sum.weighted_m / sum.weight;
    double variance_m2 = 1.0 / sum.weight + square(kLinkSigmaFloor_m);
    const model::TermVector sigmas_m = model::by_terms(range_m).cwiseProduct(model::sigmas_of(priors));
    for (const double sigma_m : sigmas_m) variance_m2 += square(sigma_m);
    out.push_back({.from = pair.first, .to = pair.second, .range_m = range_m, .variance_m2 = variance_m2});
  }
  return out;
}

AnchorBelief fuse_links(const AnchorBelief& belief, std::span<const AnchorLink> links,
                        const model::RangePriors& priors) {
  const std::size_t anchors = belief.mean.size();
  const Eigen::Index size = position_of(anchors);
  Eigen::VectorXd mean(size);
  Eigen::MatrixXd covariance(size, size);
  for (std::size_t a = 0; a < anchors; ++a) {
    mean.segment<3>(position_of(a)) = belief.mean[a].head<3>();
    for (std::size_t b = 0; b < anchors; ++b) {
      covariance.block<3, 3>(position_of(a), position_of(b)) = with_position(belief, a, b).topRows<3>();
    }
  }
  const Eigen::LDLT<Eigen::MatrixXd> before(covariance);
  const Eigen::MatrixXd information = before.solve(Eigen::MatrixXd::Identity(size, size));

  Eigen::VectorXd found = mean;
  Eigen::MatrixXd after = covariance;
  for (int step = 0; step < kFusingSteps; ++step) {
    Eigen::MatrixXd sum = information;
    Eigen::VectorXd descent = information * (mean - found);
    for (const AnchorLink& link : links) {
      const Eigen::Vector3d direction = between(link, found).normalized();
      const Eigen::Vector3d j = model::scale_of(model::means_of(priors)) * direction;
      const Eigen::Index a = position_of(link.from);
      const Eigen::Index b = position_of(link.to);
      double variance_m2 = link.variance_m2;
      // In the first step the anchors' own spread may explain a large residual: then the link is no outlier.
      if (step == 0) {
        const Eigen::Matrix3d spread = covariance.block<3, 3>(a, a) + covariance.block<3, 3>(b, b) -
                                       covariance.block<3, 3>(a, b) - covariance.block<3, 3>(b, a);
        variance_m2 += j.dot(spread * j);
      }
      const RobustKernel kernel(KernelShape{.scale_m = std::sqrt(variance_m2)});
      KernelValue value = kernel.at(residual_m(link, found, priors));
      if (step == 0) {
        // The spread must not weaken the link: the prior contains it already.
        value.weight *= variance_m2 / link.variance_m2;
        value.slope *= variance_m2 / link.variance_m2;
      }
      const Eigen::Matrix3d block = value.weight * j * j.transpose();
      sum.block<3, 3>(a, a) += block;
      sum.block<3, 3>(b, b) += block;
      sum.block<3, 3>(a, b) -= block;
      sum.block<3, 3>(b, a) -= block;
      descent.segment<3>(a) += value.slope * j;
      descent.segment<3>(b) -= value.slope * j;
    }
    const Eigen::LDLT<Eigen::MatrixXd> posterior(sum);
    after = posterior.solve(Eigen::MatrixXd::Identity(size, size));
    found += posterior.solve(descent);
  }

  AnchorBelief out = belief;
  if (!found.allFinite() || !after.allFinite()) return out;
  // The other unknowns follow from their covariance with the positions.
  const Eigen::VectorXd moved = information * (found - mean);
  const Eigen::MatrixXd gained = information * (covariance - after) * information;
  for (std::size_t a = 0; a < anchors; ++a) {
    Eigen::MatrixXd cross(belief.mean[a].size(), size);
    for (std::size_t b = 0; b < anchors; ++b) {
      cross.middleCols<3>(position_of(b)) = with_position(belief, a, b);
    }
    out.mean[a] += cross * moved;
    const Eigen::MatrixXd left = belief.covariance[a] - cross * gained * cross.transpose();
    out.covariance[a] = 0.5 * (left + left.transpose());
  }
  return out;
}

std::vector<Eigen::MatrixXd> join_links(std::span<const model::AnchorRange> ranges,
                                        const model::RangePriors& priors, Site& site) {
  std::vector<model::NodeId> ids;
  for (const AnchorObservations& anchor : site.association.anchors) ids.push_back(anchor.id);
  const std::vector<AnchorLink> links = gather_links(ranges, ids, priors);
  if (links.empty()) return belief_of(site).covariance;
  take_sides(site, links, priors);
  AnchorBelief belief;
  for (int round = 0; round < kFusionRounds; ++round) {
    belief = fuse_links(belief_of(site), links, priors);
    for (std::size_t a = 0; a < site.fits.size(); ++a) site.fits[a].anchor = belief.mean[a];
    gather_evidence(site.fits);
  }
  return belief.covariance;
}

}  // namespace groma::calibration
