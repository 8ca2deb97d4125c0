// Wall time of a calibration by the number of ranges a pair: 12 anchors, 3 tags. It has to grow linearly.
#include <benchmark/benchmark.h>

#include "host/calibration/calibrate.hpp"
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

}  // namespace
