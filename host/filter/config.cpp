#include "host/filter/config.hpp"

#include <cstddef>

#include "host/model/ablation.hpp"

namespace groma::filter {

namespace {

constexpr std::array<std::string_view, kModels.size()> kModelNames{"odometry", "original",      "inflated",
                                                                   "schmidt",  "anchor-states", "joint"};

}  // namespace

std::string_view model_name(Model model) noexcept {
  return kModelNames[static_cast<std::size_t>(model)];
}

std::optional<Model> model_from_name(std::string_view name) noexcept {
  for (const Model model : kModels) {
    if (model_name(model) == name) return model;
  }
  return std::nullopt;
}

SensorConfig::SensorConfig(const model::SensorDescription& description) {
  gyro_sigma_radps = description.gyro_sigma_radps.value_or(gyro_sigma_radps);
  gyro_bias_radps = description.gyro_bias_sigma_radps.value_or(gyro_bias_radps);
  position_lever_arm_m = description.gnss_lever_arm_m.value_or(position_lever_arm_m);
}

Config ablated(Config config) noexcept {
  using model::is_ablated;
  using model::Mechanism;
  if (is_ablated(Mechanism::kOdometryScale)) config.scale_sigma = 0.0;
  if (is_ablated(Mechanism::kYawRateBias)) config.yaw_rate_bias_radps = 0.0;
  if (is_ablated(Mechanism::kRangeDelay)) config.range_delay_sigma_s = config.odometry_delay_sigma_s = 0.0;
  if (is_ablated(Mechanism::kOdometryDelay)) config.odometry_delay_sigma_s = 0.0;
  if (is_ablated(Mechanism::kHold)) config.hold_walk_mps = config.hold_walk_radps = 0.0;
  return config;
}

}  // namespace groma::filter
