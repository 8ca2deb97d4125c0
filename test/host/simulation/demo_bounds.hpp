// Bounds on `groma demo` in the paper's hall, for native and emulated nodes.
#pragma once

#include <gtest/gtest.h>

#include <nlohmann/json.hpp>

namespace groma::simulation {

// `json`: the output of `groma demo --json`.
inline void expect_demo_bounds(const nlohmann::json& json) {
  EXPECT_GE(json.at("ranges_per_s").get<double>(), 300.0);
  EXPECT_EQ(json.at("frames_lost"), 0);
  EXPECT_GT(json.at("realtime_factor").get<double>(), 0.0);
  EXPECT_GE(json.at("without_sight").get<double>(), 0.10);
  const nlohmann::json& anchors = json.at("calibration").at("anchors");
  ASSERT_EQ(anchors.size(), 12U);
  double anchor_error_m = 0.0;
  for (const nlohmann::json& anchor : anchors) anchor_error_m += anchor.at("error_m").get<double>() / 12.0;
  EXPECT_LT(anchor_error_m, 0.3);
  EXPECT_EQ(json.at("calibration").at("pairs").size(), 36U);
  const nlohmann::json& evaluation = json.at("evaluation");
  for (const char* model : {"odometry", "original", "inflated", "schmidt", "anchor-states", "joint"}) {
    EXPECT_GE(evaluation.at(model).at("samples").get<int>(), 4000) << model;
  }
  const double schmidt_m = evaluation.at("schmidt").at("ate_m").at("mean").get<double>();
  EXPECT_LE(schmidt_m, 0.15);
  EXPECT_LE(schmidt_m, 2.0 / 3.0 * evaluation.at("original").at("ate_m").at("mean").get<double>());
}

}  // namespace groma::simulation
