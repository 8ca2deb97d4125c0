#include "host/diagnosis/odometry_check.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <memory>
#include <numbers>
#include <optional>
#include <span>
#include <string>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Core>
#include <Eigen/Geometry>

#include "host/diagnosis/dead_reckoning.hpp"
#include "host/diagnosis/slice_gain.hpp"
#include "host/diagnosis/student.hpp"
#include "host/diagnosis/thresholds.hpp"
#include "host/diagnosis/units.hpp"
#include "host/model/pose.hpp"

namespace groma::diagnosis {
namespace {

// By hand: long enough for motion above the poses' noise, short enough for changes of speed and turn to show
// a clock.
constexpr double kWindow_s = 1.0;
constexpr std::size_t kMinWindows = 15;

struct Window {
  double from_s = 0.0;
  double to_s = 0.0;
  Eigen::Vector2d moved_m = Eigen::Vector2d::Zero();  // in base_link at from_s, by the poses
  double turned_rad = 0.0;
};

// Motion within a window, by the odometry.
struct Step {
  Eigen::Vector2d moved_m = Eigen::Vector2d::Zero();
  double turned_rad = 0.0;
};

// What is estimated; the odometry's clock is late by clock_s + drift (t - middle).
enum : Eigen::Index { kClock, kDrift, kHeading, kSpeedScale, kYawScale, kBias, kUnknowns };
using Unknowns = Eigen::Matrix<double, kUnknowns, 1>;

struct Flips {
  bool heading = false;
  bool lateral = false;
};
constexpr std::array kFlips{Flips{}, Flips{.heading = true}, Flips{.lateral = true}};

std::vector<Window> windows_of(const std::vector<model::PoseSample>& poses, bool flips_heading,
                               double window_s) {
  std::vector<Window> out;
  const double sign = flips_heading ? -1.0 : 1.0;
  std::size_t from = 0;
  for (std::size_t i = 1; i < poses.size(); ++i) {
    if (poses[i].t_s - poses[i - 1].t_s > kMaxPoseGap_s) {
      from = i;
      continue;
    }
    if (poses[i].t_s - poses[from].t_s < window_s - 1e-6) continue;
    const double yaw_rad = sign * poses[from].yaw_rad;
    const double dx = poses[i].x_m - poses[from].x_m;
    const double dy = poses[i].y_m - poses[from].y_m;
    out.push_back(
        {poses[from].t_s,
         poses[i].t_s,
         {std::cos(yaw_rad) * dx + std::sin(yaw_rad) * dy, std::cos(yaw_rad) * dy - std::sin(yaw_rad) * dx},
         model::wrap_angle(sign * (poses[i].yaw_rad - poses[from].yaw_rad))});
    from = i;
  }
  return out;
}

class Comparison {
 public:
  Comparison(const Comparison&) = delete;
  Comparison& operator=(const Comparison&) = delete;
  Comparison(const Data& data, Flips flips, double window_s = kWindow_s)
      : odometry_(data.odometry), windows_(windows_of(data.poses, flips.heading, window_s)) {
    if (flips.lateral) {
      for (model::OdometrySample& sample : odometry_) sample.vy_mps = -sample.vy_mps;
    }
    if (!windows_.empty()) {
      middle_s_ = 0.5 * (windows_.front().from_s + windows_.back().to_s);
      duration_s_ = windows_.back().to_s - windows_.front().from_s;
    }
  }

  [[nodiscard]] std::size_t size() const noexcept { return windows_.size(); }
  [[nodiscard]] double middle_s() const noexcept { return middle_s_; }
  [[nodiscard]] double duration_s() const noexcept { return duration_s_; }
  [[nodiscard]] const std::vector<Window>& windows() const noexcept { return windows_; }

  // Poses minus odometry: turns first, then x and y of each window; NaN without odometry.
  [[nodiscard]] Eigen::VectorXd residuals(const Unknowns& at) const {
    const auto n = std::ssize(windows_);
    Eigen::VectorXd out(3 * n);
    const Eigen::Rotation2Dd back(-at(kHeading));
    for (std::ptrdiff_t i = 0; i < n; ++i) {
      const Window& window = windows_[static_cast<std::size_t>(i)];
      const Step step = integrate(window, at);
      out(i) = model::wrap_angle(window.turned_rad - step.turned_rad);
      // A heading that is given too large turns the motion in base_link back.
      out.segment<2>(n + 2 * i) = window.moved_m - back * step.moved_m;
    }
    return out;
  }

