#include "host/diagnosis/motion_check.hpp"

#include <fmt/format.h>

#include <cmath>
#include <cstddef>
#include <memory>
#include <string>
#include <utility>

#include "host/diagnosis/hypothesis.hpp"
#include "host/diagnosis/thresholds.hpp"
#include "host/diagnosis/window_scene.hpp"

namespace groma::diagnosis {
namespace {

// A hypothesis with one scalar that is estimated; `neutral` is its value without a mistake.
template <class Make>
Hypothesis scalar(double neutral, double least, double systematic, Make make_mistake, std::string_view cause,
                  const std::string& evidence, const std::string& remedy,
                  std::function<void(double, Data&)> correct) {
  Hypothesis out;
  Parameters parameters;
  parameters.start = Eigen::VectorXd::Constant(1, neutral);
  parameters.prior_sigma = Eigen::VectorXd::Constant(1, std::numeric_limits<double>::infinity());
  parameters.step = Eigen::VectorXd::Constant(1, 1e-3);
  parameters.mistake = [make_mistake](const Eigen::VectorXd& at) { return make_mistake(at(0)); };
  out.starts = {parameters};
  out.name = [=](const RangeFit& fit) -> std::optional<Finding> {
    const double error = std::abs(fit.at(0) - neutral);
    const double sigma = std::sqrt(std::max(0.0, fit.covariance(0, 0)));
    if (error < least || error < kSignificance * sigma) return std::nullopt;
    return Finding{.cause = cause,
                   .evidence = fmt::format(fmt::runtime(evidence), fit.at(0)),
                   .remedy = remedy,
                   .value = {fit.at(0)},
                   .sigma = {std::hypot(sigma, systematic)},
                   .is_of_odometry_alone = neutral == 1.0};
  };
  out.correct = [correct = std::move(correct)](const RangeFit& fit, Data& data) { correct(fit.at(0), data); };
  return out;
}

Hypothesis changed(std::function<void(Data&)> change, std::string_view cause, const std::string& evidence,
                   const std::string& remedy) {
  Hypothesis out;
  out.penalty = kDiscretePenalty;
  out.change = std::move(change);
  out.name = [=](const RangeFit&) {
    return Finding{.cause = cause, .evidence = evidence, .remedy = remedy, .is_of_odometry_alone = true};
  };
  return out;
}

std::vector<Hypothesis> of_odometry() {
  const auto each = [](auto function) {
    return [function](double value, Data& data) {
      for (model::OdometrySample& sample : data.odometry) function(value, sample);
    };
  };
  std::vector<Hypothesis> out;
  out.push_back(scalar(
      1.0, kLeastScale, kScaleSystematic, [](double scale) { return Mistake{.speed_scale = scale}; },
      "odometry-scale", "the odometry moves {:.3f} times as far as the ranges show",
      "divide vx_mps and vy_mps by it, or check the wheels' diameter",
      each([](double scale, model::OdometrySample& sample) {
        sample.vx_mps /= scale;
        sample.vy_mps /= scale;
      })));
  out.push_back(scalar(
      1.0, kLeastScale, kScaleSystematic, [](double scale) { return Mistake{.yaw_rate_scale = scale}; },
      "yaw-rate-scale", "the odometry turns {:.3f} times as fast as the ranges show",
      "divide omega_radps by it, or check the track width",
      each([](double scale, model::OdometrySample& sample) { sample.omega_radps /= scale; })));
  out.push_back(changed(
      [](Data& data) {
        for (model::OdometrySample& sample : data.odometry) sample.omega_radps = -sample.omega_radps;
      },
      "yaw-rate-sign", "the ranges fit the odometry if its yaw rate changes its sign",
      "count omega_radps positive to the left (counter-clockwise, from above)"));
  out.push_back(changed(
      [](Data& data) {
        for (model::OdometrySample& sample : data.odometry) sample.vy_mps = -sample.vy_mps;
      },
      "lateral-sign", "the ranges fit the odometry if its lateral speed changes its sign",
      "count vy_mps positive to the left"));
  return out;
}

Hypothesis surface_height() {
  return scalar(
      0.0, kLeastHeight_m, kHeightSystematic_m, [](double height_m) { return Mistake{.height_m = height_m}; },
      "surface-height", "the surface is {:+.2f} m off the height that the ranges show",
      "correct the surface's height in dataset.yaml: it is that of base_link, in the calibration's frame",
      [](double height_m, Data& data) {
        for (model::Tag& tag : data.tags) tag.lever_arm_m.z() -= height_m;
      });
}

}  // namespace

std::vector<Finding> compare_with_calibration(Data& data, const model::Calibration& calibration) {
  if (data.odometry.size() < 2 || data.ranges.empty()) return {};
  const auto make_scene = [&](const Data& now, std::size_t most_rows) -> std::unique_ptr<Scene> {
    return std::make_unique<WindowScene>(now, calibration, most_rows);
  };
  return find_mistakes(data, make_scene, [&](const Data& now, const RangeFit& given) {
    std::vector<Hypothesis> out = of_odometry();
    for (Hypothesis& hypothesis : of_clock_and_tags(now, given, make_scene, "odometry")) {
      out.push_back(std::move(hypothesis));
    }
    out.push_back(surface_height());
    return out;
  });
}

}  // namespace groma::diagnosis
