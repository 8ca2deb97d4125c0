// Each mistake on simulated sites and recorded runs, at three sizes where it has one: how often its cause is
// named first, with the right size, and how often another one. Prints a table. GROMA_LAST_SEED seeds a site;
// GROMA_RECORDED: also the recorded runs beside the repository.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <map>
#include <string>

#include "host/calibration/calibrate.hpp"
#include "host/diagnosis/diagnose.hpp"
#include "host/io/dataset.hpp"
#include "test/host/calibration/site_simulation.hpp"
#include "test/host/diagnosis/mistakes.hpp"
#include "test/support/shared_data.hpp"

namespace groma::diagnosis {
namespace {

// A simulated drive with odometry: white noise, a scale of 1 % and a yaw-rate bias. The robot swings about
// its course, so that it also moves sideways.
Data simulated_drive(test::Route route, std::uint64_t seed) {
  const test::SimulatedSite site = test::simulate_site({.route = route,
                                                        .ranges_per_pair = 250,
                                                        .outlier_share = 0.05,
                                                        .pose_sigma_m = 0.02,
                                                        .pose_yaw_sigma_rad = 0.005},
                                                       seed);
  test::Random random(seed + 1000);
  Data data{.poses = site.poses,
            .odometry = {},
            .ranges = site.ranges,
            .dropped_ranges = {},
            .tags = site.tags,
            .anchors = site.anchors,
            .priors = site.drive().priors,
            .surface = site.floor};
  for (std::size_t i = 0; i + 1 < site.truth.size(); ++i) {
    const model::PoseSample& now = site.truth[i];
    const model::PoseSample& next = site.truth[i + 1];
    const double dt_s = next.t_s - now.t_s;
    const double turn_rad = model::wrap_angle(next.yaw_rad - now.yaw_rad);
    const Eigen::Vector2d moved_m = Eigen::Rotation2Dd(-now.yaw_rad - 0.5 * turn_rad) *
                                    Eigen::Vector2d(next.x_m - now.x_m, next.y_m - now.y_m);
    data.odometry.push_back({now.t_s, 1.01 * moved_m.x() / dt_s + 0.02 * random.gaussian(),
                             1.01 * moved_m.y() / dt_s + 0.02 * random.gaussian(),
                             turn_rad / dt_s + 0.001 + 0.006 * random.gaussian()});
  }
  return data;
}

// Sizes s, 3 s and 10 s; s is stated in docs/reference/commands.md.
std::vector<test::MistakeMade> mistakes() {
  std::vector<test::MistakeMade> out;
  for (const double times : {1.0, 3.0, 10.0}) {
    out.push_back(test::clock_offset(0.1 * times));
    out.push_back(test::clock_drift(1e-3 * times));
    out.push_back(test::heading_offset(0.15 * times));
    out.push_back(test::yaw_rate_scale(1.0 + 0.05 * times));
    out.push_back(test::odometry_scale(1.0 + 0.05 * times));
    out.push_back(test::lever_arm({0.3 * times, 0.0, 0.0}));
    out.push_back(test::surface_height(0.3 * times));
  }
  for (const double factor : {1e3, 1e6}) out.push_back(test::time_unit(factor));
  for (const double factor : {1e3, 1.0 / 0.3048}) out.push_back(test::length_unit(factor));
  out.push_back(test::angle_unit());
  out.push_back(test::time_overlap());
  out.push_back(test::heading_sign());
  out.push_back(test::yaw_rate_sign());
  out.push_back(test::swapped_tags());
  out.push_back(test::odometry_of_another_drive());
  out.push_back(test::unknown_tag());
  out.push_back(test::unknown_anchor());
  out.push_back(test::renumbered_anchors());
  out.push_back(test::another_site());
  return out;
}

struct Count {
  int cases = 0;
  int named = 0;
  int other = 0;
  int sized = 0;  // of those named that have a sigma
  int sizes = 0;
};

class Table {
 public:
  void add(const test::MistakeMade& made, const std::vector<Finding>& findings) {
    Count& count = counts_[made.cause];
    ++count.cases;
    if (findings.empty()) return;
    const Finding& first = findings.front();
    if (first.cause != made.cause) {
      ++count.other;
      return;
    }
    ++count.named;
    if (first.sigma.size() != made.value.size()) return;
    for (std::size_t i = 0; i < first.sigma.size(); ++i) {
      ++count.sizes;
      if (std::abs(first.value[i] - made.value[i]) < 3.0 * first.sigma[i]) ++count.sized;
    }
  }
  void print() const {
    std::printf("%-28s %6s %6s %6s %14s\n", "cause", "cases", "named", "other", "within 3 sigma");
    for (const auto& [cause, count] : counts_) {
      std::printf("%-28s %6d %6d %6d %7d of %3d\n", cause.c_str(), count.cases, count.named, count.other,
                  count.sized, count.sizes);
    }
    const Count all = total();
    std::printf("%-28s %6d %6d %6d %7d of %3d\n", "all", all.cases, all.named, all.other, all.sized,
                all.sizes);
  }
  [[nodiscard]] Count total() const {
    Count sum;
    for (const auto& [cause, count] : counts_) {
      sum.cases += count.cases;
      sum.named += count.named;
      sum.other += count.other;
      sum.sized += count.sized;
      sum.sizes += count.sizes;
    }
    return sum;
  }

 private:
  std::map<std::string, Count> counts_;
};

TEST(MistakesCampaign, NamesTheRightCauseFirst) {
  const char* const last = std::getenv("GROMA_LAST_SEED");
  const std::uint64_t last_seed = last != nullptr ? std::stoull(last) : 3;
  Table table;
  int clean = 0;
  const auto run = [&](const Data& data, const std::string& name) {
    const std::vector<Finding> nothing = diagnose(data);
    ++clean;
    EXPECT_THAT(nothing, testing::IsEmpty())
        << name << ": " << (nothing.empty() ? "" : nothing.front().cause);
    for (const test::MistakeMade& made : mistakes()) {
      Data changed = data;
      made.make(changed);
      table.add(made, diagnose(std::move(changed)));
    }
  };
  for (const test::Route route : {test::Route::kWaves, test::Route::kEight, test::Route::kEllipse}) {
    for (std::uint64_t seed = 1; seed <= last_seed; ++seed)
      run(simulated_drive(route, seed), "route " + std::to_string(static_cast<int>(route)));
  }
  for (const char* name : {"real/lias_fast", "real/mcd_ntu_day_09"}) {
    const auto path = test::shared_data(name);
    if (path) run(data_of(io::read_dataset(*path)), name);
  }
  table.print();
  std::printf("%d drives without a mistake\n", clean);
  const Count all = table.total();
  EXPECT_GE(all.named, 0.9 * all.cases);
  EXPECT_LE(all.other, 0.02 * all.cases);
  EXPECT_GE(all.sized, 0.9 * all.sizes);
}

}  // namespace
}  // namespace groma::diagnosis