  // Correlation of speed and turn of the poses with the odometry's, with its clock late by lag_s: 0 to 2.
  [[nodiscard]] double correlation(double lag_s, double from_s, double to_s) const {
    Eigen::Array<double, 5, 1> v = Eigen::Array<double, 5, 1>::Zero();
    Eigen::Array<double, 5, 1> w = Eigen::Array<double, 5, 1>::Zero();
    double n = 0.0;
    std::size_t possible = 0;
    Unknowns at = neutral();
    at(kClock) = lag_s;
    for (const Window& window : windows_) {
      if (window.from_s < from_s || window.to_s > to_s) continue;
      ++possible;
      const Step step = integrate(window, at);
      if (!std::isfinite(step.turned_rad)) continue;
      const auto add = [](Eigen::Array<double, 5, 1>& sums, double a, double b) {
        sums += Eigen::Array<double, 5, 1>(a, b, a * a, b * b, a * b);
      };
      add(v, window.moved_m.norm(), step.moved_m.norm());
      add(w, window.turned_rad, step.turned_rad);
      n += 1.0;
    }
    if (2.0 * n < static_cast<double>(possible) || n < static_cast<double>(kMinWindows) / 2.0) return 0.0;
    const auto of = [n](const Eigen::Array<double, 5, 1>& s) {
      const double a = s(2) - s(0) * s(0) / n;
      const double b = s(3) - s(1) * s(1) / n;
      return a > 0.0 && b > 0.0 ? (s(4) - s(0) * s(1) / n) / std::sqrt(a * b) : 0.0;
    };
    return std::max(0.0, of(v)) + std::abs(of(w));
  }

  [[nodiscard]] static Unknowns neutral() {
    Unknowns out = Unknowns::Zero();
    out(kSpeedScale) = out(kYawScale) = 1.0;
    return out;
  }

 private:
  [[nodiscard]] Step integrate(const Window& window, const Unknowns& at) const {
    const DeadReckoning::YawRateError yaw_rate{.scale = at(kYawScale)};
    if (!path_ || path_->yaw_rate() != yaw_rate) path_.emplace(odometry_, yaw_rate);
    const auto on_its_clock = [&](double t_s) { return t_s + at(kClock) + at(kDrift) * (t_s - middle_s_); };
    const DeadReckoning::Place from = path_->at(on_its_clock(window.from_s));
    const DeadReckoning::Place to = path_->at(on_its_clock(window.to_s));
    return {Eigen::Rotation2Dd(-from.heading_rad) * (to.position_m - from.position_m) / at(kSpeedScale),
            to.heading_rad - from.heading_rad - at(kBias) * (window.to_s - window.from_s)};
  }

