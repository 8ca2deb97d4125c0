#include "test/host/calibration/blocked_site.hpp"

namespace groma::test {

bool crosses(const PlanWall& wall, const Eigen::Vector2d& a, const Eigen::Vector2d& b) {
  const auto side = [](const Eigen::Vector2d& p, const Eigen::Vector2d& q, const Eigen::Vector2d& r) {
    return (q - p).x() * (r - p).y() - (q - p).y() * (r - p).x() > 0.0;
  };
  return side(a, b, wall.from_m) != side(a, b, wall.to_m) &&
         side(wall.from_m, wall.to_m, a) != side(wall.from_m, wall.to_m, b);
}

SiteSettings polled_settings(Route route, double duration_s) {
  SiteSettings settings;
  settings.route = route;
  settings.duration_s = duration_s;
  settings.ranges_per_pair = static_cast<std::size_t>(duration_s / 0.12);
  settings.sigma_m = 0.08;
  settings.pose_sigma_m = 0.014;
  settings.pose_yaw_sigma_rad = 0.0027;
  return settings;
}

void add_powers(Powers powers, double blocked_share, Random& random, model::RangeSample& range) {
  constexpr double kLos_dbm = -60.0;  // at 1 m
  constexpr double kLoss_db = 6.0;
  constexpr double kSigma_db = 2.0;
  constexpr double kPeriod_s = 14.0;
  double weak = 0.0;
  switch (powers) {
    case Powers::kNone:
      return;
    case Powers::kTrue:
      weak = blocked_share;
      break;
    case Powers::kOpposite:
      weak = 1.0 - blocked_share;
      break;
    case Powers::kNothing:
      weak = std::fmod(range.t_s + range.anchor_id, kPeriod_s) < 0.5 * kPeriod_s ? 1.0 : 0.0;
  }
  const double first_path_dbm = kLos_dbm - 20.0 * std::log10(std::max(range.range_m, 0.1)) - kLoss_db * weak +
                                kSigma_db * random.gaussian();
  range.first_path_power_dbm = static_cast<float>(first_path_dbm);
  range.receive_power_dbm = static_cast<float>(first_path_dbm + 2.0 + weak);
}

SimulatedSite blocked_site(const SiteSettings& settings, const Blocking& blocking, std::uint64_t seed,
                           const std::vector<Stay>& stays) {
  SimulatedSite site = simulate_site(settings, seed);
  Random random(seed + 1000);
  Random radio(seed + 2000);
  struct Span {
    double from_s;
    double to_s;
  };
  std::vector<std::vector<std::vector<Span>>> short_nlos_spans(
      site.anchors.size(), std::vector<std::vector<Span>>(site.tags.size()));
  for (auto& of_anchor : short_nlos_spans) {
    for (std::vector<Span>& of_pair : of_anchor) {
      double t_s = 0.0;
      while (blocking.shadows_per_s > 0.0) {
        t_s += -std::log(1.0 - random.uniform()) / blocking.shadows_per_s;
        if (t_s > settings.duration_s) break;
        of_pair.push_back({t_s, t_s + random.uniform(1.0, 10.0)});
        t_s = of_pair.back().to_s;
      }
    }
  }
  std::vector<model::RangeSample> kept;
  for (model::RangeSample range : site.ranges) {
    const std::size_t a = range.anchor_id - site.anchors.front().id;
    const std::size_t j = range.tag_id - site.tags.front().id;
    const Eigen::Vector3d antenna_m = antenna_of(true_pose(range.t_s, settings.route), site.tags[j]);
    Eigen::Vector3d anchor_m = site.anchors[a].position_m;
    for (const Stay& stay : stays) {
      if (stay.anchor != a || range.t_s < stay.from_s || range.t_s >= stay.to_s) continue;
      const double before_m = (antenna_m - anchor_m).norm();
      anchor_m += stay.by_m;
      range.range_m += site.gamma[a][j] * ((antenna_m - anchor_m).norm() - before_m);
    }
    double reply = blocking.reply_los;
    bool walled = false;
    double blocked_share = 0.0;
    for (const PlanWall& wall : blocking.walls) {
      walled = walled || crosses(wall, antenna_m.head<2>(), anchor_m.head<2>());
    }
    const auto exponential_m = [&](double mean_m) { return -mean_m * std::log(1.0 - random.uniform()); };
    if (walled) {
      reply = blocking.long_nlos_reply;
      blocked_share = 1.0;
      range.range_m += blocking.excess_m + exponential_m(blocking.long_nlos_excess_mean_m);
    } else {
      for (const Span& short_nlos : short_nlos_spans[a][j]) {
        if (range.t_s < short_nlos.from_s || range.t_s > short_nlos.to_s) continue;
        reply = blocking.short_nlos_reply;
        blocked_share = 0.6;
        range.range_m += exponential_m(blocking.short_nlos_excess_mean_m);
      }
    }
    if (random.uniform() < blocking.gross_share) range.range_m += random.uniform(0.5, 4.0);
    add_powers(blocking.powers, blocked_share, radio, range);
    if (random.uniform() < reply) kept.push_back(range);
  }
  site.ranges = std::move(kept);
  return site;
}

}  // namespace groma::test
