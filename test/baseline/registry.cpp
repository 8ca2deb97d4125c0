// The methods, their tuned parameters, and what `tune` searches.
#include <array>

#include "test/baseline/graph.hpp"
#include "test/baseline/kalman.hpp"
#include "test/baseline/method.hpp"
#include "test/baseline/particle_filter.hpp"
#include "test/baseline/trilateration.hpp"

namespace groma::baseline {

namespace {

constexpr Searched kRangeFactor{"range_factor", &Parameters::range_factor, 0.5, 20.0};
constexpr Searched kOdometryFactor{"odometry_factor", &Parameters::odometry_factor, 0.3, 10.0};
constexpr Searched kGate{"gate", &Parameters::gate, 1.5, 20.0};
constexpr Searched kKernel{"kernel", &Parameters::kernel, 0.3, 10.0};

template <class Of>
std::unique_ptr<Method> make(const Drive& drive, const Parameters& parameters, std::uint64_t /*seed*/) {
  return std::make_unique<Of>(drive, parameters);
}
template <RangeModel kModel>
std::unique_ptr<Method> make_paper(const Drive& drive, const Parameters& parameters, std::uint64_t /*seed*/) {
  return std::make_unique<PaperFilter>(drive, parameters, kModel);
}
std::unique_ptr<Method> make_particles(const Drive& drive, const Parameters& parameters, std::uint64_t seed) {
  return std::make_unique<ParticleFilter>(drive, parameters, seed);
}

}  // namespace

// `tuned` is what this found on the second drives D of `groma demo --seed S --report R`, R/calibration.yaml,
// S from 101 on, which no table uses, rounded to three digits:
//   groma-baselines tune METHOD --runs D=R/calibration.yaml ... --draws 100     seeds 101 to 104
//   groma-baselines tune particle-filter ... --draws 30 --to 170                seeds 101 to 103
//   groma-baselines tune ceres-window ... --draws 24 --to 200                   seeds 101 to 103
// The kernel of ceres-batch is the best of those that `reference --kernel` was tried with on seeds 101 to
// 104: docs/reference/baselines.md.
const std::vector<MethodInfo>& methods() {
  static const std::vector<MethodInfo> all{
      {.name = "paper-odometry",
       .text = "the source paper's propagation alone",
       .plain = {},
       .tuned = {},
       .searched = {},  // its estimates do not depend on the noise
       .make = make<OdometryOnly>},
      {.name = "paper-original",
       .text = "error-state EKF on the surface, pure ranges (4), R = sigma^2; no gate",
       .plain = {},
       .tuned = {.range_factor = 0.594, .odometry_factor = 3.06, .gate = 1.65},
       .searched = {kRangeFactor, kOdometryFactor, kGate},
       .make = make_paper<RangeModel::kPure>},
      {.name = "paper-adapted",
       .text = "the same with biases (12) and R + J Pc J^T (18); no gate",
       .plain = {},
       .tuned = {.range_factor = 0.643, .odometry_factor = 0.516, .gate = 4.25},
       .searched = {kRangeFactor, kOdometryFactor, kGate},
       .make = make_paper<RangeModel::kBiased>},
      {.name = "paper-anchor-states",
       .text = "paper-adapted with anchor positions as auxiliary states, uncorrelated with each other",
       .plain = {},
       .tuned = {.range_factor = 0.594, .odometry_factor = 3.06, .gate = 1.65},
       .searched = {kRangeFactor, kOdometryFactor, kGate},
       .make = make<AnchorStatesFilter>},
      {.name = "trilateration",
       .text = "loosely coupled: a robust fix of each short window, in an EKF with odometry",
       .plain = {},
       .tuned = {.range_factor = 0.638,
                 .odometry_factor = 0.399,
                 .gate = 5.42,
                 .kernel = 0.462,
                 .window_s = 0.118},
       .searched =
           {kRangeFactor, kOdometryFactor, kGate, kKernel, {"window_s", &Parameters::window_s, 0.05, 1.0}},
       .make = make<Trilateration>},
      {.name = "iterated-ekf",
       .text = "iterated EKF with biases, R + J Pc J^T, odometry scale and yaw-rate bias",
       .plain = {},
       .tuned = {.range_factor = 0.517, .odometry_factor = 0.530, .gate = 1.78, .kernel = 0.451},
       .searched = {kRangeFactor, kOdometryFactor, kGate, kKernel},
       .make = make<IteratedFilter>},
      {.name = "particle-filter",
       .text = "1000 particles with the model of iterated-ekf",
       .plain = {},
       .tuned = {.range_factor = 0.574, .odometry_factor = 0.324, .outlier_share = 0.0342},
       .searched = {kRangeFactor, kOdometryFactor, {"outlier_share", &Parameters::outlier_share, 1e-3, 0.5}},
       .make = make_particles},
      {.name = "ceres-window",
       .text = "factor graph over a sliding window of 4 s, marginalized",
       .plain = {.window_s = 4.0},
       .tuned = {.range_factor = 11.1, .odometry_factor = 0.936, .kernel = 0.524, .window_s = 4.0},
       .searched = {kRangeFactor, kOdometryFactor, kKernel},
       .make = make<CeresWindow>},
      {.name = "ceres-batch",
       .text = "the causal reference: factor graph over all data up to each second",
       .plain = {},
       .tuned = {.kernel = 0.17},
       .searched = {kRangeFactor, kOdometryFactor, kKernel},
       .make = [](const Drive& drive, const Parameters& parameters, std::uint64_t /*seed*/)
           -> std::unique_ptr<Method> { return std::make_unique<CeresBatch>(drive, parameters); }},
  };
  return all;
}

const MethodInfo* find_method(std::string_view name) {
  for (const MethodInfo& method : methods()) {
    if (method.name == name) return &method;
  }
  return nullptr;
}

}  // namespace groma::baseline
