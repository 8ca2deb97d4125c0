#include "host/diagnosis/hypothesis.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <future>
#include <limits>
#include <numbers>
#include <string>
#include <utility>

#include <Eigen/Cholesky>
#include <Eigen/Geometry>

#include "host/diagnosis/slice_gain.hpp"
#include "host/diagnosis/thresholds.hpp"
#include "host/diagnosis/units.hpp"
#include "host/model/pose.hpp"

namespace groma::diagnosis {
namespace {

constexpr std::size_t kMostSearchRows = 600;
constexpr std::size_t kMinRows = 200;
// Where residuals are smaller than this many configured sigmas, a clock is off by little or not at all. By
// hand.
constexpr double kFarSigmas = 1.5;
// A hypothesis is named only if the mean of the slices' gains in log likelihood is this many of its standard
// errors above zero (Vuong's test): errors within a slice may be correlated. By hand: one of fifty by chance,
// beside kSignificance for the size.
constexpr double kLeastGainSigmas = 2.0;
// It is enough to be this many above zero where the gain is large, in log likelihood of a range: a robot that
// moves in few slices shows a mistake in these alone. By hand: without a mistake, no hypothesis of a named
// size gains more than 0.002 in any run.
constexpr double kLargeGain = 0.2;
constexpr double kLargeGainSigmas = 1.6;
// A drift is an offset and more, which are certain together. To tell it from an offset needs less. By hand.
constexpr double kDriftSignificance = 3.0;

constexpr double kInfinity = std::numeric_limits<double>::infinity();

Parameters with(std::initializer_list<double> start, std::initializer_list<double> sigma,
                std::initializer_list<double> step, std::function<Mistake(const Eigen::VectorXd&)> mistake) {
  const auto vector = [](std::initializer_list<double> of) {
    return Eigen::VectorXd(
        Eigen::Map<const Eigen::VectorXd>(of.begin(), static_cast<Eigen::Index>(of.size())));
  };
  return {vector(start), vector(sigma), vector(step), std::move(mistake)};
}
Parameters far(Parameters parameters) {
  parameters.is_neutral = false;
  return parameters;
}

bool is_certain(const RangeFit& fit, Eigen::Index parameter, double value) {
  return std::abs(value) > kSignificance * std::sqrt(fit.covariance(parameter, parameter));
}
double sigma_of(const RangeFit& fit, Eigen::Index parameter, double systematic) {
  return std::hypot(std::sqrt(std::max(0.0, fit.covariance(parameter, parameter))), systematic);
}

std::string late(double offset_s) {
  return fmt::format("{:.3f} s {}", std::abs(offset_s), offset_s > 0.0 ? "late" : "early");
}

// The clock offset under which a few ranges fit best, of a grid that is dense near zero. By hand: up to half
// a minute.
double best_offset_s(const Data& data, const MakeScene& make_scene) {
  std::vector<double> steps_s{0.0};
  for (double step_s = 0.2; step_s < 30.0; step_s = std::max(step_s + 0.4, 1.15 * step_s))
    steps_s.push_back(step_s);
  const auto best_of = [&](double sign) {
    const auto few = make_scene(data, kMostSearchRows);
    std::pair<double, double> best{kInfinity, 0.0};  // cost and offset
    for (const double step_s : steps_s) {
      Parameters none;
      none.mistake = [offset_s = sign * step_s](const Eigen::VectorXd&) {
        return Mistake{.clock = {.offset_s = offset_s}};
      };
      const RangeFit fit = fit_ranges(*few, none, 0);
      if (2 * fit.rows >= few->rows().size() && fit.cost < best.first) best = {fit.cost, sign * step_s};
    }
    return best;
  };
  auto early = std::async(std::launch::async, best_of, -1.0);
  const auto late = best_of(1.0);
  return std::min(late, early.get()).second;
}

}  // namespace

Hypothesis clock_offset(std::optional<double> start_s, std::string_view reference) {
  const auto mistake = [](const Eigen::VectorXd& at) { return Mistake{.clock = {.offset_s = at(0)}}; };
  Hypothesis out;
  out.resembles_odometry = true;
  out.starts = {with({0.0}, {kInfinity}, {0.005}, mistake)};
  if (start_s) out.starts.push_back(far(with({*start_s}, {kInfinity}, {0.005}, mistake)));
  out.name = [reference](const RangeFit& fit) -> std::optional<Finding> {
    const double offset_s = fit.at(0);
    if (std::abs(offset_s) < kLeastClock_s || !is_certain(fit, 0, offset_s)) return std::nullopt;
    return Finding{
        .cause = "clock-offset",
        .evidence = fmt::format("the ranges' times are {} against the {}", late(offset_s), reference),
        .remedy = fmt::format("subtract {:.3f} s from the times of the ranges, or timestamp both with one "
                              "clock; --fix does so in memory",
                              offset_s),
        .value = {offset_s},
        .sigma = {sigma_of(fit, 0, kClockSystematic_s)},
        .clock = model::ClockError{.offset_s = offset_s}};
  };
  out.is_usual = [](const RangeFit& fit) { return std::abs(fit.at(0)) < kLeastClock_s; };
  out.correct = [](const RangeFit& fit, Data& data) {
    for (model::RangeSample& range : data.ranges) range.t_s -= fit.at(0);
  };
  return out;
}

Hypothesis clock_drift(std::optional<double> start_s, double begin_s, double end_s,
                       std::string_view reference) {
  const double middle_s = 0.5 * (begin_s + end_s);
  const auto mistake = [middle_s](const Eigen::VectorXd& at) {
    return Mistake{.clock = {.offset_s = at(0), .drift = at(1), .reference_s = middle_s}};
  };
  Hypothesis out;
  out.resembles_odometry = true;
  const auto start = [&](double offset_s, double drift) {
    return with({offset_s, drift}, {kInfinity, kInfinity}, {0.005, 1e-5}, mistake);
  };
  out.starts = {start(0.0, 0.0)};
  if (start_s) {
    for (const double drift : {0.0, 0.005, -0.005}) out.starts.push_back(far(start(*start_s, drift)));
  }
  out.name = [=](const RangeFit& fit) -> std::optional<Finding> {
    const double drift = fit.at(1);
    const double spread_s = drift * (end_s - begin_s);
    const Eigen::Vector2d both = fit.at.head<2>();
    const Eigen::Matrix2d covariance = fit.covariance.topLeftCorner<2, 2>();
    if (std::abs(spread_s) < kLeastDrift_s ||
        both.dot(covariance.ldlt().solve(both)) < model::square(kSignificance) ||
        std::abs(drift) < kDriftSignificance * std::sqrt(covariance(1, 1)))
      return std::nullopt;
    return Finding{.cause = "clock-drift",
                   .evidence = fmt::format("the ranges' clock and the {} separate by {:.2f} s over the drive "
                                           "(ranges {} in the middle)",
                                           reference, std::abs(spread_s), late(fit.at(0))),
                   .remedy = "timestamp ranges and poses with one clock; --fix corrects the times in memory",
                   .value = {drift},
                   .sigma = {sigma_of(fit, 1, kDriftSystematic_s / (end_s - begin_s))},
                   .clock = mistake(fit.at).clock};
  };
  out.correct = [mistake](const RangeFit& fit, Data& data) {
    const model::ClockError clock = mistake(fit.at).clock;
    for (model::RangeSample& range : data.ranges) range.t_s = clock.corrected_s(range.t_s);
  };
  return out;
}

Hypothesis without_size(std::function<void(Data&)> change, Finding finding) {
  Hypothesis out;
  out.least_gain = kLeastDiscreteGain;
  out.change = std::move(change);
  out.name = [finding = std::move(finding)](const RangeFit&) { return finding; };
  return out;
}

Hypothesis swapped_tags(std::size_t a, std::size_t b, const Data& data) {
  const std::vector ids{data.tags[a].id, data.tags[b].id};
  return without_size(
      [a, b](Data& changed) { std::swap(changed.tags[a].lever_arm_m, changed.tags[b].lever_arm_m); },
      {.cause = "swapped-tags",
       .evidence = fmt::format("the ranges fit the motion if tags {} and {} change places", ids[0], ids[1]),
       .remedy = fmt::format("exchange the positions of tags {} and {} in tags.csv, or the tags on the robot",
                             ids[0], ids[1]),
       .of = ids});
}

Hypothesis unit_of_lever_arms(const Unit& unit) {
  return without_size(
      [unit](Data& changed) {
        for (model::Tag& tag : changed.tags) tag.lever_arm_m /= unit.factor;
      },
      lever_arms_in(unit, "the ranges fit the motion if all tags are nearer to base_link"));
}

Hypothesis mirrored_tags() {
  Hypothesis out = without_size(
      [](Data& changed) {
        for (model::Tag& tag : changed.tags) tag.lever_arm_m.y() = -tag.lever_arm_m.y();
      },
      {.cause = "lateral-sign",
       .evidence = "the ranges fit the motion if the tags' y changes its sign",
       .remedy = "count y_m of tags.csv positive to the left"});
  // With two tags it may be the same as to swap them, which is more usual.
  out.penalty = 0.005;
  return out;
}

Hypothesis wrong_lever_arm(std::size_t tag, const Data& data, double height_variance_m2) {
  constexpr double kPrior_m = 1.0;  // by hand: half the size of a robot
  Hypothesis out;
  out.starts = {
      with({0.0, 0.0, 0.0}, {kPrior_m, kPrior_m, kPrior_m}, {1e-3, 1e-3, 1e-3},
           [tag](const Eigen::VectorXd& at) { return Mistake{.tag = tag, .lever_arm_m = at.head<3>()}; })};
  out.name = [id = data.tags[tag].id, height_variance_m2](const RangeFit& fit) -> std::optional<Finding> {
    const Eigen::Vector3d& error_m = fit.at.head<3>();
    Eigen::Matrix3d covariance = fit.covariance.topLeftCorner<3, 3>();
    covariance(2, 2) += height_variance_m2;
    const double certain_m2 = (error_m.array().square() - covariance.diagonal().array()).max(0.0).sum();
    const double chi2 = error_m.dot(covariance.ldlt().solve(error_m));
    if (certain_m2 < kLeastLeverArm_m * kLeastLeverArm_m || chi2 < kSignificance * kSignificance)
      return std::nullopt;
    Finding finding{
        .cause = "lever-arm",
        .evidence = fmt::format("tag {} is {:.2f} m from where tags.csv has it: its x, y, z there are "
                                "too large by {:.2f}, {:.2f}, {:.2f} m",
                                id, error_m.norm(), error_m.x(), error_m.y(), error_m.z()),
        .remedy = fmt::format("measure the position of tag {} in base_link again, and correct tags.csv", id),
        .of = {id}};
    for (Eigen::Index axis = 0; axis < 3; ++axis) {
      finding.value.push_back(error_m(axis));
      finding.sigma.push_back(
          std::hypot(std::sqrt(std::max(0.0, covariance(axis, axis))), kLeverArmSystematic_m));
    }
    return finding;
  };
  out.correct = [tag](const RangeFit& fit, Data& changed) {
    changed.tags[tag].lever_arm_m -= fit.at.head<3>();
  };
  return out;
}

Hypothesis heading_offset() {
  const auto mistake = [](const Eigen::VectorXd& at) { return Mistake{.heading_rad = at(0)}; };
  Hypothesis out;
  out.starts = {with({0.0}, {kInfinity}, {1e-4}, mistake)};
  for (const double start_rad : {0.5, 1.0, -0.5, -1.0})
    out.starts.push_back(far(with({start_rad * std::numbers::pi}, {kInfinity}, {1e-4}, mistake)));
  out.name = [](const RangeFit& fit) -> std::optional<Finding> {
    const double offset_rad = model::wrap_angle(fit.at(0));
    if (std::abs(offset_rad) < kLeastHeading_rad || !is_certain(fit, 0, offset_rad)) return std::nullopt;
    return Finding{.cause = "heading-offset",
                   .evidence = fmt::format("the tags are turned by {:.1f} degrees against the poses' heading",
                                           offset_rad * kDegrees.factor),
                   .remedy =
                       "give the yaw of base_link's x axis (forward) in the poses, or turn the positions in "
                       "tags.csv into base_link",
                   .value = {offset_rad},
                   .sigma = {sigma_of(fit, 0, kHeadingSystematic_rad)}};
  };
  out.correct = [](const RangeFit& fit, Data& data) {
    for (model::PoseSample& pose : data.poses) pose.yaw_rad = model::wrap_angle(pose.yaw_rad - fit.at(0));
  };
  return out;
}

Hypothesis heading_sign() {
  return without_size(
      [](Data& data) {
        for (model::PoseSample& pose : data.poses) pose.yaw_rad = -pose.yaw_rad;
      },
      {.cause = "heading-sign",
       .evidence = "the ranges fit the poses if the heading changes its sign",
       .remedy = "count the yaw of the poses counter-clockwise, from above"});
}

std::vector<Hypothesis> of_clock_and_tags(const Data& data, const RangeFit& given,
                                          const MakeScene& make_scene, std::string_view reference,
                                          double height_variance_m2, bool searches_clock) {
  std::optional<double> offset_s;
  if (searches_clock && given.scale_m > kFarSigmas * data.priors.sigma_m)
    offset_s = best_offset_s(data, make_scene);
  std::vector<Hypothesis> out{
      clock_offset(offset_s, reference),
      clock_drift(offset_s, data.ranges.front().t_s, data.ranges.back().t_s, reference),
  };
  for (std::size_t a = 0; a < data.tags.size(); ++a) {
    for (std::size_t b = a + 1; b < data.tags.size(); ++b) out.push_back(swapped_tags(a, b, data));
  }
  for (std::size_t tag = 0; tag < data.tags.size(); ++tag)
    out.push_back(wrong_lever_arm(tag, data, height_variance_m2));
  out.push_back(mirrored_tags());
  // By hand: few robots are so long, and shorter ones in another unit are wrong by less than one.
  constexpr double kLong_m = 1.0;
  if (longest_lever_arm_m(data.tags) > kLong_m) {
    for (const Unit& unit : kLengthUnits) out.push_back(unit_of_lever_arms(unit));
  }
  return out;
}

namespace {

// Fits of the data under hypotheses.
class Trials {
 public:
  Trials(const Data& data, const MakeScene& make_scene)
      : data_(data), make_scene_(make_scene), scene_(make_scene(data, kMostRows)) {}