  std::vector<model::OdometrySample> odometry_;
  mutable std::optional<DeadReckoning> path_;  // with the yaw-rate scale that was asked for last
  std::vector<Window> windows_;
  double middle_s_ = 0.0;
  double duration_s_ = 0.0;
};

struct Estimate {
  Unknowns at = Comparison::neutral();
  Unknowns sigma = Unknowns::Zero();
  double cost = std::numeric_limits<double>::infinity();  // -log likelihood a window
  std::vector<double> slice_cost;                         // of each slice; NaN: no window
  double turn_scale_rad = 1.0;
  double move_scale_m = 1.0;
};

// Scales below these are better than any pose. By hand.
constexpr double kLeastTurn_rad = 1e-4;
constexpr double kLeastMove_m = 1e-4;

// Of drift and bias, which at constant speed and turn are scales: by hand, far more than good clocks and
// odometry have.
const Unknowns kPriorInformation =
    (Unknowns() << 0.0, 1.0 / (0.01 * 0.01), 0.0, 0.0, 0.0, 1.0 / (0.02 * 0.02)).finished();

// -log likelihood a window with both scales profiled.
void score(const Eigen::VectorXd& r, Estimate& out, int iterations) {
  const auto n = static_cast<std::size_t>(r.size() / 3);
  const std::span<const double> turns(r.data(), n);
  const std::span<const double> moves(r.data() + n, 2 * n);
  out.turn_scale_rad = student_scale(turns, out.turn_scale_rad, kLeastTurn_rad, iterations);
  out.move_scale_m = student_scale(moves, out.move_scale_m, kLeastMove_m, iterations);
  std::vector<StudentCost> turn_costs(kSlices, StudentCost(out.turn_scale_rad));
  std::vector<StudentCost> move_costs(kSlices, StudentCost(out.move_scale_m));
  for (std::size_t i = 0; i < 3 * n; ++i) {
    const double residual = r(static_cast<Eigen::Index>(i));
    if (!std::isfinite(residual)) continue;
    const std::size_t slice = (i < n ? i : (i - n) / 2) * kSlices / n;
    (i < n ? turn_costs : move_costs)[slice].add(residual);
  }
  double sum = 0.5 * out.at.cwiseAbs2().dot(kPriorInformation);
  double count = 0.0;
  out.slice_cost.clear();
  for (std::size_t k = 0; k < turn_costs.size(); ++k) {
    const double cost = turn_costs[k].sum() + move_costs[k].sum();
    const double windows = static_cast<double>(turn_costs[k].count() + move_costs[k].count()) / 3.0;
    out.slice_cost.push_back(cost / windows);
    sum += cost;
    count += windows;
  }
  out.cost = 2.0 * count < static_cast<double>(n) ? std::numeric_limits<double>::infinity() : sum / count;
}

// Steps of the numerical derivatives; by hand: small against each limit. Those of the clock are half a
// window, at the drive's ends: over shorter ones the odometry's noise would look like changes of the speed,
// by which the clock shows, and make the clock look twice as certain as it is.
Unknowns steps_of(const Comparison& comparison) {
  return (Unknowns() << 0.5 * kWindow_s, kWindow_s / std::max(kWindow_s, comparison.duration_s()), 1e-4, 1e-4,
          1e-4, 1e-5)
      .finished();
}

// Levenberg-Marquardt on the robust cost from a start.
Estimate estimate(const Comparison& comparison, const Unknowns& start, bool with_clock = true) {
  Estimate best;
  best.at = start;
  Eigen::VectorXd r = comparison.residuals(start);
  score(r, best, 30);
  if (!std::isfinite(best.cost)) return best;
  const auto n = r.size() / 3;
  double damping = 1e-3;
  Eigen::Matrix<double, kUnknowns, kUnknowns> information;
  Eigen::Matrix<double, kUnknowns, kSlices> scores;
  const Unknowns steps = steps_of(comparison);
  for (int iteration = 0; iteration < 40; ++iteration) {
    Eigen::MatrixXd j(r.size(), kUnknowns);
    for (Eigen::Index k = 0; k < kUnknowns; ++k) {
      const bool is_of_clock = k == kClock || k == kDrift;
      if (is_of_clock && !with_clock) {
        j.col(k).setZero();
        continue;
      }
      Unknowns moved = best.at;
      moved(k) += steps(k);
      j.col(k) = comparison.residuals(moved);
      if (is_of_clock) {
        moved(k) = best.at(k) - steps(k);
        j.col(k) = 0.5 * (j.col(k) - comparison.residuals(moved)) / steps(k);
      } else {
        j.col(k) = (j.col(k) - r) / steps(k);
      }
    }
    information = (kPriorInformation + 1e-9 * steps.cwiseInverse().cwiseAbs2()).asDiagonal();
    scores.setZero();
    for (Eigen::Index i = 0; i < r.size(); ++i) {
      if (!std::isfinite(r(i)) || !j.row(i).allFinite()) continue;
      const double scale = i < n ? best.turn_scale_rad : best.move_scale_m;
      const double weight = student_weight(r(i), scale) / (scale * scale);
      information += weight * j.row(i).transpose() * j.row(i);
      const Eigen::Index window = i < n ? i : (i - n) / 2;
      scores.col(window * kSlices / n) -= weight * r(i) * j.row(i).transpose();
    }
    const Unknowns score_sum = scores.rowwise().sum() - kPriorInformation.cwiseProduct(best.at);
    bool improved = false;
    double gained = 0.0;
    for (int attempt = 0; attempt < 8 && !improved; ++attempt) {
      Eigen::Matrix<double, kUnknowns, kUnknowns> damped = information;
      damped.diagonal() *= 1.0 + damping;
      Estimate next = best;
      next.at += damped.ldlt().solve(score_sum);
      const Eigen::VectorXd moved = comparison.residuals(next.at);
      score(moved, next, 3);
      improved = next.cost < best.cost;
      damping = improved ? std::max(1e-9, 0.2 * damping) : 6.0 * damping;
      if (!improved) continue;
      gained = best.cost - next.cost;
      best = next;
      r = moved;
    }
    if (!improved || gained < 1e-7) break;
  }
  // Covariance from the scatter of the slices' scores, which holds for errors that are correlated in time.
  const Eigen::Matrix<double, kUnknowns, kUnknowns> inverse =
      information.ldlt().solve(Eigen::Matrix<double, kUnknowns, kUnknowns>::Identity());
  const Eigen::Matrix<double, kUnknowns, kUnknowns> covariance =
      inverse * (scores * scores.transpose()) * inverse + inverse;
  best.sigma = covariance.diagonal().cwiseMax(0.0).cwiseSqrt();
  return best;
}

// Where the drive's speeds and turns of poses and odometry are most alike; zero unless another lag is clearly
// better. By hand: up to a minute, in steps of a fifth of a window.
double best_lag_s(const Comparison& comparison, double from_s, double to_s) {
  constexpr double kMost_s = 60.0;
  constexpr double kStep_s = 0.2;
  constexpr double kClearly = 0.05;
  double best_s = 0.0;
  double best = comparison.correlation(0.0, from_s, to_s) + kClearly;
  for (double lag_s = kStep_s; lag_s <= kMost_s; lag_s += kStep_s) {
    for (const double signed_s : {lag_s, -lag_s}) {
      const double correlation = comparison.correlation(signed_s, from_s, to_s);
      if (correlation > best) {
        best = correlation;
        best_s = signed_s;
      }
    }
  }
  return best_s;
}

// The heading offset that turns the odometry's motion into the poses' best; and its scale, if that is a
// unit's.
void add_heading_and_unit(const Comparison& comparison, Unknowns& start) {
  const Eigen::VectorXd r = comparison.residuals(start);
  const auto n = static_cast<Eigen::Index>(comparison.size());
  double dot = 0.0;
  double cross = 0.0;
  double odometry_m2 = 0.0;
  double poses_m2 = 0.0;
  for (Eigen::Index i = 0; i < n; ++i) {
    if (!std::isfinite(r(i))) continue;
    const Eigen::Vector2d& poses = comparison.windows()[static_cast<std::size_t>(i)].moved_m;
    const Eigen::Vector2d odometry = poses - r.segment<2>(n + 2 * i);
    dot += odometry.dot(poses);
    cross += odometry.x() * poses.y() - odometry.y() * poses.x();
    odometry_m2 += odometry.squaredNorm();
    poses_m2 += poses.squaredNorm();
  }
  const double scale = std::sqrt(odometry_m2 / poses_m2);
  if (std::isfinite(scale) && scale > 2.0) start(kSpeedScale) *= scale;  // by hand: feet are 3.3
  start(kHeading) = -std::atan2(cross, dot);
}

struct Clock {
  double offset_s = 0.0;
  double drift = 0.0;
};

// The clock as given, and at the lags of the whole drive and of its halves. No flip changes them.
std::array<Clock, 3> likely_clocks(const Comparison& comparison) {
  const double middle_s = comparison.middle_s();
  const double half_s = 0.5 * comparison.duration_s();
  const double lag_s = best_lag_s(comparison, middle_s - half_s, middle_s + half_s);
  const double first_s = best_lag_s(comparison, middle_s - half_s, middle_s);
  const double last_s = best_lag_s(comparison, middle_s, middle_s + half_s);
  return {{{}, {lag_s, 0.0}, {0.5 * (first_s + last_s), (last_s - first_s) / half_s}}};
}

// From the likeliest of several starts: each clock, with the yaw rate of either sign, and in degrees per
// second.
Estimate best_estimate(const Comparison& comparison, std::span<const Clock> clocks) {
  constexpr std::size_t kImproved = 2;  // by hand: of nine, all others are clearly worse
  std::vector<Estimate> starts;
  for (const Clock& clock : clocks) {
    for (const double yaw_scale : {1.0, -1.0, kDegrees.factor}) {
      Estimate& start = starts.emplace_back();
      start.at(kClock) = clock.offset_s;
      start.at(kDrift) = clock.drift;
      start.at(kYawScale) = yaw_scale;
      add_heading_and_unit(comparison, start.at);
      score(comparison.residuals(start.at), start, 30);
    }
  }
  std::stable_sort(starts.begin(), starts.end(),
                   [](const Estimate& a, const Estimate& b) { return a.cost < b.cost; });
  Estimate best;
  for (const Estimate& start : std::span(starts).first(kImproved)) {
    const Estimate found = estimate(comparison, start.at);
    if (found.cost < best.cost) best = found;
  }
  return best;
}

// The estimate without a clock error, if the clock error is not certain: at constant speed and turn, odometry
// that is shifted by any time may fit a little better, by its noise.
Estimate without_uncertain_clock(const Comparison& comparison, const Estimate& best) {
  Unknowns start = best.at;
  start(kClock) = start(kDrift) = 0.0;
  const Estimate still = estimate(comparison, start, false);
  // In sigmas of the slices' gains (Vuong's test); by hand: of a clock nearby, and of the best of 600 lags.
  constexpr double kNear = 2.0;
  constexpr double kFar = 3.7;
  const bool is_far =
      std::abs(best.at(kClock)) + std::abs(0.5 * best.at(kDrift) * comparison.duration_s()) > kWindow_s;
  return gain_in_sigmas(best.slice_cost, still.slice_cost) < (is_far ? kFar : kNear) ? still : best;
}

// Robust size of the windows' motion: the scale of residuals that compare it with nothing.
std::pair<double, double> motion_of(const Comparison& comparison) {
  Estimate none;
  const auto n = static_cast<Eigen::Index>(comparison.size());
  Eigen::VectorXd motion(3 * n);
  for (Eigen::Index i = 0; i < n; ++i) {
    const Window& window = comparison.windows()[static_cast<std::size_t>(i)];
    motion(i) = window.turned_rad;
    motion.segment<2>(n + 2 * i) = window.moved_m;
  }
  score(motion, none, 50);
  return {none.turn_scale_rad, none.move_scale_m};
}

// Whether the odometry's turns explain the poses' better than no turns do. Those of a straight drive are
// noise, and any ratio of two noises fits.
bool shows_turns(const Comparison& comparison, const Estimate& best) {
  // In sigmas of the slices' gains. By hand: 16 straight drives (simulated) have up to 1.8, each drive with a
  // turn 4.4 or more.
  constexpr double kShown = 2.7;
  constexpr double kNoTurns = 1e9;
  Estimate without = best;
  without.at(kYawScale) = kNoTurns;
  score(comparison.residuals(without.at), without, 30);
  return gain_in_sigmas(best.slice_cost, without.slice_cost) > kShown;
}

// Whether odometry and poses differ whatever is assumed of clock, heading and scale.
std::optional<Finding> contradiction(const Data& data, Flips flips, Estimate best) {
  // By hand: over 2 s the noise of poses, 0.03 m white, is a small part of the motion.
  constexpr double kLonger_s = 2.0;
  constexpr double kLeastMotion_rad = 0.02 * kLonger_s;
  // Shares of the motion that odometry leaves unexplained: up to 0.03 and 0.10 in the recorded and simulated
  // runs, from 0.18 and 0.79 on where it is of another drive.
  constexpr double kMostMoveLeft = 0.10;
  constexpr double kMostTurnLeft = 0.3;
  // By hand: clocks are good to 0.01 %; so much is another drive that resembles this one.
  constexpr double kMostDrift = 0.05;
  const Comparison longer(data, flips, kLonger_s);
  const auto [turns_rad, moves_m] = motion_of(longer);
  score(longer.residuals(best.at), best, 30);
  const bool turns_fit = turns_rad < kLeastMotion_rad || best.turn_scale_rad < kMostTurnLeft * turns_rad;
  const bool clock_fits = std::abs(best.at(kDrift)) < kMostDrift;
  if (best.move_scale_m < kMostMoveLeft * moves_m && turns_fit && clock_fits) return std::nullopt;
  return Finding{
      .cause = "poses-contradict-odometry",
      .evidence = fmt::format("poses and odometry differ by {:.2f} m and {:.2f} rad in {:.0f} s, of {:.2f} m "
                              "and {:.2f} rad moved, whatever clock, heading and scale are assumed",
                              best.move_scale_m, best.turn_scale_rad, kLonger_s, moves_m, turns_rad),
      .remedy = "check that both are of one drive and one robot, and that the poses do not jump"};
}

class Naming {
 public:
  Naming(const Estimate& estimate, const Comparison& comparison)
      : estimate_(estimate), comparison_(comparison) {}

