// How much faster than real time 15 nodes run the shipped image, and how it loads processor and SPI.
#include <benchmark/benchmark.h>

#include <filesystem>

#include "test/sim/emulator/emulated_site.hpp"

namespace groma::sim {
namespace {

void BM_three_tags_twelve_anchors(benchmark::State& state) {
  if (!std::filesystem::exists(test::shipped_image(".hex"))) {
    state.SkipWithError("no image: cmake --preset dwm1001 && cmake --build --preset dwm1001");
    return;
  }
  SiteBench site(emulating({.tags = 3, .anchors = 12, .medium = {.loss_probability = 0.02}}));
  site.network.set_threads(static_cast<unsigned>(state.range(0)));
  double t_s = 1.0;
  site.run_until(t_s);
  for (auto _ : state) {
    t_s += 0.1;
    site.run_until(t_s);
  }
  double load = 0.0;
  double instructions = 0.0;
  double transfers = 0.0;
  double interrupts = 0.0;
  double spi_s = 0.0;
  for (std::size_t i = 0; i < site.network.size(); ++i) {
    const EmulatorUsage usage = emulated(site, i).usage(site.network.now());
    load += usage.cpu_load;
    instructions += static_cast<double>(usage.instructions);
    transfers += static_cast<double>(usage.radio_transfers);
    interrupts += static_cast<double>(usage.interrupts);
    spi_s += usage.radio_spi_s;
  }
  const double node_seconds = t_s * static_cast<double>(site.network.size());
  state.counters["simulated_s"] =
      benchmark::Counter(0.1 * static_cast<double>(state.iterations()), benchmark::Counter::kIsRate);
  state.counters["cpu_load"] = load / static_cast<double>(site.network.size());
  state.counters["spi_load"] = spi_s / node_seconds;
  state.counters["mips"] = instructions / node_seconds / 1e6;
  state.counters["transfers_per_s"] = transfers / node_seconds;
  state.counters["interrupts_per_s"] = interrupts / node_seconds;
}
BENCHMARK(BM_three_tags_twelve_anchors)
    ->ArgName("threads")
    ->Arg(1)
    ->Arg(2)
    ->Unit(benchmark::kMillisecond)
    ->UseRealTime();

}  // namespace
}  // namespace groma::sim
