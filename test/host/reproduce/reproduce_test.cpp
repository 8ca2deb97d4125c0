#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <set>

#include "firmware/sim/world/built_in_scenarios.hpp"
#include "firmware/sim/world/world.hpp"
#include "host/reproduce/drawn_calibration.hpp"
#include "host/reproduce/paper.hpp"
#include "host/reproduce/report.hpp"
#include "host/reproduce/rows.hpp"
#include "host/reproduce/runner.hpp"
#include "host/reproduce/sensitivity.hpp"
#include "host/reproduce/summary.hpp"
#include "host/simulation/drive_dataset.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::reproduce {
namespace {

TEST(DrawnCalibration, IsAsFarOffAsTable1SaysAndMostlyInHeight) {
  const sim::Scenario scenario = sim::paper_warehouse();
  const sim::World world(scenario, 3);
  const io::Dataset drive = simulation::measure_drives(scenario, {.seed = 3, .ranges_per_s = 30.0}).at(0);
  const model::Calibration drawn = drawn_calibration(world, drive, scenario.anchors, 3);
  ASSERT_EQ(drawn.anchors.size(), kTable1.size());
  for (std::size_t i = 0; i < kTable1.size(); ++i) {
    const model::AnchorCalibration& anchor = drawn.anchors[i];
    const auto truth = std::find_if(scenario.anchors.begin(), scenario.anchors.end(),
                                    [&](const model::Anchor& of) { return of.id == anchor.id; });
    const Eigen::Vector3d error_m = anchor.position_m - truth->position_m;
    EXPECT_NEAR(error_m.norm(), kTable1.at(i).error_m, 1e-9);
    EXPECT_NEAR(std::abs(error_m.z()), 0.9 * error_m.norm(), 1e-9);
    EXPECT_DOUBLE_EQ(anchor.covariance(1, 1), kTable1.at(i).variance_m2);
  }
  // The bias takes up what the wrong place leaves, so that ranges fit in the middle of the drive.
  const model::AnchorCalibration* eight = model::find_anchor(drawn, 8);
  ASSERT_NE(eight, nullptr);
  for (const model::PairBias& pair : eight->pairs)
    EXPECT_NEAR(pair.beta_m, world.bias(pair.tag_id, 8).beta_m, 0.12) << pair.tag_id;
}

TEST(MeasuredDrives, AreDeterministicAndAsTheWorldIs) {
  const sim::Scenario scenario = sim::paper_forklift();
  const auto once = simulation::measure_drives(scenario, {.seed = 4, .ranges_per_s = 20.0});
  const auto again = simulation::measure_drives(scenario, {.seed = 4, .ranges_per_s = 20.0});
  const sim::World world(scenario, 4);
  ASSERT_EQ(once.size(), 2U);
  ASSERT_EQ(once[1].ranges.size(), again[1].ranges.size());
  double squares = 0.0;
  for (std::size_t i = 0; i < once[1].ranges.size(); ++i) {
    const model::RangeSample& range = once[1].ranges[i];
    EXPECT_EQ(range.range_m, again[1].ranges[i].range_m);
    const double flight_m = world.between(range.tag_id, range.anchor_id, range.t_s).flight_m;
    squares += std::pow(range.range_m - flight_m, 2);
  }
  EXPECT_NEAR(std::sqrt(squares / static_cast<double>(once[1].ranges.size())), 0.03, 0.002);
  EXPECT_EQ(once[1].odometry.back().vx_mps, again[1].odometry.back().vx_mps);
  EXPECT_GT(once[1].ground_truth.size(), 6000U);
}

TEST(Factors, ChangeWhatTheyName) {
  std::set<std::string> names;
  for (const Factor& factor : factors()) {
    EXPECT_TRUE(names.insert(factor.name).second) << factor.name;
    ASSERT_LT(factor.usual, factor.levels.size()) << factor.name;
  }
  const auto find = [](const std::string& name) -> const Factor& {
    return *std::find_if(factors().begin(), factors().end(),
                         [&](const Factor& of) { return of.name == name; });
  };
  Conditions conditions{.scenario = sim::paper_warehouse(), .measurement = {}, .alter = {}};
  find("anchors").levels.front().change(conditions);
  EXPECT_EQ(conditions.scenario.anchors.size(), 3U);
  find("range-rate").levels.front().change(conditions);
  EXPECT_EQ(conditions.measurement.ranges_per_s, 5.0);
}

TEST(Sensitivity, PosesThatAreWrongByDecimetresWorsenTheAnchors) {
  Factor drift = *std::find_if(factors().begin(), factors().end(),
                               [](const Factor& of) { return of.name == "pose-noise"; });
  drift.levels = {drift.levels.front(), drift.levels.back()};
  const Json result = run_factor(drift, 1);
  ASSERT_EQ(result.size(), 2U);
  EXPECT_LT(result[0]["score"]["ate_m"]["mean"].get<double>(), 0.03);
  EXPECT_GE(result[0]["anchors_ok"].get<double>(), 6.0);
  EXPECT_LT(result[1]["anchors_ok"].get<double>(), 3.0) << "no anchor is better than its poses";
}

TEST(Band, IsMedianAndQuantiles) {
  std::vector<double> values;
  for (int i = 0; i <= 100; ++i) values.push_back(i);
  values.push_back(std::nan(""));
  const Band of = band(values);
  EXPECT_EQ(of.count, 101U);
  EXPECT_NEAR(of.low, 5.0, 1.0);
  EXPECT_EQ(of.median, 50.0);
  EXPECT_NEAR(of.high, 95.0, 1.0);
  EXPECT_EQ(band({}).count, 0U);
  EXPECT_DOUBLE_EQ(band({1.0, 3.0, 2.0}).high, 2.9);
  EXPECT_DOUBLE_EQ(band({1.0, 2.0}).median, 1.5);
}

// A result of one seed with these figures at one level or method.
Json scored(double ate_m, double nees) {
  return {{"ate_m", {{"mean", ate_m}, {"max", 2.0 * ate_m}}}, {"nees", {{"mean", nees}}}};
}

TEST(Summary, SaysAtWhichLevelsAFactorBreaks) {
  const Factor& factor = factors().front();
  Outcome outcome;
  for (const std::uint64_t seed : {1U, 2U, 3U}) {
    Json levels = Json::array();
    for (std::size_t i = 0; i < factor.levels.size(); ++i) {
      const double ate_m = i + 1 == factor.levels.size() ? 0.4 : 0.02;
      levels.push_back(
          {{"score", scored(ate_m + 0.001 * static_cast<double>(seed), 1.0)}, {"anchor_error_m", 0.03}});
    }
    outcome.results["sensitivity"][factor.name][seed] = levels;
  }
  const Json summary = summary_of(outcome).at("sensitivity");
  ASSERT_EQ(summary.size(), factor.levels.size());
  for (std::size_t i = 0; i < factor.levels.size(); ++i) {
    const Json& level = summary.at(factor.name + ": " + factor.levels[i].label);
    EXPECT_EQ(level.at("is_broken").get<bool>(), i + 1 == factor.levels.size());
    EXPECT_EQ(level.at("ours").at("ate_m_mean").at("seeds").get<int>(), 3);
  }
  const Json& first = summary.begin()->at("ours");
  EXPECT_NEAR(first.at("ate_m_mean").at("median").get<double>(), 0.022, 1e-12);
  EXPECT_NEAR(first.at("anchor_error_m").at("median").get<double>(), 0.03, 1e-12);
}

TEST(Summary, ANeesAboveFourIsABreakToo) {
  const LevelBands usual{.ate_m = band({0.02}), .nees = band({1.0}), .anchors_m = band({0.02})};
  EXPECT_FALSE(is_broken(usual, usual));
  EXPECT_TRUE(is_broken({.ate_m = band({0.02}), .nees = band({4.1}), .anchors_m = band({0.02})}, usual));
  EXPECT_TRUE(is_broken({.ate_m = band({0.1}), .nees = band({1.0}), .anchors_m = band({0.02})}, usual));
}

TEST(Summary, PutsBaselinesAndRecordedRunsWithTheirOwners) {
  Outcome outcome;
  outcome.results["baselines"][""][1] = {{"schmidt", {{"score", scored(0.02, 1.0)}, {"us_per_range", 2.0}}},
                                         {"trilateration", {{"score", nullptr}, {"us_per_range", 1.0}}}};
  outcome.results["recorded"]["a hall, halves"][1] = {
      {"adapted", {{"ours", {{"score", scored(0.1, 1.0)}}}, {"published", {{"score", scored(0.2, 9.0)}}}}}};
  const Json summary = summary_of(outcome);
  EXPECT_TRUE(summary.at("baselines").at("schmidt").contains("ours"));
  const Json& other = summary.at("baselines").at("trilateration").at("published");
  EXPECT_TRUE(other.at("ate_m_mean").at("median").is_null());
  EXPECT_EQ(other.at("us_per_range").at("median").get<double>(), 1.0);
  const Json& run = summary.at("recorded").at("a hall, halves: adapted");
  EXPECT_EQ(run.at("ours").at("ate_m_max").at("median").get<double>(), 0.2);
  EXPECT_EQ(run.at("published").at("nees_mean").at("median").get<double>(), 9.0);
}

class RunnerTest : public ::testing::Test {
 protected:
  [[nodiscard]] Plan plan(std::size_t seeds) const {
    return {.wanted = {"table3"},
            .seeds = seeds,
            .has_firmware = false,
            .folder = folder_.path(),
            .recorded = {},
            .progress = {}};
  }
  test::ScratchFolder folder_;
};

TEST_F(RunnerTest, KeepsResultsAndGoesOnFromThem) {
  const Outcome first = run(plan(1));
  const std::filesystem::path file = folder_ / "runs" / "table3-1.json";
  ASSERT_TRUE(std::filesystem::exists(file));
  EXPECT_FALSE(std::filesystem::exists(folder_ / "scratch"));
  // What is there is not computed again: a changed file shows in the results.
  Json stored = Json::parse(std::ifstream(file));
  stored["result"]["marked"] = true;
  std::ofstream(file) << stored.dump();
  const Outcome second = run(plan(2));
  const Seeds& seeds = second.results.at("table3").at("");
  ASSERT_EQ(seeds.size(), 2U);
  EXPECT_TRUE(seeds.at(1).value("marked", false));
  EXPECT_FALSE(seeds.at(2).value("marked", false));
  // Of another build: again.
  stored["groma"] = "0.0.0-other";
  std::ofstream(file) << stored.dump();
  EXPECT_FALSE(run(plan(1)).results.at("table3").at("").at(1).value("marked", false));
  // Not JSON: again. Times differ, scores do not.
  std::ofstream(file) << "{";
  const auto score = [](const Outcome& outcome) {
    return outcome.results.at("table3")
        .at("")
        .at(1)
        .at("pre-calibrated")
        .at("adapted")
        .at("ours")
        .at("score");
  };
  EXPECT_EQ(score(run(plan(1))), score(first));
}

// The anchors' curves are of seed 1 alone.
TEST_F(RunnerTest, DoesNotComputeASeedWithoutAResultAgain) {
  Plan curves = plan(2);
  curves.wanted = {"anchor-states"};
  const Outcome outcome = run(curves);
  EXPECT_GT(outcome.results.at("anchor-states").at("").at(1).size(), 1000U);
  const std::filesystem::path file = folder_ / "runs" / "anchor-states-2.json";
  Json stored = Json::parse(std::ifstream(file));
  EXPECT_TRUE(stored.at("result").is_null());
  stored["kept"] = true;
  std::ofstream(file) << stored.dump();
  EXPECT_TRUE(run(curves).results.at("anchor-states").at("").at(2).is_null());
  EXPECT_TRUE(Json::parse(std::ifstream(file)).value("kept", false));
}

TEST_F(RunnerTest, SummaryAndPageHaveThePapersFiguresBesideOurs) {
  const Plan of = plan(2);
  const Outcome outcome = run(of);
  const Json summary = summary_of(outcome);
  const Json& adapted = summary.at("table3").at("pre-calibrated: adapted").at("ours").at("ate_m_mean");
  EXPECT_EQ(adapted.at("paper").get<double>(), table3::kAdapted.ate_m.mean);
  EXPECT_EQ(adapted.at("seeds").get<int>(), 2);
  EXPECT_GT(adapted.at("median").get<double>(), 0.0);
  EXPECT_LE(adapted.at("low").get<double>(), adapted.at("high").get<double>());
  const std::string html = page_of(outcome, of).html();
  EXPECT_THAT(html, testing::HasSubstr("Table III: the forklift"));
  EXPECT_THAT(html, testing::HasSubstr("0.128"));
  EXPECT_THAT(html, testing::Not(testing::HasSubstr("nan")));
}

}  // namespace
}  // namespace groma::reproduce