  [[nodiscard]] bool differs(Eigen::Index unknown, double neutral, double least) const {
    const double error = std::abs(estimate_.at(unknown) - neutral);
    return error > least && error > kSignificance * estimate_.sigma(unknown);
  }
  void add(std::string_view cause, std::string evidence, std::string remedy,
           std::optional<double> value = std::nullopt, std::optional<double> sigma = std::nullopt) {
    Finding& finding = findings.emplace_back(
        Finding{.cause = cause, .evidence = std::move(evidence), .remedy = std::move(remedy)});
    if (value) finding.value = {*value};
    if (sigma) finding.sigma = {*sigma};
  }
  [[nodiscard]] double sigma(Eigen::Index unknown, double systematic) const {
    return std::hypot(estimate_.sigma(unknown), systematic);
  }

  void name_clock(Data& data) {
    const Unknowns& at = estimate_.at;
    const double spread_s = at(kDrift) * comparison_.duration_s();
    const bool drifts = differs(kDrift, 0.0, kLeastDrift_s / comparison_.duration_s());
    if (drifts) {
      add("clock-drift",
          fmt::format("the odometry's clock and the poses' separate by {:.2f} s over the drive",
                      std::abs(spread_s)),
          "timestamp odometry and poses with one clock", -at(kDrift),
          sigma(kDrift, kDriftSystematic_s / comparison_.duration_s()));
    } else if (differs(kClock, 0.0, kLeastClock_s)) {
      add("clock-offset",
          fmt::format("the odometry's times are {:.3f} s {} against the poses'", std::abs(at(kClock)),
                      at(kClock) > 0.0 ? "late" : "early"),
          fmt::format("shift the times of the odometry by {:+.3f} s, or those of the poses by {:+.3f} s",
                      -at(kClock), at(kClock)),
          -at(kClock), sigma(kClock, kClockSystematic_s));
    } else {
      return;
    }
    findings.back().is_of_odometry_alone = true;
    // The inverse of t_s + clock + drift (t_s - middle).
    for (model::OdometrySample& sample : data.odometry) {
      sample.t_s = comparison_.middle_s() +
                   (sample.t_s - comparison_.middle_s() - at(kClock)) / (1.0 + (drifts ? at(kDrift) : 0.0));
    }
  }

