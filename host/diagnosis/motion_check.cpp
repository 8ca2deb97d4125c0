#include "host/diagnosis/motion_check.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <limits>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <utility>

#include "host/diagnosis/constellation.hpp"
#include "host/diagnosis/hypothesis.hpp"
#include "host/diagnosis/start_check.hpp"
#include "host/diagnosis/thresholds.hpp"
#include "host/diagnosis/units.hpp"
#include "host/diagnosis/window_scene.hpp"

namespace groma::diagnosis {
namespace {

// What a hypothesis with one scalar, which is estimated, is about.
struct Scalar {
  double neutral = 0.0;  // the value without a mistake
  double least = 0.0;    // error that is named
  double systematic = 0.0;
  double variance = 0.0;  // beside that of the fit
  double factor = 1.0;    // of what is wrong with the data over what is left in them
  std::function<Mistake(double)> mistake;
  std::string_view cause;
  std::string evidence;  // with a place for the value
  std::string remedy;
  std::function<void(double, Data&)> correct;
};

Hypothesis scalar(const Scalar& of) {
  Hypothesis out;
  Parameters parameters;
  parameters.start = Eigen::VectorXd::Constant(1, of.neutral);
  parameters.prior_sigma = Eigen::VectorXd::Constant(1, std::numeric_limits<double>::infinity());
  parameters.step = Eigen::VectorXd::Constant(1, 1e-3);
  parameters.mistake = [mistake = of.mistake](const Eigen::VectorXd& at) { return mistake(at(0)); };
  out.starts = {parameters};
  out.name = [of](const RangeFit& fit) -> std::optional<Finding> {
    const double value = of.factor * fit.at(0);
    const double error = std::abs(value - of.neutral);
    const double sigma = std::sqrt(std::max(0.0, fit.covariance(0, 0)) + of.variance);
    if (error < of.least || error < kSignificance * sigma) return std::nullopt;
    return Finding{.cause = of.cause,
                   .evidence = fmt::format(fmt::runtime(of.evidence), value),
                   .remedy = of.remedy,
                   .value = {value},
                   .sigma = {std::hypot(sigma, of.systematic)},
                   .is_of_odometry_alone = of.neutral == 1.0};
  };
  out.correct = [correct = of.correct](const RangeFit& fit, Data& data) { correct(fit.at(0), data); };
  return out;
}

Hypothesis of_odometry_alone(std::function<void(Data&)> change, std::string_view cause,
                             const std::string& evidence, const std::string& remedy,
                             const std::vector<double>& value = {}) {
  return without_size(
      std::move(change),
      {.cause = cause, .evidence = evidence, .remedy = remedy, .value = value, .is_of_odometry_alone = true});
}

// Whether the yaw rate may be in degrees: a robot turns faster than this now and then. By hand.
bool may_be_degrees(const std::vector<model::OdometrySample>& odometry) {
  constexpr double kSlow_radps = 2.0;
  return std::any_of(odometry.begin(), odometry.end(), [](const model::OdometrySample& sample) {
    return std::abs(sample.omega_radps) > kSlow_radps;
  });
}

Hypothesis wrong_yaw_rate_sign() {
  return of_odometry_alone(
      [](Data& data) {
        for (model::OdometrySample& sample : data.odometry) sample.omega_radps = -sample.omega_radps;
      },
      "yaw-rate-sign", "the ranges fit the odometry if its yaw rate changes its sign",
      "count omega_radps positive to the left (counter-clockwise, from above)");
}

// `corrected`: the scale that was already removed from the speeds, given over true.
std::vector<Hypothesis> of_odometry(const Data& data, double corrected) {
  const auto each = [](auto function) {
    return [function](double value, Data& of) {
      for (model::OdometrySample& sample : of.odometry) function(value, sample);
    };
  };
  std::vector<Hypothesis> out;
  out.push_back(scalar({.neutral = 1.0,
                        .least = kLeastScale,
                        .systematic = kScaleSystematic,
                        .factor = corrected,
                        .mistake = [](double scale) { return Mistake{.speed_scale = scale}; },
                        .cause = "odometry-scale",
                        .evidence = "the odometry moves {:.3f} times as far as the ranges show",
                        .remedy = "divide vx_mps and vy_mps by it, or check the wheels' diameter",
                        .correct = each([](double scale, model::OdometrySample& sample) {
                          sample.vx_mps /= scale;
                          sample.vy_mps /= scale;
                        })}));
  out.push_back(scalar(
      {.neutral = 1.0,
       .least = kLeastScale,
       .systematic = kScaleSystematic,
       .mistake = [](double scale) { return Mistake{.yaw_rate_scale = scale}; },
       .cause = "yaw-rate-scale",
       .evidence = "the odometry turns {:.3f} times as fast as the ranges show",
       .remedy = "divide omega_radps by it, or check the track width",
       .correct = each([](double scale, model::OdometrySample& sample) { sample.omega_radps /= scale; })}));
  out.back().resembles_odometry = true;
  out.push_back(wrong_yaw_rate_sign());
  out.push_back(of_odometry_alone(
      [](Data& data) {
        for (model::OdometrySample& sample : data.odometry) sample.vy_mps = -sample.vy_mps;
      },
      "lateral-sign", "the ranges fit the odometry if its lateral speed changes its sign",
      "count vy_mps positive to the left"));
  if (may_be_degrees(data.odometry)) {
    out.push_back(of_odometry_alone(
        [](Data& of) {
          for (model::OdometrySample& sample : of.odometry) sample.omega_radps /= kDegrees.factor;
        },
        "angle-unit", "the ranges fit the odometry if its yaw rate is in degrees",
        "give omega_radps in radians per second", {kDegrees.factor}));
  }
  return out;
}

Hypothesis surface_height(double height_variance_m2) {
  return scalar({.least = kLeastHeight_m,
                 .systematic = kHeightSystematic_m,
                 .variance = height_variance_m2,
                 .mistake = [](double height_m) { return Mistake{.height_m = height_m}; },
                 .cause = "surface-height",
                 .evidence = "the surface is {:+.2f} m off the height that the ranges show",
                 .remedy = "correct the surface's height in dataset.yaml: it is that of base_link, in the "
                           "calibration's frame",
                 .correct =
                     [](double height_m, Data& data) {
                       for (model::Tag& tag : data.tags) tag.lever_arm_m.z() -= height_m;
                     }});
}

// Of the anchors' heights together: who lowers them all raises a tag. Heights that a drive does not show may
// be wrong by more than a lever arm.
double height_variance_m2(const model::Calibration& calibration) {
  double information = 0.0;
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (model::has_position(anchor)) information += 1.0 / anchor.covariance(2, 2);
  }
  return information > 0.0 ? 1.0 / information + calibration.common_frame_covariance(2, 2) : 0.0;
}

// Scale and yaw-rate bias that good odometry has, of which a hypothesis would explain a part.
class OdometryError {
 public:
  explicit OdometryError(const MakeScene& make_scene) : make_scene_(make_scene) {}

