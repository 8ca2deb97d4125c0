// Cost of one call of the filter, by default at a site of 12 anchors with 3 tags on hilly ground. Besides the
// mean: the median and the 99th percentile of single calls (p50_ns, p99_ns, without the clock's cost), and a
// lower bound from the covariance's multiply-adds at this machine's peak rate (bound_ns).
#include <benchmark/benchmark.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <numbers>
#include <utility>
#include <vector>

#include "host/filter/filter.hpp"
#include "host/filter/replay.hpp"
#include "host/filter/start_search.hpp"
#include "test/host/filter/small_site.hpp"

namespace groma::filter {
namespace {

using Clock = std::chrono::steady_clock;

model::Calibration ring_of(int anchors) {
  std::vector<model::Anchor> ring;
  ring.reserve(static_cast<std::size_t>(anchors));
  for (int i = 0; i < anchors; ++i) {
    const double angle = 2.0 * std::numbers::pi * i / anchors;
    ring.push_back(
        {static_cast<model::NodeId>(10 + i), {15.0 * std::cos(angle), 15.0 * std::sin(angle), 2.5}});
  }
  return model::surveyed_calibration(ring, testing::three_tags(),
                                     {.beta_m = {0.2, 0.05}, .gamma = {1.0, 0.002}}, 0.1);
}

constexpr model::SurfaceMismatch kExact{};
constexpr model::SurfaceMismatch kDiffers{.sigma_m = 0.02, .slope_sigma = 0.01, .length_m = 3.0};

model::Surface hills_with(const model::SurfaceMismatch& mismatch) {
  std::vector<model::Chart> charts = testing::hills(0.2).charts();
  charts.front().mismatch = mismatch;
  return model::Surface(std::move(charts));
}

std::unique_ptr<Filter> started(Model model, int anchors, const model::SurfaceMismatch& mismatch = kExact) {
  Config config;
  config.model = model;
  auto filter =
      std::make_unique<Filter>(hills_with(mismatch), testing::three_tags(), ring_of(anchors), config);
  filter->process(model::OdometrySample{0.0, 0.5, 0.1, 0.2});
  filter->start({.t_s = 0.0});
  return filter;
}

// Exact ranges at the robot's start, from each tag in turn to the anchors that are then active.
std::vector<model::RangeSample> ranges_at_start(int anchors) {
  const model::Calibration calibration = ring_of(anchors);
  const model::SurfacePose pose = model::pose_on_surface(testing::hills(0.2), {});
  std::vector<model::RangeSample> ranges;
  for (const model::Tag& tag : testing::three_tags()) {
    for (int i = 0; i < std::min(anchors, kMaxAnchors); ++i) {
      const model::AnchorCalibration& anchor = calibration.anchors[static_cast<std::size_t>(i)];
      ranges.push_back({0.0, tag.id, anchor.id,
                        model::predict_range(pose.pose, tag.lever_arm_m, anchor.position_m,
                                             model::values_of({.beta_m = 0.2}))
                            .range_m});
    }
  }
  return ranges;
}

double since_ns(Clock::time_point begin) {
  return std::chrono::duration<double, std::nano>(Clock::now() - begin).count();
}

double percentile(std::vector<double>& values, double share) {
  const auto at =
      values.begin() + static_cast<std::ptrdiff_t>(share * static_cast<double>(values.size() - 1));
  std::nth_element(values.begin(), at, values.end());
  return *at;
}

// Percentiles of single calls, measured outside of Google Benchmark's timed loop.
template <class Call>
void report_percentiles(benchmark::State& state, const Call& call) {
  constexpr std::size_t kCalls = 200'000;
  std::vector<double> clock_ns(kCalls);
  for (double& duration_ns : clock_ns) duration_ns = since_ns(Clock::now());
  std::vector<double> call_ns(kCalls);
  for (double& duration_ns : call_ns) {
    const Clock::time_point begin = Clock::now();
    call();
    duration_ns = since_ns(begin);
  }
  const double clock = percentile(clock_ns, 0.5);
  state.counters["p50_ns"] = percentile(call_ns, 0.5) - clock;
  state.counters["p99_ns"] = percentile(call_ns, 0.99) - clock;
}

// Vectorized like the filter's loops: two doubles at a time, or four if the machine has AVX2.
#if defined(__x86_64__) && defined(__linux__)
__attribute__((target_clones("default", "avx2")))
#endif
void multiply_and_add(int rounds, double factor, double term, double* out) {
  using Four __attribute__((vector_size(32))) = double;
  constexpr int kChains = 8;
  Four sums[kChains] = {};
  for (int i = 0; i < rounds; ++i) {
    for (Four& sum : sums) sum = sum * factor + term;
  }
  for (int i = 0; i < kChains; ++i) out[i] = sums[i][0] + sums[i][1] + sums[i][2] + sums[i][3];
}

// Multiply-adds per nanosecond, with separate multiplication and addition (no FMA), as in the filter.
double peak_per_ns() {
  double factor = 0.999;
  double term = 1e-3;
  benchmark::DoNotOptimize(factor);
  benchmark::DoNotOptimize(term);
  std::array<double, 8> out{};
  double best = 0.0;
  for (int trial = 0; trial < 5; ++trial) {
    constexpr int kRounds = 200'000;
    const Clock::time_point begin = Clock::now();
    multiply_and_add(kRounds, factor, term, out.data());
    benchmark::DoNotOptimize(out);
    best = std::max(best, 8.0 * 4.0 * kRounds / since_ns(begin));
  }
  return best;
}

double peak() {
  static const double per_ns = peak_per_ns();
  return per_ns;
}

// Multiply-adds of the covariance only, without surface, gate and range prediction.
struct Work {
  double core = kCoreSize;
  double pair = kPairParameters - kGroundSize;  // without ground states: the ground is exact
  double parameters;

