// Wall time of a calibration over the number of ranges per pair: 12 anchors, 3 tags. It has to grow linearly.
#include <benchmark/benchmark.h>

#include <cmath>

#include "host/calibration/calibrate.hpp"
#include "host/calibration/learning.hpp"
#include "test/host/calibration/blocked_site.hpp"
#include "test/host/calibration/site_simulation.hpp"

namespace {

void BM_Calibrate(benchmark::State& state) {
  const groma::test::SimulatedSite site = groma::test::simulate_site(
      {.ranges_per_pair = static_cast<std::size_t>(state.range(0)), .outlier_share = 0.15}, 1);
  const groma::calibration::Drive drive = site.drive();
  for (auto _ : state) benchmark::DoNotOptimize(groma::calibration::calibrate(drive));
  state.SetComplexityN(state.range(0));
}
BENCHMARK(BM_Calibrate)->Arg(200)->Arg(1000)->Arg(4000)->Unit(benchmark::kMillisecond)->Complexity();

// A drive with 2000 ranges per pair, solved with all ranges (0) or with a limit per anchor. rmse_m: of the
// positions.
void BM_CalibrateChosen(benchmark::State& state) {
  const groma::test::SimulatedSite site =
      groma::test::simulate_site({.ranges_per_pair = 2000, .outlier_share = 0.15}, 1);
  const groma::calibration::Drive drive = site.drive();
  groma::calibration::Options options;
  if (state.range(0) > 0) options.most_anchor_ranges = static_cast<std::size_t>(state.range(0));
  groma::calibration::Result result;
  for (auto _ : state) result = groma::calibration::calibrate(drive, options);
  double square_m2 = 0.0;
  for (std::size_t a = 0; a < site.anchors.size(); ++a) {
    square_m2 += (result.calibration.anchors[a].position_m - site.anchors[a].position_m).squaredNorm();
  }
  state.counters["rmse_m"] = std::sqrt(square_m2 / static_cast<double>(site.anchors.size()));
}
BENCHMARK(BM_CalibrateChosen)->Arg(0)->Arg(600)->Arg(1500)->Arg(3000)->Unit(benchmark::kMillisecond);

// As BM_CalibrateChosen, with walls that block the line of sight, 2000 polls per pair.
void BM_CalibrateChosenBehindWalls(benchmark::State& state) {
  groma::test::Blocking blocking;
  blocking.walls = {{{20.6, 4.0}, {20.6, 9.0}}, {{7.0, 1.0}, {7.0, 5.0}}, {{12.0, 9.0}, {16.0, 9.0}}};
  const groma::test::SimulatedSite site =
      groma::test::blocked_site(groma::test::polled_settings(groma::test::Route::kWaves, 240.0), blocking, 4);
  const groma::calibration::Drive drive = site.drive();
  groma::calibration::Options options;
  if (state.range(0) > 0) options.most_anchor_ranges = static_cast<std::size_t>(state.range(0));
  for (auto _ : state) benchmark::DoNotOptimize(groma::calibration::calibrate(drive, options));
}
BENCHMARK(BM_CalibrateChosenBehindWalls)->Arg(0)->Arg(1000)->Arg(2000)->Unit(benchmark::kMillisecond);

// One step of the calibration while driving: solves all stored places, and checks the anchors in use against
// the last minute. The store is bounded: beyond its capacity, longer drives do not make a step longer.
void BM_LearningStep(benchmark::State& state) {
  const groma::calibration::DriveStoreLimits limits;
  const auto duration_s = static_cast<double>(state.range(0));
  const groma::test::SimulatedSite site = groma::test::simulate_site(
      {.duration_s = duration_s,
       .ranges_per_pair = limits.pair_ranges * static_cast<std::size_t>(duration_s / limits.segment_s),
       .outlier_share = 0.15,
       .pose_sigma_m = 0.02,
       .pose_yaw_sigma_rad = 0.004},
      1);
  groma::calibration::DriveStore store(limits);
  auto pose = site.poses.begin();
  for (const groma::model::RangeSample& range : site.ranges) {
    for (; pose != site.poses.end() && pose->t_s <= range.t_s; ++pose) store.add(*pose);
    store.add(range);
  }
  groma::calibration::LearningInput input{.places = store.places(),
                                          .recent = store.recent(),
                                          .live = groma::calibration::calibrate(site.drive()).calibration,
                                          .tags = site.tags,
                                          .surface = site.floor,
                                          .priors = site.drive().priors};
  for (auto _ : state) benchmark::DoNotOptimize(groma::calibration::learn(input));
  state.counters["ranges"] = static_cast<double>(input.places->samples().ranges.size());
}
BENCHMARK(BM_LearningStep)->Arg(150)->Arg(300)->Arg(600)->Arg(1200)->Unit(benchmark::kMillisecond);

}  // namespace