  // Removes them from the data; what is larger than of good odometry stays.
  void remove(Data& data) {
    constexpr std::size_t kRows = 1500;
    constexpr double kMostBias_radps = 0.01;  // by hand
    Parameters parameters;
    parameters.start = Eigen::Vector2d(1.0, 0.0);
    parameters.prior_sigma = kPriorSigma;
    parameters.step = kStep;
    parameters.mistake = [](const Eigen::VectorXd& at) {
      return Mistake{.speed_scale = at(0), .yaw_rate_bias_radps = at(1)};
    };
    const auto scene = make_scene_(data, kRows);
    if (scene->rows().empty()) return;
    const RangeFit fit = fit_ranges(*scene, parameters);
    const double scale = scale_ * fit.at(0);
    if (!(std::abs(scale - 1.0) < kLeastScale && std::abs(fit.at(1)) < kMostBias_radps)) return;
    scale_ = scale;
    bias_radps_ += fit.at(1);
    for (model::OdometrySample& sample : data.odometry) {
      sample.vx_mps /= fit.at(0);
      sample.vy_mps /= fit.at(0);
      sample.omega_radps -= fit.at(1);
    }
  }
  // What was removed, given over true.
  [[nodiscard]] double scale() const noexcept { return scale_; }

  // Of the data under a mistake that was removed in part as one of these: they are estimated again with it.
  [[nodiscard]] Parameters with_these(const Parameters& parameters) const {
    const Eigen::Index size = parameters.start.size();
    Parameters out = parameters;
    out.nuisances = 2;
    const auto append = [](const Eigen::VectorXd& to, const Eigen::Vector2d& more) {
      Eigen::VectorXd joined(to.size() + 2);
      joined << to, more;
      return joined;
    };
    out.start = append(parameters.start, {1.0 / scale_, -bias_radps_});
    out.prior_sigma = append(parameters.prior_sigma, kPriorSigma);
    out.step = append(parameters.step, kStep);
    out.mistake = [mistake = parameters.mistake, size](const Eigen::VectorXd& at) {
      Mistake made = mistake(at.head(size));
      made.speed_scale = at(size);
      made.yaw_rate_bias_radps = at(size + 1);
      return made;
    };
    return out;
  }