  [[nodiscard]] bool fit_given() {
    if (scene_->rows().size() < kMinRows) return false;
    given_ = fit_ranges(*scene_, {});
    return 2 * given_.rows >= scene_->rows().size();
  }
  [[nodiscard]] const RangeFit& given() const noexcept { return given_; }

  // The fit from this start, if it may be better than the data as given; `changed`: by the hypothesis.
  [[nodiscard]] std::optional<RangeFit> fit(const Hypothesis& hypothesis, const Parameters& start,
                                            const Data* changed) {
    if (changed == nullptr && start.is_neutral) return fit_ranges_near(*scene_, start, given_.blocks);
    // The blocks are somewhere else under this hypothesis. To search them costs most, so that a few rows tell
    // first whether it is worth it.
    const Data& data = changed != nullptr ? *changed : data_;
    if (!few_given_) few_given_ = fit_ranges(*make_scene_(data_, kMostSearchRows), {});
    const RangeFit few = fit_ranges(*make_scene_(data, kMostSearchRows), start);
    if (few_given_->cost - few.cost < hypothesis.least_gain) return std::nullopt;
    return fit_ranges(changed != nullptr ? *make_scene_(data, kMostRows) : *scene_, start);
  }

  // The blocks may be better where a hypothesis has put them, without it too.
  void improve_given(const RangeFit& fit) {
    RangeFit again = fit_ranges_near(*scene_, {}, fit.blocks);
    if (again.cost < given_.cost) given_ = std::move(again);
  }