  explicit Work(int anchors) : parameters(Layout(std::min(anchors, kMaxAnchors), 3).size()) {}

  // F P F^T: two full rows and the heading's three terms, for the core and for the accumulated motion.
  [[nodiscard]] double propagation() const { return 2.0 * (2.0 * 8.0 * core + 2.0 * core) + 2.0 * 8.0 + 4.0; }
  // q = C d and C - q g^T, preceded by the pair's rows and blocks, and the core.
  [[nodiscard]] double consider() const {
    return 2.0 * core * parameters + 2.0 * core * pair + 9.0 * 6.0 + 3.0 + 4.0 * 4.0 + 1.5 * core * core;
  }
  // Also P J^T of the pair's columns, and P - q q^T of one triangle.
  [[nodiscard]] double joint() const {
    return consider() + pair * parameters + 0.5 * parameters * (parameters + 1.0);
  }
};

// An odometry sample every 3.3 ms, like the propagation between 300 ranges per second.
void propagate(benchmark::State& state, Model model, const model::SurfaceMismatch& mismatch = kExact) {
  const auto filter = started(model, static_cast<int>(state.range(0)), mismatch);
  double t_s = 0.0;
  const auto call = [&] {
    t_s += 1.0 / 300.0;
    filter->process(model::OdometrySample{t_s, 0.5, 0.1, 0.2});
  };
  for (auto _ : state) call();
  report_percentiles(state, call);
  state.counters["bound_ns"] = Work(12).propagation() / peak();
}

double work_of(Model model, int anchors) {
  return model == Model::kJoint ? Work(anchors).joint() : Work(anchors).consider();
}

// The update only: all ranges have the same time.
void update(benchmark::State& state, Model model, const model::SurfaceMismatch& mismatch = kExact) {
  const int anchors = static_cast<int>(state.range(0));
  const std::vector<model::RangeSample> ranges = ranges_at_start(anchors);
  const auto filter = started(model, anchors, mismatch);
  std::size_t next = 0;
  const auto call = [&] {
    benchmark::DoNotOptimize(filter->process(ranges[next]));
    next = next + 1 == ranges.size() ? 0 : next + 1;
  };
  for (auto _ : state) call();
  report_percentiles(state, call);
  if (model == Model::kSchmidt || model == Model::kJoint) {
    state.counters["bound_ns"] = work_of(model, anchors) / peak();
  }
}

// Cost of a range 3.3 ms after the last one: the propagation up to it, its deferred part, and the update. The
// robot is stationary.
void move_and_update(benchmark::State& state, Model model) {
  const int anchors = static_cast<int>(state.range(0));
  std::vector<model::RangeSample> ranges = ranges_at_start(anchors);
  const auto filter = started(model, anchors);
  filter->process(model::OdometrySample{1e-3, 0.0, 0.0, 0.0});
  filter->start({.t_s = 1e-3});
  std::size_t next = 0;
  double t_s = 1e-3;
  const auto call = [&] {
    t_s += 1.0 / 300.0;
    model::RangeSample& range = ranges[next];
    range.t_s = t_s;
    benchmark::DoNotOptimize(filter->process(range));
    next = next + 1 == ranges.size() ? 0 : next + 1;
    if (next == 0) filter->process(model::OdometrySample{t_s, 0.0, 0.0, 0.0});
  };
  for (auto _ : state) call();
  report_percentiles(state, call);
}

// A predicted pose now, from a state that lags by `state.range(0)` odometry samples.
void predict(benchmark::State& state, Model model, const model::SurfaceMismatch& mismatch = kExact) {
  const auto filter = started(model, 12, mismatch);
  std::vector<MotionInput> ahead;
  for (int row = 1; row <= state.range(0); ++row)
    ahead.emplace_back(model::OdometrySample{0.02 * row, 0.5, 0.1, 0.2});
  const auto call = [&] {
    Filter::Prediction prediction = filter->prediction();
    for (const MotionInput& input : ahead) filter->carry(prediction, input);
    benchmark::DoNotOptimize(filter->estimate(prediction));
  };
  for (auto _ : state) call();
  report_percentiles(state, call);
}

// An anchor that replaces another one in the active set, including the update by its range.
void exchange(benchmark::State& state, Model model) {
  const int anchors = static_cast<int>(state.range(0));
  Config config;
  config.model = model;
  config.silent_s = 0.0;
  const model::Calibration calibration = ring_of(anchors);
  const auto filter =
      std::make_unique<Filter>(testing::hills(0.2), testing::three_tags(), calibration, config);
  filter->process(model::OdometrySample{0.0, 0.0, 0.0, 0.0});
  filter->start({.t_s = 0.0});
  int next = 0;
  const auto call = [&] {
    const Eigen::Vector3d& position = calibration.anchors[static_cast<std::size_t>(next)].position_m;
    benchmark::DoNotOptimize(filter->process({.t_s = 0.0,
                                              .tag_id = 1,
                                              .anchor_id = static_cast<model::NodeId>(10 + next),
                                              .range_m = position.norm()}));
    next = next + 1 == anchors ? 0 : next + 1;
  };
  for (auto _ : state) call();
  report_percentiles(state, call);
}

// Speed relative to real time for 60 s with 300 ranges and 20 odometry samples per second.
void replay_at_300(benchmark::State& state, Model model) {
  const model::Surface surface = testing::hills(0.2);
  const model::Calibration calibration = ring_of(12);
  const std::vector<model::Tag> tags = testing::three_tags();
  test::Random random(1);
  constexpr double kDuration_s = 60.0;
  const testing::Drive drive =
      testing::drive(surface, calibration, {}, {.duration_s = kDuration_s, .range_s = 1.0 / 300.0}, random);
  ReplayOptions options;
  options.config.model = model;
  const Run run{drive.odometry, drive.ranges, tags, &surface, &calibration};
  for (auto _ : state) benchmark::DoNotOptimize(replay(run, options));
  state.counters["times_real_time"] =
      benchmark::Counter(kDuration_s * static_cast<double>(state.iterations()), benchmark::Counter::kIsRate);
}

// A start search over 6 s with 300 ranges per second. agreeing: false for random ranges that fit no pose, as
// for a lost robot, which searches twice per second.
void search(benchmark::State& state, bool agreeing) {
  const model::Surface surface = testing::hills(0.2);
  const model::Calibration calibration = ring_of(12);
  const std::vector<model::Tag> tags = testing::three_tags();
  test::Random random(1);
  const testing::Drive drive =
      testing::drive(surface, calibration, {}, {.duration_s = 6.0, .range_s = 1.0 / 300.0}, random);
  const auto searching = std::make_unique<StartSearch>(surface, tags, calibration, Config{});
  std::size_t row = 0;
  for (model::RangeSample range : drive.ranges) {
    for (; row < drive.odometry.size() && drive.odometry[row].t_s <= range.t_s; ++row)
      searching->process(drive.odometry[row]);
    if (!agreeing) range.range_m = random.uniform(5.0, 30.0);
    searching->process(range);
  }
  for (auto _ : state) benchmark::DoNotOptimize(searching->search());
  state.counters["ranges"] = static_cast<double>(searching->ranges());
}

void sizes(benchmark::internal::Benchmark* of) {
  for (const int anchors : {4, 8, 12, 16, 64, 256, 1000}) of->Arg(anchors);
}

BENCHMARK_CAPTURE(propagate, odometry, Model::kOdometry)->Arg(12);
BENCHMARK_CAPTURE(propagate, schmidt, Model::kSchmidt)->Apply(sizes);
BENCHMARK_CAPTURE(propagate, joint, Model::kJoint)->Apply(sizes);
BENCHMARK_CAPTURE(propagate, schmidt_mismatch, Model::kSchmidt, kDiffers)->Arg(12);
BENCHMARK_CAPTURE(propagate, joint_mismatch, Model::kJoint, kDiffers)->Arg(12);
BENCHMARK_CAPTURE(update, original, Model::kOriginal)->Arg(12);
BENCHMARK_CAPTURE(update, inflated, Model::kInflated)->Arg(12);
BENCHMARK_CAPTURE(update, schmidt, Model::kSchmidt)->Apply(sizes);
BENCHMARK_CAPTURE(update, anchor_states, Model::kAnchorStates)->Arg(12);
BENCHMARK_CAPTURE(update, joint, Model::kJoint)->Apply(sizes);
BENCHMARK_CAPTURE(update, schmidt_mismatch, Model::kSchmidt, kDiffers)->Arg(12);
BENCHMARK_CAPTURE(update, joint_mismatch, Model::kJoint, kDiffers)->Arg(12);
BENCHMARK_CAPTURE(move_and_update, schmidt, Model::kSchmidt)->Arg(12);
BENCHMARK_CAPTURE(move_and_update, joint, Model::kJoint)->Arg(12);
BENCHMARK_CAPTURE(predict, schmidt, Model::kSchmidt)->Arg(1)->Arg(10)->Arg(40);
BENCHMARK_CAPTURE(predict, joint, Model::kJoint)->Arg(10);
BENCHMARK_CAPTURE(predict, schmidt_mismatch, Model::kSchmidt, kDiffers)->Arg(10);
BENCHMARK_CAPTURE(exchange, schmidt, Model::kSchmidt)->Arg(64)->Arg(1000);
BENCHMARK_CAPTURE(exchange, joint, Model::kJoint)->Arg(64)->Arg(1000);
BENCHMARK_CAPTURE(search, agreeing, true)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(search, lost, false)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(replay_at_300, schmidt, Model::kSchmidt)->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(replay_at_300, joint, Model::kJoint)->Unit(benchmark::kMillisecond);

}  // namespace
}  // namespace groma::filter
