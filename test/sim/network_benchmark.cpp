// How much faster than real time a site of 15 native nodes runs: items are simulated seconds.
#include <benchmark/benchmark.h>

#include "test/sim/site_bench.hpp"

namespace groma::sim {
namespace {

void BM_three_tags_twelve_anchors(benchmark::State& state) {
  SiteBench site({.tags = 3, .anchors = 12, .medium = {.loss_probability = 0.02}});
  double t_s = 1.0;
  site.run_until(t_s);
  for (auto _ : state) {
    t_s += 0.1;
    site.run_until(t_s);
  }
  state.counters["simulated_s"] =
      benchmark::Counter(0.1 * static_cast<double>(state.iterations()), benchmark::Counter::kIsRate);
  state.counters["ranges"] =
      benchmark::Counter(static_cast<double>(site.good_ranges(1.0)), benchmark::Counter::kIsRate);
}
BENCHMARK(BM_three_tags_twelve_anchors)->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace groma::sim