 private:
  const Data& data_;
  const MakeScene& make_scene_;
  std::unique_ptr<Scene> scene_;
  RangeFit given_;
  std::optional<RangeFit> few_given_;  // of kMostSearchRows
};

// The likeliest hypothesis, if the ranges are clearly likelier under it than as given; corrected in the data.
// An error that good runs have is corrected first if the ranges are likelier still under that, since the
// hypothesis would explain it: at 8 m/s, a clock that is 0.03 s off looks like a lever arm of one tag.
std::optional<Finding> find_likeliest(Data& data, const MakeScene& make_scene,
                                      const MakeHypotheses& hypotheses_of, double least_gain,
                                      bool is_again = false) {
  Trials trials(data, make_scene);
  if (!trials.fit_given()) return std::nullopt;
  std::optional<Finding> best;
  double best_gain = least_gain;
  std::optional<Data> corrected;
  double usual_gain = least_gain;
  std::optional<Data> without_usual;
  for (const Hypothesis& hypothesis : hypotheses_of(data, trials.given())) {
    std::optional<Data> changed;
    if (hypothesis.change) hypothesis.change(changed.emplace(data));
    for (const Parameters& start : hypothesis.starts) {
      const std::optional<RangeFit> fit = trials.fit(hypothesis, start, changed ? &*changed : nullptr);
      if (!fit) continue;
      // Schwarz's criterion.
      const auto rows = static_cast<double>(fit->rows);
      const double penalty =
          hypothesis.penalty +
          0.5 * std::log(rows) / rows * static_cast<double>(start.start.size() - start.nuisances);
      const double least = std::max(best_gain, hypothesis.least_gain);
      if (trials.given().cost - fit->cost - penalty < least || 2 * fit->rows < trials.given().rows) continue;
      trials.improve_given(*fit);
      const double gain = trials.given().cost - fit->cost - penalty;
      if (gain < least || fit->scale_m > kMostSigmas * data.priors.sigma_m) continue;
      if (hypothesis.is_usual && hypothesis.is_usual(*fit)) {
        usual_gain = gain;
        hypothesis.correct(*fit, without_usual.emplace(data));
      }
      std::optional<Finding> finding = hypothesis.name(*fit);
      const double least_sigmas = gain > kLargeGain ? kLargeGainSigmas : kLeastGainSigmas;
      if (!finding || gain_in_sigmas(fit->slice_cost, trials.given().slice_cost) < least_sigmas) continue;
      best = std::move(finding);
      best_gain = gain;
      corrected = changed ? *changed : data;
      hypothesis.correct(*fit, *corrected);
    }
  }
  if (!best) return std::nullopt;
  if (without_usual && usual_gain > best_gain && !is_again) {
    data = std::move(*without_usual);
    return find_likeliest(data, make_scene, hypotheses_of, least_gain, true);
  }
  data = std::move(*corrected);
  return best;
}

}  // namespace

std::vector<Finding> find_mistakes(Data& data, const MakeScene& make_scene,
                                   const MakeHypotheses& hypotheses_of, double least_gain,
                                   const std::function<void(Data&)>& prepare) {
  constexpr std::size_t kMost = 3;  // by hand: who makes more mistakes at once corrects these first
  std::vector<Finding> findings;
  while (findings.size() < kMost) {
    if (prepare) prepare(data);
    std::optional<Finding> found = find_likeliest(data, make_scene, hypotheses_of, least_gain);
    if (!found) break;
    findings.push_back(std::move(*found));
  }
  return findings;
}

}  // namespace groma::diagnosis