  void name_heading(Data& data, bool flipped) {
    const double offset_rad = model::wrap_angle(estimate_.at(kHeading));
    if (flipped) {
      add("heading-sign", "the poses' heading and the robot's motion agree if the heading changes its sign",
          "count the yaw of the poses counter-clockwise, from above");
      for (model::PoseSample& pose : data.poses) pose.yaw_rad = -pose.yaw_rad;
    }
    if (!differs(kHeading, 0.0, kLeastHeading_rad)) return;
    add("heading-offset",
        fmt::format("the poses' heading is {:.1f} degrees off the direction in which the robot moves",
                    offset_rad * kDegrees.factor),
        "give the yaw of base_link's x axis (forward) in the poses, or turn the odometry into base_link",
        offset_rad, sigma(kHeading, kHeadingSystematic_rad));
    for (model::PoseSample& pose : data.poses) pose.yaw_rad = model::wrap_angle(pose.yaw_rad - offset_rad);
  }

  void name_lateral(Data& data) {
    add("lateral-sign", "the odometry's lateral speed and the poses' agree if it changes its sign",
        "count vy_mps positive to the left");
    findings.back().is_of_odometry_alone = true;
    for (model::OdometrySample& sample : data.odometry) sample.vy_mps = -sample.vy_mps;
  }

