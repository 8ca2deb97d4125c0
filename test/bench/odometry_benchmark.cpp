// Cost of one odometry sample from its JSON line to its pose, at rates from 50 Hz: session and localizer,
// without ranges. It should not grow with the rate.
#include <benchmark/benchmark.h>
#include <fmt/format.h>

#include <memory>
#include <string>
#include <vector>

#include "host/daemon/localizer.hpp"
#include "host/daemon/session.hpp"
#include "host/model/calibration.hpp"

namespace groma::daemon {
namespace {

std::unique_ptr<Localizer> localizer(std::uint64_t& poses) {
  std::vector<model::Anchor> anchors;
  anchors.reserve(6);
  for (int i = 0; i < 6; ++i) {
    anchors.push_back({static_cast<model::NodeId>(100 + i), {8.0 * (i % 2), 8.0 * (i % 3), 2.0}});
  }
  Localizer::Setup setup;
  setup.tags = {{1, {0.2, 0.0, 0.5}}};
  setup.calibration = model::surveyed_calibration(anchors, setup.tags, {}, 0.02);
  auto made = std::make_unique<Localizer>(std::move(setup), [&poses](const PoseEstimate&) { ++poses; });
  made->start({.t_s = 0.0});
  return made;
}

void sample(benchmark::State& state) {
  const auto rate_hz = static_cast<double>(state.range(0));
  std::uint64_t poses = 0;
  Session session;
  const auto sink = localizer(poses);
  session.attach(*sink);
  std::uint64_t index = 0;
  const auto next = [&] {
    const double t_s = static_cast<double>(index++) / rate_hz;
    const std::string line =
        fmt::format(R"({{"class":"ODOMETRY","t_s":{:.6f},"vx_mps":1.0,"vy_mps":0.0,"omega_radps":0.2}})"
                    "\n",
                    t_s);
    session.robot_bytes({reinterpret_cast<const std::uint8_t*>(line.data()), line.size()}, t_s);
    session.advance(t_s);
  };
  // Fill the queues to their steady length.
  while (static_cast<double>(index) < rate_hz) next();
  for (auto _ : state) next();
  state.counters["poses"] = benchmark::Counter(static_cast<double>(poses) / static_cast<double>(index));
}

BENCHMARK(sample)->Arg(50)->Arg(200)->Arg(1000)->Arg(5000)->Arg(10000);

}  // namespace
}  // namespace groma::daemon
