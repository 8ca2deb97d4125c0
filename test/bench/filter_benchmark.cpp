// One call of the filter, at a site of 12 anchors with 3 tags on hilly ground.
#include <benchmark/benchmark.h>

#include <cmath>
#include <cstddef>
#include <memory>
#include <numbers>
#include <vector>

#include "host/filter/filter.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

model::Calibration ring_of(int anchors) {
  std::vector<model::Anchor> ring;
  for (int i = 0; i < anchors; ++i) {
    const double angle = 2.0 * std::numbers::pi * i / anchors;
    ring.push_back(
        {static_cast<model::NodeId>(10 + i), {15.0 * std::cos(angle), 15.0 * std::sin(angle), 2.5}});
  }
  return model::surveyed_calibration(ring, testing::three_tags(),
                                     {.beta_m = {0.2, 0.05}, .gamma = {1.0, 0.002}}, 0.1);
}

std::unique_ptr<Filter> started(Model model, int anchors) {
  Config config;
  config.model = model;
  auto filter =
      std::make_unique<Filter>(testing::hills(0.2), testing::three_tags(), ring_of(anchors), config);
  filter->process(model::OdometrySample{0.0, 0.5, 0.1, 0.2});
  filter->start({.t_s = 0.0});
  return filter;
}

// A row every 3.3 ms, as between the ranges of 300 a second.
void propagate(benchmark::State& state, Model model) {
  const auto filter = started(model, static_cast<int>(state.range(0)));
  double t_s = 0.0;
  for (auto _ : state) {
    t_s += 1.0 / 300.0;
    filter->process(model::OdometrySample{t_s, 0.5, 0.1, 0.2});
  }
}

// The update alone: all ranges at one instant, as long as they should be.
void update(benchmark::State& state, Model model) {
  const int anchors = static_cast<int>(state.range(0));
  const model::Calibration calibration = ring_of(anchors);
  const std::vector<model::Tag> tags = testing::three_tags();
  const model::SurfacePose pose = model::pose_on_surface(testing::hills(0.2), {});
  std::vector<model::RangeSample> ranges;
  for (const model::Tag& tag : tags) {
    for (const model::AnchorCalibration& anchor : calibration.anchors) {
      ranges.push_back(
          {0.0, tag.id, anchor.id,
           model::predict_range(pose.pose, tag.lever_arm_m, anchor.position_m, 0.2, 1.0).range_m});
    }
  }
  const auto filter = started(model, anchors);
  std::size_t next = 0;
  for (auto _ : state) {
    benchmark::DoNotOptimize(filter->process(ranges[next]));
    next = next + 1 == ranges.size() ? 0 : next + 1;
  }
}

BENCHMARK_CAPTURE(propagate, odometry, Model::kOdometry)->Arg(12);
BENCHMARK_CAPTURE(propagate, schmidt, Model::kSchmidt)->Arg(4)->Arg(12)->Arg(16);
BENCHMARK_CAPTURE(propagate, joint, Model::kJoint)->Arg(12);
BENCHMARK_CAPTURE(update, original, Model::kOriginal)->Arg(12);
BENCHMARK_CAPTURE(update, inflated, Model::kInflated)->Arg(12);
BENCHMARK_CAPTURE(update, schmidt, Model::kSchmidt)->Arg(4)->Arg(12)->Arg(16);
BENCHMARK_CAPTURE(update, anchor_states, Model::kAnchorStates)->Arg(12);
BENCHMARK_CAPTURE(update, joint, Model::kJoint)->Arg(4)->Arg(12)->Arg(16);

}  // namespace
}  // namespace groma::filter