  void name_yaw_rate(Data& data) {
    const std::size_t before = findings.size();
    const double yaw_scale = estimate_.at(kYawScale);
    const double size = std::abs(yaw_scale);
    if (yaw_scale < 0.0 && differs(kYawScale, 0.0, 0.2)) {
      add("yaw-rate-sign", "the odometry turns the other way than the poses",
          "count omega_radps positive to the left (counter-clockwise, from above)");
    }
    // By hand: a yaw rate is named before its scale only if it is nearly that of the unit.
    if (std::abs(std::log(size / kDegrees.factor)) < 0.3) {
      add("angle-unit",
          fmt::format("the odometry turns {:.1f} times as fast as the poses: it is in degrees", size),
          "give omega_radps in radians per second", kDegrees.factor);
    } else if (std::abs(size - 1.0) > kLeastScale &&
               std::abs(size - 1.0) > kSignificance * estimate_.sigma(kYawScale)) {
      add("yaw-rate-scale", fmt::format("the odometry turns {:.3f} times as fast as the poses", size),
          fmt::format("divide omega_radps by {:.3f}, or check the track width", size), size,
          sigma(kYawScale, kScaleSystematic));
    }
    are_of_odometry_alone(before);
    for (model::OdometrySample& sample : data.odometry) sample.omega_radps /= yaw_scale;
  }