 private:
  // Of good odometry, by hand.
  inline static const Eigen::Vector2d kPriorSigma{0.01, 0.002};
  inline static const Eigen::Vector2d kStep{1e-3, 1e-5};

  const MakeScene& make_scene_;
  double scale_ = 1.0;
  double bias_radps_ = 0.0;
};

Hypothesis renumbered(const std::map<model::NodeId, model::NodeId>& exchanged) {
  std::vector<model::NodeId> ids;
  ids.reserve(exchanged.size());
  for (const auto& [id, other] : exchanged) ids.push_back(id);
  return without_size(
      [exchanged](Data& data) {
        for (model::RangeSample& range : data.ranges) {
          const auto other = exchanged.find(range.anchor_id);
          if (other != exchanged.end()) range.anchor_id = other->second;
        }
      },
      {.cause = "renumbered-anchors",
       .evidence = fmt::format("anchors {} are where the calibration has others", fmt::join(ids, ", ")),
       .remedy = "calibrate again, or restore the anchors' ids",
       .of = ids});
}

// By hand: more than one of ten anchors may be moved, or badly placed by dead reckoning.
bool shows_exchange(const Constellation& seen) {
  return seen.exchanged.size() >= 2 && seen.any > seen.own + 1;
}

// What the anchors' places show that no hypothesis explains.
std::vector<Finding> find_mismatch(const std::optional<Constellation>& seen) {
  if (!seen || 2 * seen->own > seen->anchors) return {};
  if (seen->own_mirrored > seen->own + 1 && seen->own_mirrored + 1 >= seen->anchors)
    return {*wrong_yaw_rate_sign().name({})};
  if (shows_exchange(*seen) && seen->any + 1 >= seen->anchors) return {*renumbered(seen->exchanged).name({})};
  Finding finding = map_mismatch({});
  finding.evidence = fmt::format("the odometry puts {} of {} anchors elsewhere than the calibration",
                                 seen->anchors - seen->own, seen->anchors);
  return {std::move(finding)};
}

}  // namespace

std::vector<Finding> compare_with_calibration(Data& data, const model::Calibration& calibration) {
  if (data.odometry.size() < 2 || data.ranges.empty()) return {};
  // It proves nothing of the data.
  if (calibration.verdict == model::Verdict::kUnusable) return {};
  const MakeScene make_scene = [&](const Data& now, std::size_t most_rows) -> std::unique_ptr<Scene> {
    return std::make_unique<WindowScene>(now, calibration, most_rows);
  };
  OdometryError error(make_scene);
  RangeFit windows;  // of the data, under no hypothesis
  windows.scale_m = std::numeric_limits<double>::infinity();
  std::optional<Constellation> seen;
  const double height_m2 = height_variance_m2(calibration);
  const auto hypotheses = [&](const Data& now, const RangeFit& given) {
    windows = given;
    seen = compare_constellation(now, calibration);
    // Exchanged anchors explain more than a clock, which is looked for after them.
    const bool are_exchanged = seen && shows_exchange(*seen);
    std::vector<Hypothesis> out = of_odometry(now, error.scale());
    for (Hypothesis& hypothesis :
         of_clock_and_tags(now, given, make_scene, "odometry's", height_m2, !are_exchanged)) {
      out.push_back(std::move(hypothesis));
    }
    out.push_back(surface_height(height_m2));
    for (Hypothesis& hypothesis : out) {
      if (!hypothesis.resembles_odometry) continue;
      for (Parameters& start : hypothesis.starts) start = error.with_these(start);
    }
    if (are_exchanged) out.push_back(renumbered(seen->exchanged));
    return out;
  };
  std::vector<Finding> findings =
      find_mistakes(data, make_scene, hypotheses, 0.0, [&](Data& now) { error.remove(now); });
  if (!findings.empty()) return findings;
  if (windows.scale_m < kFitSigmas * data.priors.sigma_m) {
    if (!data.start) return findings;
    if (auto found = find_wrong_start(*data.start, WindowScene(data, calibration, kMostRows), windows))
      findings.push_back(std::move(*found));
    return findings;
  }
  if (!seen) seen = compare_constellation(data, calibration);
  return find_mismatch(seen);
}

}  // namespace groma::diagnosis
