#include "host/calibration/shared_unknowns.hpp"

#include <algorithm>
#include <array>
#include <cmath>

namespace groma::calibration {
namespace {

constexpr double kLeastSigma_m = 1e-6;
constexpr double kLeastSigma_rad = 1e-7;

constexpr double inverse_square(double x) noexcept {
  return 1.0 / (x * x);
}

// What a knot keeps of the error at the one before.
double kept_share(const Knots& knots, const WanderPrior& wander) noexcept {
  return std::exp(-knots.spacing_s / wander.correlation_s);
}

BodyVector body_information() noexcept {
  BodyVector out;
  out.head<3>().setConstant(inverse_square(kLeverArmSigma_m));
  out.tail<model::kPatternTerms>().setConstant(inverse_square(kPatternSigma_m));
  return out;
}

}  // namespace

std::optional<Knots> place_knots(std::span<const AnchorFit> fits, const KnotGrid& grid) {
  const RowSpan span = row_span(fits);
  const double duration_s = span.end_s - span.begin_s;
  if (!(duration_s > 0.0)) return std::nullopt;
  Knots knots;
  knots.begin_s = span.begin_s;
  knots.spacing_s = std::max(grid.spacing_s, duration_s / (grid.max_count - 1.0));
  knots.count = 2 + static_cast<Eigen::Index>(duration_s / knots.spacing_s);
  return knots;
}

KnotShare knot_share(const Knots& knots, double t_s) noexcept {
  const double position =
      std::clamp((t_s - knots.begin_s) / knots.spacing_s, 0.0, static_cast<double>(knots.count - 1));
  const auto k = std::min(static_cast<Eigen::Index>(position), knots.count - 2);
  return {.first = 3 * k, .fraction = position - static_cast<double>(k)};
}

SharedRow shared_jacobian(const Observation& row, const model::AntennaPrediction& predicted, double gamma,
                          double fraction) noexcept {
  const Eigen::Vector3d by_antenna = gamma * predicted.direction;
  const double by_yaw = by_antenna.head<2>().dot(row.yaw_arm_m);
  const Eigen::Vector3d wander(by_antenna.x(), by_antenna.y(), by_yaw);
  const Eigen::Vector3d in_body = row.attitude.conjugate().cast<double>() * predicted.direction;
  SharedRow out;
  out << (1.0 - fraction) * wander, fraction * wander, -by_antenna.dot(row.velocity_mps), gamma * in_body,
      model::pattern_terms(in_body);
  return out;
}

void move_row(const SharedUnknowns& unknowns, const Eigen::VectorXd& step, const Eigen::Vector3d& anchor_m,
              Observation& row) noexcept {
  if (unknowns.body_tags > 0) {
    const Eigen::Quaterniond attitude = row.attitude.cast<double>();
    const BodyVector body = step.segment<kBodyTerms>(unknowns.body(row.tag));
    const Eigen::Vector3d in_body = attitude.conjugate() * (row.tag_m - anchor_m).normalized();
    row.range_m -= model::pattern_terms(in_body).dot(body.tail<model::kPatternTerms>());
    row.tag_m += attitude * body.head<3>();
  }
  const KnotShare share = knot_share(unknowns.knots, row.t_s);
  const Eigen::Vector3d error = (1.0 - share.fraction) * step.segment<3>(share.first) +
                                share.fraction * step.segment<3>(share.first + 3);
  row.tag_m.head<2>() += error.head<2>() + error.z() * row.yaw_arm_m;
  row.tag_m -= step(unknowns.delay()) * row.velocity_mps;
}

Eigen::MatrixXd prior_information(const SharedUnknowns& unknowns, const SharedPrior& prior) {
  // Of a first-order process at equal steps: tridiagonal.
  const Knots& knots = unknowns.knots;
  const double keep = kept_share(knots, prior.wander);
  const double fresh = 1.0 / (1.0 - keep * keep);
  Eigen::MatrixXd out = Eigen::MatrixXd::Zero(unknowns.size(), unknowns.size());
  const double shift = inverse_square(std::max(prior.wander.sigma_m, kLeastSigma_m));
  const double turn = inverse_square(std::max(prior.wander.sigma_yaw_rad, kLeastSigma_rad));
  const std::array<double, 3> inverse{shift, shift, turn};
  for (Eigen::Index k = 0; k < knots.count; ++k) {
    const bool inner = k > 0 && k + 1 < knots.count;
    for (Eigen::Index axis = 0; axis < 3; ++axis) {
      const double scale = inverse[static_cast<std::size_t>(axis)] * fresh;
      const Eigen::Index here = 3 * k + axis;
      out(here, here) = scale * (inner ? 1.0 + keep * keep : 1.0);
      if (k + 1 == knots.count) continue;
      out(here, here + 3) = -scale * keep;
      out(here + 3, here) = -scale * keep;
    }
  }
  out(unknowns.delay(), unknowns.delay()) = inverse_square(prior.delay_sigma_s);
  for (std::size_t tag = 0; tag < unknowns.body_tags; ++tag) {
    out.diagonal().segment<kBodyTerms>(unknowns.body(tag)) = body_information();
  }
  return out;
}

double prior_log_determinant(const SharedUnknowns& unknowns, const SharedPrior& prior) {
  double out = -2.0 * std::log(prior.delay_sigma_s);
  if (prior.wander.sigma_m > 0.0) {
    // A first-order process is a product of its steps.
    const double keep = kept_share(unknowns.knots, prior.wander);
    const auto n = static_cast<double>(unknowns.knots.count);
    out -= n * (4.0 * std::log(prior.wander.sigma_m) + 2.0 * std::log(prior.wander.sigma_yaw_rad)) +
           3.0 * (n - 1.0) * std::log1p(-keep * keep);
  }
  if (prior.body) {
    out += static_cast<double>(unknowns.body_tags) * body_information().array().log().sum();
  }
  return out;
}

}  // namespace groma::calibration