  void name_speed(Data& data) {
    const std::size_t before = findings.size();
    const double speed_scale = estimate_.at(kSpeedScale);
    if (const auto unit = unit_of(kLengthUnits, speed_scale, 0.1)) {
      add("length-unit",
          fmt::format("the odometry moves {:.3g} times as far as the poses: it is in {}", speed_scale,
                      unit->name),
          "give vx_mps and vy_mps in metres per second", unit->factor);
    } else if (differs(kSpeedScale, 1.0, kLeastScale)) {
      add("odometry-scale", fmt::format("the odometry moves {:.3f} times as far as the poses", speed_scale),
          fmt::format("divide vx_mps and vy_mps by {:.3f}, or check the wheels' diameter", speed_scale),
          speed_scale, sigma(kSpeedScale, kScaleSystematic));
    }
    are_of_odometry_alone(before);
    for (model::OdometrySample& sample : data.odometry) {
      sample.vx_mps /= speed_scale;
      sample.vy_mps /= speed_scale;
    }
  }

  std::vector<Finding> findings;

 private:
  // The findings from this index on.
  void are_of_odometry_alone(std::size_t first) {
    for (std::size_t i = first; i < findings.size(); ++i) findings[i].is_of_odometry_alone = true;
  }

  const Estimate& estimate_;
  const Comparison& comparison_;
};

}  // namespace

OdometryComparison compare_with_odometry(Data& data) {
  if (data.odometry.size() < 2) return {};
  std::unique_ptr<Comparison> comparison;
  std::array<Clock, 3> clocks;
  Estimate best;
  Flips flips;
  for (const Flips& tried : kFlips) {
    auto with = std::make_unique<Comparison>(data, tried);
    if (with->size() < kMinWindows) return {};
    if (!comparison) clocks = likely_clocks(*with);
    const Estimate found = best_estimate(*with, clocks);
    // By hand: a wrong sign costs far more than this of the log likelihood of a window, or is of no
    // consequence.
    constexpr double kFlipGain = 0.3;
    if (!(found.cost < best.cost - (comparison ? kFlipGain : 0.0))) continue;
    comparison = std::move(with);
    best = found;
    flips = tried;
  }
  if (!comparison) return {};
  best = without_uncertain_clock(*comparison, best);
  // By hand: a robot that hardly moves shows nothing.
  constexpr double kLeastMotion_m = 0.05;
  if (motion_of(*comparison).second < kLeastMotion_m) return {};
  if (std::optional<Finding> found = contradiction(data, flips, best)) return {{std::move(*found)}};
  Naming naming(best, *comparison);
  naming.name_heading(data, flips.heading);
  if (flips.lateral) naming.name_lateral(data);
  if (shows_turns(*comparison, best)) naming.name_yaw_rate(data);
  naming.name_speed(data);
  naming.name_clock(data);
  return {std::move(naming.findings), true};
}

}  // namespace groma::diagnosis
