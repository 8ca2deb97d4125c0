// The anchors that the demo's first drive calibrates, over the seeds 1 to GROMA_LAST_SEED: errors and
// consistency of those with verdict ok. Prints a table by anchor.
#include <gtest/gtest.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <map>

#include <Eigen/Cholesky>

#include "firmware/sim/world/built_in_scenarios.hpp"
#include "firmware/sim/world/scenario.hpp"
#include "firmware/sim/world/world.hpp"
#include "host/daemon/calibration_drive.hpp"
#include "host/simulation/lock_step.hpp"

namespace groma::simulation {
namespace {

constexpr double kOutside = 3.73 * 3.73;  // chi-square of three dimensions: 99.7 %
constexpr double kFarOutside = 5.0 * 5.0;
constexpr double kLargestError_m = 0.1;
constexpr std::size_t kEnough = 5;  // seeds in which an anchor is ok, for its own mean

calibration::Result calibrate_first_drive(const sim::Scenario& scenario, std::uint64_t seed) {
  SiteOptions options;
  options.seed = seed;
  LockStep site(scenario, options);
  daemon::CalibrationDrive drive(scenario.tags, scenario.ground, {});
  site.session().attach(drive);
  site.run_until(site.site().world().drives().at(0).end_s);
  return drive.solve();
}

// Of one anchor, over the seeds in which it is ok.
struct Tally {
  std::size_t ok = 0;
  double error_sum_m = 0.0;
  double largest_m = 0.0;
  double nees_sum = 0.0;  // of e' P^-1 e / 3

  [[nodiscard]] double mean_nees() const { return nees_sum / static_cast<double>(ok); }
};

TEST(DemoAnchors, AreWhereTheirCovariancesSay) {
  const sim::Scenario scenario = sim::paper_hall();
  std::map<model::NodeId, Tally> tallies;
  std::size_t ok = 0;
  std::size_t all = 0;
  std::size_t outside = 0;
  for (std::uint64_t seed = 1; seed <= GROMA_LAST_SEED; ++seed) {
    const calibration::Result result = calibrate_first_drive(scenario, seed);
    for (const model::Anchor& truth : scenario.anchors) {
      ++all;
      const model::AnchorCalibration* found = model::find_anchor(result.calibration, truth.id);
      if (found == nullptr || found->verdict != model::AnchorVerdict::kOk) continue;
      ++ok;
      const Eigen::Vector3d error_m = found->position_m - truth.position_m;
      const Eigen::Matrix3d covariance = found->covariance.topLeftCorner<3, 3>();
      const double square = error_m.dot(covariance.ldlt().solve(error_m));
      outside += square > kOutside ? 1 : 0;
      EXPECT_LT(square, kFarOutside) << "anchor " << truth.id << ", seed " << seed;
      EXPECT_LT(error_m.norm(), kLargestError_m) << "anchor " << truth.id << ", seed " << seed;
      Tally& tally = tallies[truth.id];
      ++tally.ok;
      tally.error_sum_m += error_m.norm();
      tally.largest_m = std::max(tally.largest_m, error_m.norm());
      tally.nees_sum += square / 3.0;
    }
  }
  std::printf("anchor    ok  mean error m  largest m  mean e' P^-1 e / 3\n");
  double mean_sum = 0.0;
  std::size_t judged = 0;
  for (const auto& [id, tally] : tallies) {
    std::printf("%6u  %4zu  %12.3f  %9.3f  %.2f\n", static_cast<unsigned>(id), tally.ok,
                tally.error_sum_m / static_cast<double>(tally.ok), tally.largest_m, tally.mean_nees());
    if (tally.ok < kEnough) continue;
    EXPECT_LT(tally.mean_nees(), 1.5) << "anchor " << id;
    mean_sum += tally.mean_nees();
    ++judged;
  }
  std::printf("ok: %zu of %zu; outside 3.73 sigma: %zu; mean over anchors %.2f\n", ok, all, outside,
              mean_sum / static_cast<double>(std::max<std::size_t>(judged, 1)));
  EXPECT_GE(static_cast<double>(ok), 155.0 / 240.0 * static_cast<double>(all));
  EXPECT_LE(outside, 2U);
  if (judged > 0) EXPECT_GT(mean_sum, 0.4 * static_cast<double>(judged));
}

}  // namespace
}  // namespace groma::simulation
