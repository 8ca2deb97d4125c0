// The program groma as a child process: its files, output and exit codes.
#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <filesystem>
#include <map>
#include <regex>
#include <set>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include <Eigen/Cholesky>
#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/estimate_file.hpp"
#include "host/io/log_file.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/small_run.hpp"

namespace groma {
namespace {

using nlohmann::json;
using test::ChildOptions;
using test::ChildResult;
using test::read_text;
using testing::AllOf;
using testing::HasSubstr;
using testing::IsEmpty;
using testing::Not;

constexpr double kDrive_s = 80.0;

class CliTest : public testing::Test {
 protected:
  CliTest() {
    std::filesystem::create_directory(data_);
    io::write_dataset(data_, test::make_small_run(kDrive_s, 1));
  }

  static ChildResult groma(std::vector<std::string> arguments, const ChildOptions& options = {}) {
    arguments.insert(arguments.begin(), GROMA_EXECUTABLE);
    return test::run_child(arguments, options);
  }
  [[nodiscard]] ChildResult calibrate(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> arguments{"calibrate", data_, "-o", calibration_};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return groma(arguments);
  }
  // As calibrate() does with the data set as it is at a test's start, but once for all tests.
  void write_calibration() const {
    static const std::string once = [this] {
      const ChildResult result = calibrate();
      EXPECT_EQ(result.exit_code, 0) << result.err;
      return read_text(calibration_);
    }();
    folder_.write("calibration.yaml", once);
  }
  [[nodiscard]] ChildResult replay(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> arguments{"replay", data_, "-o", estimate_};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return groma(arguments);
  }
  [[nodiscard]] ChildResult replay_calibrated(std::vector<std::string> more = {}) const {
    more.insert(more.end(), {"--calibration", calibration_});
    return replay(more);
  }
  [[nodiscard]] json evaluate() const {
    const ChildResult result = groma({"evaluate", estimate_, data_ / "groundtruth.csv", "--json"});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return json::parse(result.out);
  }
  // Replaces line `number`, from 1, of a file of the data set.
  void replace_line(const std::string& file, std::size_t number, const std::string& line) const {
    std::istringstream in(read_text(data_ / file));
    std::string text;
    std::string of;
    for (std::size_t i = 1; std::getline(in, of); ++i) text += (i == number ? line : of) + "\n";
    folder_.write("data/" + file, text);
  }
  // Appends a line to a file of the data set.
  void append(const std::string& file, const std::string& line) const {
    folder_.write("data/" + file, read_text(data_ / file) + line + "\n");
  }
  [[nodiscard]] std::size_t files() const {
    return static_cast<std::size_t>(std::distance(std::filesystem::directory_iterator(folder_.path()), {}));
  }

  test::ScratchFolder folder_;
  std::filesystem::path data_ = folder_ / "data";
  std::filesystem::path calibration_ = folder_ / "calibration.yaml";
  std::filesystem::path estimate_ = folder_ / "estimate.csv";
};

// A quarter of the drive determines the anchors poorly; ranges between anchors combine the information.
TEST_F(CliTest, SolvesAnchorsTogetherWithTheRangesOfASurvey) {
  const std::vector<model::Anchor> truth = io::read_dataset(data_).surveyed_anchors;
  std::string survey = "anchor_id,other_id,range_m,sigma_m,count\n";
  test::SmallNoise noise(5);
  for (const model::Anchor& from : truth) {
    for (const model::Anchor& to : truth) {
      if (from.id == to.id) continue;
      // With the pairs' mean bias, like ranges between tags and anchors.
      const double range_m = (from.position_m - to.position_m).norm() + 0.2 + 0.02 * noise();
      survey += std::to_string(from.id) + ',' + std::to_string(to.id) + ',' + std::to_string(range_m) +
                ",0.05,20\n";
    }
  }
  folder_.write("survey.csv", survey);

  struct Sum {
    double square_error_m2 = 0.0;
    double variance_m2 = 0.0;
  };
  const auto sum_up = [&] {
    Sum out;
    const model::Calibration found = io::read_calibration(calibration_);
    EXPECT_EQ(found.anchors.size(), truth.size());
    for (std::size_t i = 0; i < truth.size(); ++i) {
      const model::AnchorCalibration& anchor = found.anchors[i];
      const Eigen::Vector3d error_m = anchor.position_m - truth[i].position_m;
      const Eigen::Matrix3d covariance = anchor.covariance.topLeftCorner<3, 3>();
      EXPECT_LT(error_m.dot(covariance.ldlt().solve(error_m)), 21.1) << anchor.id << ", 99.99 %";
      out.square_error_m2 += error_m.squaredNorm();
      out.variance_m2 += covariance.trace();
    }
    return out;
  };
  ASSERT_THAT(calibrate({"--to", "20"}).exit_code, testing::AnyOf(0, 3));
  const Sum alone = sum_up();
  const ChildResult joined = calibrate({"--to", "20", "--survey", folder_ / "survey.csv"});
  ASSERT_THAT(joined.exit_code, testing::AnyOf(0, 3)) << joined.err;
  const Sum together = sum_up();
  EXPECT_LT(together.variance_m2, 0.8 * alone.variance_m2);
  EXPECT_LT(together.square_error_m2, alone.square_error_m2);

  // Rows that are not a range of two anchors are reported and dropped.
  folder_.write("survey.csv", survey + "4,4,5.0,0.05,20\n4,5,-1.0,0.05,20\n");
  const ChildResult with_garbage = calibrate({"--to", "20", "--survey", folder_ / "survey.csv"});
  EXPECT_EQ(with_garbage.exit_code, 3);
  EXPECT_THAT(with_garbage.err, HasSubstr("1 of an unknown anchor"));
  EXPECT_DOUBLE_EQ(sum_up().variance_m2, together.variance_m2);
  EXPECT_NE(calibrate({"--survey", folder_ / "nothing.csv"}).exit_code, 0);
}

TEST_F(CliTest, FromADriveToAScore) {
  const ChildResult calibrated = calibrate({"--json"});
  ASSERT_THAT(calibrated.exit_code, testing::AnyOf(0, 3)) << calibrated.err;
  const json calibration = json::parse(calibrated.out);
  EXPECT_THAT(calibration["verdict"], testing::AnyOf("usable", "warnings"));
  EXPECT_EQ(calibrated.exit_code, calibration["verdict"] == "usable" ? 0 : 3);
  EXPECT_GT(calibration["wall_s"], 0.0);
  EXPECT_GT(calibration["ranges_used"], 7000);
  EXPECT_TRUE(calibration["ranges_rejected"].is_number_integer());
  ASSERT_EQ(calibration["anchors"].size(), 6U);
  const io::Dataset data = io::read_dataset(data_);
  for (std::size_t i = 0; i < 6; ++i) {
    const json& anchor = calibration["anchors"][i];
    const model::Anchor& truth = data.surveyed_anchors[i];
    EXPECT_EQ(anchor["id"], truth.id);
    EXPECT_NEAR(anchor["position_m"][0], truth.position_m.x(), 0.25);
    EXPECT_NEAR(anchor["position_m"][1], truth.position_m.y(), 0.25);
    EXPECT_EQ(anchor["covariance_m2"].size(), 3U);
    EXPECT_EQ(anchor["covariance_m2"][0][1], anchor["covariance_m2"][1][0]);
    EXPECT_GT(anchor["covariance_m2"][2][2], 0.0);
    for (const char* key : {"held_out_rms_m", "mirror_ratio", "verdict", "advice"})
      EXPECT_TRUE(anchor.contains(key));
  }
  ASSERT_EQ(calibration["pairs"].size(), 12U);
  for (const json& pair : calibration["pairs"]) {
    EXPECT_NEAR(pair["beta_m"], test::small_run_beta_m(pair["tag"], pair["anchor"]),
                5.0 * pair["beta_sigma_m"].get<double>());
    EXPECT_NEAR(pair["gamma"], 1.0, 0.02);
    EXPECT_GT(pair["gamma_sigma"], 0.0);
  }

  std::map<std::string, double> ate_m;
  for (const std::string model : {"odometry", "original", "inflated", "schmidt", "anchor-states", "joint"}) {
    const ChildResult replayed = replay_calibrated({"--model", model, "--json"});
    ASSERT_EQ(replayed.exit_code, model == "original" ? 3 : 0) << model << replayed.err;
    const json summary = json::parse(replayed.out);
    EXPECT_EQ(summary["model"], model);
    EXPECT_EQ(summary["ranges_seen"], data.ranges.size());
    EXPECT_LE(summary["ranges_used"].get<int>() + summary["ranges_gated"].get<int>(),
              summary["ranges_seen"].get<int>());
    EXPECT_GT(summary["realtime_factor"], 1.0);
    EXPECT_GT(summary["propagate_ns"]["p50"], 0.0);
    EXPECT_LE(summary["propagate_ns"]["p50"], summary["propagate_ns"]["p99"]);
    EXPECT_EQ(summary["update_ns"].size(), 2U);
    EXPECT_EQ(io::read_estimate(estimate_).size(), data.odometry.size()) << "one row per odometry sample";
    const json score = evaluate();
    EXPECT_GT(score["samples"], 1500);
    for (const char* quantity : {"ate_m", "ate_rad"}) {
      for (const char* key : {"max", "mean", "std", "rmse"}) EXPECT_GE(score[quantity][key], 0.0);
    }
    for (const char* key : {"max", "mean", "std", "inside_95"}) EXPECT_GE(score["nees"][key], 0.0);
    ate_m[model] = score["ate_m"]["mean"];
  }
  EXPECT_LT(ate_m["schmidt"], 0.06);
  EXPECT_LT(ate_m["joint"], 0.06);
  EXPECT_LT(ate_m["schmidt"], ate_m["original"]);
  EXPECT_LT(ate_m["schmidt"], ate_m["odometry"]);
}

// Each key of JSON in docs/reference/commands.md, each key of a calibration file in docs/reference/files.md.
TEST_F(CliTest, EachKeyIsDocumented) {
  const std::filesystem::path reference = std::filesystem::path(GROMA_SOURCE_DIR) / "docs" / "reference";
  const std::string commands = read_text(reference / "commands.md");
  const auto expect_documented = [&](const ChildResult& result) {
    const json object = json::parse(result.out);
    for (const auto& [key, value] : object.items()) EXPECT_THAT(commands, HasSubstr("`" + key + "`"));
  };
  expect_documented(calibrate({"--json"}));
  expect_documented(replay_calibrated({"--json"}));
  expect_documented(groma({"evaluate", estimate_, data_ / "groundtruth.csv", "--json"}));
  expect_documented(groma({"diff", calibration_, calibration_, "--json"}));
  expect_documented(groma({"explain", data_, "--surveyed", "--at", "40", "--to", "41", "--json"}));
  const std::string smoothed = folder_ / "smoothed.csv";
  expect_documented(groma({"smooth", data_, "--surveyed", "--to", "5", "-o", smoothed, "--json"}));

  const std::string files = read_text(reference / "files.md");
  const std::string calibration = read_text(calibration_);
  static const std::regex kKey("([a-z][a-z0-9_]*):( |\n)");
  std::set<std::string> keys;
  for (std::sregex_iterator match(calibration.begin(), calibration.end(), kKey), end; match != end; ++match)
    keys.insert((*match)[1]);
  EXPECT_GT(keys.size(), 15U);
  for (const std::string& key : keys) EXPECT_THAT(files, HasSubstr(key));
}

TEST_F(CliTest, ReplaysWithSurveyedAnchorsInsteadOfACalibration) {
  const ChildResult replayed = replay({"--surveyed", "--json"});
  ASSERT_EQ(replayed.exit_code, 0) << replayed.err;
  EXPECT_LT(evaluate()["ate_m"]["mean"], 0.3);
  std::filesystem::remove(data_ / "anchors.csv");
  EXPECT_EQ(replay({"--surveyed"}).exit_code, 65);
}

TEST_F(CliTest, ReplayAndSmoothUseTheChosenTagsAndAnchors) {
  const io::Dataset data = io::read_dataset(data_);
  const auto of_choice =
      std::count_if(data.ranges.begin(), data.ranges.end(), [](const model::RangeSample& range) {
        return range.tag_id == 2 && (range.anchor_id == 4 || range.anchor_id == 6 || range.anchor_id == 8);
      });
  const std::vector<std::string> choice{"--surveyed", "--tags", "2", "--anchors", "4,6,8", "--json"};
  const ChildResult replayed = replay(choice);
  ASSERT_EQ(replayed.exit_code, 0) << replayed.err;
  const json summary = json::parse(replayed.out);
  EXPECT_EQ(summary["ranges_seen"], of_choice);
  EXPECT_EQ(summary["ranges_used"].get<int>() + summary["ranges_gated"].get<int>(), of_choice);
  std::vector<std::string> smooth{"smooth", data_, "-o", estimate_};
  smooth.insert(smooth.end(), choice.begin(), choice.end());
  const ChildResult smoothed = groma(smooth);
  ASSERT_EQ(smoothed.exit_code, 0) << smoothed.err;
  EXPECT_EQ(json::parse(smoothed.out)["ranges_seen"], of_choice);
}

TEST_F(CliTest, AnUnknownAnchorIsNamedWithThoseThatExist) {
  const ChildResult result = replay({"--surveyed", "--anchors", "4,99"});
  EXPECT_EQ(result.exit_code, 2);
  EXPECT_THAT(result.err, HasSubstr("groma: --anchors: there is no anchor 99; the run has 4, 5, 6, 7, 8, 9"));
  EXPECT_THAT(replay({"--surveyed", "--tags", "7"}).err,
              HasSubstr("--tags: there is no tag 7; the run has 1, 2"));
}

// Biases of up to 0.9 m taken for distances contradict each other.
TEST_F(CliTest, ReplayWithoutBiasesIsMostlyNotTracking) {
  write_calibration();
  const ChildResult good = replay_calibrated();
  EXPECT_EQ(good.exit_code, 0) << good.err;
  EXPECT_THAT(good.out, testing::ContainsRegex("TRACKING 9.* % of the poses; 0 slips, 0 relocations"));
  EXPECT_THAT(good.out, testing::ContainsRegex("ranges seen, .* used, .* %\\) gated"));
  const ChildResult biased = replay_calibrated({"--model", "original"});
  EXPECT_EQ(biased.exit_code, 3);
  EXPECT_THAT(biased.err, HasSubstr("groma: warning: mostly not TRACKING: "));
  EXPECT_THAT(biased.out, HasSubstr(": mostly not TRACKING; "));
  EXPECT_EQ(replay_calibrated({"--model", "original", "--to", "9"}).exit_code, 0)
      << "the first 10 s do not count";
  EXPECT_EQ(replay_calibrated({"--model", "odometry"}).exit_code, 0);
}

TEST_F(CliTest, ReplayWithAnotherSitesAnchorsIsMostlyGated) {
  io::Dataset data = io::read_dataset(data_);
  // Most ranges of each pair are several metres off, each by another amount.
  std::size_t i = 0;
  for (model::RangeSample& range : data.ranges) {
    if (++i % 4 != 0) range.range_m += 2.0 + static_cast<double>(i * 7 % 13);
  }
  io::write_dataset(data_, data);
  const ChildResult result = replay({"--surveyed", "--json"});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("groma: warning: mostly gated: "));
  const json summary = json::parse(result.out);
  EXPECT_GT(summary["ranges_gated"].get<double>(), 0.5 * summary["ranges_seen"].get<double>());
}

TEST_F(CliTest, ReplayFindsThePoseAndReportsItsStateWithoutAPosePrior) {
  std::filesystem::remove(data_ / "pose_prior.csv");
  std::filesystem::rename(data_ / "groundtruth.csv", folder_ / "truth.csv");
  const ChildResult replayed = replay({"--surveyed", "--json"});
  ASSERT_EQ(replayed.exit_code, 0) << replayed.err;
  EXPECT_EQ(json::parse(replayed.out)["state"], "TRACKING");
  EXPECT_THAT(read_text(estimate_), HasSubstr("p_tt,state,reason,z_m,"));
  const ChildResult scored = groma({"evaluate", estimate_, folder_ / "truth.csv", "--json"});
  EXPECT_EQ(scored.exit_code, 0) << scored.err;
  EXPECT_LT(json::parse(scored.out)["ate_m"]["mean"], 0.5);
}

TEST_F(CliTest, ReplayNamesRenumberedAnchors) {
  write_calibration();
  io::Dataset data = test::make_small_run(kDrive_s, 1);
  std::set<model::NodeId> ids;
  for (const model::RangeSample& range : data.ranges) ids.insert(range.anchor_id);
  for (model::RangeSample& range : data.ranges) {
    const auto next = ids.upper_bound(range.anchor_id);
    range.anchor_id = next == ids.end() ? *ids.begin() : *next;
  }
  io::write_dataset(data_, data);
  const ChildResult result = replay_calibrated({"--json"});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err,
              AllOf(HasSubstr("renumbered-anchors: "), HasSubstr("\n  calibrate again, or restore")));
  const json summary = json::parse(result.out);
  EXPECT_EQ(summary["diagnosis"][0]["cause"], "renumbered-anchors");
  EXPECT_EQ(summary["diagnosis"][0]["of"].size(), ids.size());
  EXPECT_LT(summary["state_shares"].value("TRACKING", 0.0), 0.05);
  EXPECT_THAT(read_text(estimate_), HasSubstr(",map-mismatch,"));
}

// calibrate and smooth correct the ranges' clock in memory, and say so; replay uses what calibrate stored.
TEST_F(CliTest, FixesTheClockOfTheRanges) {
  constexpr double kLate_s = 0.4;
  write_calibration();
  ASSERT_EQ(replay_calibrated().exit_code, 0);
  const double clean_m = evaluate()["ate_m"]["mean"];
  const std::filesystem::path clean = folder_ / "clean.yaml";
  std::filesystem::rename(calibration_, clean);
  io::Dataset data = test::make_small_run(kDrive_s, 1);
  for (model::RangeSample& range : data.ranges) range.t_s += kLate_s;
  io::write_dataset(data_, data);
  const std::string given = read_text(data_ / "ranges.csv");

  const ChildResult fixed = calibrate({"--fix", "--json"});
  EXPECT_EQ(fixed.exit_code, 3) << fixed.err;
  EXPECT_THAT(fixed.err, AllOf(HasSubstr("clock-offset: "), HasSubstr("--fix: the times of the ranges")));
  const json diagnosis = json::parse(fixed.out)["diagnosis"];
  ASSERT_EQ(diagnosis.size(), 1U);
  EXPECT_NEAR(diagnosis[0]["value"], kLate_s, 0.02);
  const auto clock = io::read_calibration(calibration_).range_clock;
  ASSERT_TRUE(clock.has_value());
  EXPECT_NEAR(clock->offset_s, kLate_s, 0.02);
  EXPECT_EQ(read_text(data_ / "ranges.csv"), given);
  const ChildResult replayed = replay_calibrated({"--json"});
  EXPECT_EQ(replayed.exit_code, 0) << replayed.err;
  EXPECT_EQ(json::parse(replayed.out)["diagnosis"], json::array());
  EXPECT_LT(evaluate()["ate_m"]["mean"], 1.2 * clean_m);

  const ChildResult smoothed =
      groma({"smooth", data_, "--calibration", clean, "--fix", "--json", "-o", estimate_});
  EXPECT_EQ(smoothed.exit_code, 3) << smoothed.err;
  EXPECT_EQ(json::parse(smoothed.out)["diagnosis"][0]["cause"], "clock-offset");
  EXPECT_LT(evaluate()["ate_m"]["mean"], 1.2 * clean_m);
  EXPECT_EQ(read_text(data_ / "ranges.csv"), given);
}

// The start is after all odometry, because its times are in milliseconds.
TEST_F(CliTest, PrintsTheDiagnosisWhereItEndsWithoutAResult) {
  write_calibration();
  io::Dataset data = test::make_small_run(kDrive_s, 1);
  for (model::PoseSample& pose : data.pose_prior) pose.t_s = 1e3 * (pose.t_s + 1.0);
  io::write_dataset(data_, data);
  for (const char* command : {"replay", "smooth"}) {
    const ChildResult result =
        groma({command, data_, "--calibration", calibration_, "--json", "-o", estimate_});
    EXPECT_EQ(result.exit_code, 65) << result.err;
    const json summary = json::parse(result.out);
    ASSERT_FALSE(summary["diagnosis"].empty()) << command;
    EXPECT_EQ(summary["diagnosis"][0]["cause"], "time-unit");
  }
}

TEST_F(CliTest, ExplainReportsANlosPair) {
  io::Dataset data = test::make_small_run(kDrive_s, 1);
  const double at_s = 0.5 * (data.odometry.front().t_s + data.odometry.back().t_s);
  const model::NodeId anchor = data.ranges.front().anchor_id;
  for (model::RangeSample& range : data.ranges) {
    if (range.anchor_id == anchor && std::abs(range.t_s - at_s) < 2.0) range.range_m += 3.0;
  }
  io::write_dataset(data_, data);
  const std::vector<std::string> command{"explain",  data_, "--surveyed", "--at", std::to_string(at_s),
                                         "--window", "1"};
  const ChildResult output = groma(command);
  ASSERT_EQ(output.exit_code, 0) << output.err;
  EXPECT_THAT(output.out, AllOf(HasSubstr("TRACKING"), HasSubstr("blocked")));

  std::vector<std::string> with_json = command;
  with_json.emplace_back("--json");
  const json explained = json::parse(groma(with_json).out);
  EXPECT_EQ(explained["state"], "TRACKING");
  EXPECT_NEAR(explained["t_s"], at_s, 0.2);
  std::size_t blocked = 0;
  double moved_m = 0.0;
  for (const json& pair : explained["pairs"]) {
    moved_m += pair["pull"]["x_m"].get<double>();
    if (pair["anchor"] != anchor) continue;
    EXPECT_EQ(pair["why"], "blocked");
    ++blocked;
    for (const json& range : pair["ranges"]) {
      EXPECT_NEAR(range["innovation_m"], 3.0, 1.0);
      EXPECT_NEAR(range["range_m"].get<double>() - range["predicted_m"].get<double>(), range["innovation_m"],
                  1e-9);
      EXPECT_LT(range["weight"], 0.1);
    }
  }
  EXPECT_GT(blocked, 0U);
  EXPECT_NEAR(explained["pull"]["x_m"], moved_m, 1e-12);

  EXPECT_EQ(groma({"explain", data_, "--surveyed", "--at", "1e6"}).exit_code, 65);
  EXPECT_EQ(groma({"explain", data_, "--surveyed"}).exit_code, 2);
}

TEST_F(CliTest, ExplainReportsARangeRejectedByItsPowers) {
  io::Dataset data = test::make_small_run(kDrive_s, 1);
  const double at_s = 0.5 * (data.odometry.front().t_s + data.odometry.back().t_s);
  const model::NodeId anchor = data.ranges.front().anchor_id;
  // A third of the ranges is NLOS: 2 m too long, with a weak first path. At at_s all ranges are LOS, but the
  // first path of one anchor is equally weak.
  for (model::RangeSample& range : data.ranges) {
    const bool near = std::abs(range.t_s - at_s) < 5.0;
    const bool blocked = !near && (static_cast<int>(range.t_s / 4.0) + range.anchor_id) % 3 == 0;
    const bool weak = blocked || (range.anchor_id == anchor && std::abs(range.t_s - at_s) < 0.1);
    if (blocked) range.range_m += 2.0;
    range.first_path_power_dbm =
        static_cast<float>((weak ? -68.0 : -59.0) - 20.0 * std::log10(range.range_m));
    range.receive_power_dbm = range.first_path_power_dbm + (weak ? 11.0F : 2.0F);
  }
  io::write_dataset(data_, data);
  const std::vector<std::string> command{"explain",  data_, "--surveyed", "--at", std::to_string(at_s),
                                         "--window", "0.1"};
  EXPECT_THAT(groma(command).out, HasSubstr("by-powers"));
  std::vector<std::string> with_json = command;
  with_json.emplace_back("--json");
  const json explained = json::parse(groma(with_json).out);
  std::size_t by_powers = 0;
  for (const json& pair : explained["pairs"]) {
    for (const json& range : pair["ranges"]) {
      if (pair["anchor"] != anchor) {
        EXPECT_LT(range["hint_ratio"], 1.0);
        EXPECT_NE(range["why"], "by-powers");
        continue;
      }
      EXPECT_NE(range["hint_ratio"], 1.0);
      if (range["why"] != "by-powers") continue;
      EXPECT_GT(range["hint_ratio"], 1.5);
      EXPECT_LT(range["weight"], 0.5);
      ++by_powers;
    }
  }
  EXPECT_GT(by_powers, 0U);
}

TEST_F(CliTest, ExplainReportsASlip) {
  io::Dataset data = test::make_small_run(kDrive_s, 1);
  const double at_s = 0.5 * (data.odometry.front().t_s + data.odometry.back().t_s);
  const auto explain = [&] {
    io::write_dataset(data_, data);
    return groma({"explain", data_, "--surveyed", "--at", std::to_string(at_s), "--window", "3", "--json"});
  };
  EXPECT_EQ(json::parse(explain().out)["odometry"]["slips"], 0);
  // The speed rises and falls within one second each, which a robot could do.
  for (model::OdometrySample& row : data.odometry)
    row.vx_mps += 3.0 * std::clamp(2.0 - std::abs(row.t_s - at_s), 0.0, 1.0);
  const ChildResult output = explain();
  ASSERT_EQ(output.exit_code, 0) << output.err;
  const json explained = json::parse(output.out);
  EXPECT_GE(explained["odometry"]["slips"], 1);
  EXPECT_EQ(explained["odometry"]["jumps"], 0);
}

TEST_F(CliTest, KnownAnchorsKeepTheirSurveyedPositions) {
  const ChildResult result = calibrate({"--known-anchors", "--json"});
  ASSERT_THAT(result.exit_code, testing::AnyOf(0, 3)) << result.err;
  EXPECT_NEAR(json::parse(result.out)["anchors"][0]["position_m"][0], -1.0, 0.06);
  for (const model::AnchorCalibration& anchor : io::read_calibration(calibration_).anchors) {
    const Eigen::Matrix3d covariance_m2 = anchor.covariance.topLeftCorner<3, 3>();
    EXPECT_LT((covariance_m2 - 4e-4 * Eigen::Matrix3d::Identity()).norm(), 1e-9) << anchor.id;
  }
  std::filesystem::remove(data_ / "anchors.csv");
  EXPECT_EQ(calibrate({"--known-anchors"}).exit_code, 65);
}

TEST_F(CliTest, CalibrateNamesAPriorThatAllPairsContradict) {
  EXPECT_THAT(calibrate({"--known-anchors"}).err, Not(HasSubstr("from its prior")));
  io::Dataset data = test::make_small_run(kDrive_s, 1);
  data.range_priors.beta_m.sigma = 0.1;
  for (model::RangeSample& range : data.ranges) range.range_m += 0.6;
  io::write_dataset(data_, data);
  EXPECT_THAT(calibrate({"--known-anchors"}).err,
              AllOf(HasSubstr("note: beta_m of the pairs is "), HasSubstr("sigmas from its prior [0.2, 0.1]"),
                    HasSubstr("write beta_m: [0.2, 1] in dataset.yaml")));
  data.range_priors.beta_m.sigma = 1.0;
  io::write_dataset(data_, data);
  EXPECT_THAT(calibrate({"--known-anchors"}).err, Not(HasSubstr("from its prior")));
}

TEST_F(CliTest, CalibrationNeverReadsAnchorsTruthOrOdometry) {
  static_cast<void>(calibrate());
  const std::string before = read_text(calibration_);
  for (const char* file : {"anchors.csv", "groundtruth.csv", "odometry.csv"}) {
    folder_.write(std::string("data/") + file, "nonsense");
  }
  static_cast<void>(calibrate());
  EXPECT_EQ(read_text(calibration_), before);
}

TEST_F(CliTest, CalibratesFromOtherPosesAndPartsOfADrive) {
  std::filesystem::rename(data_ / "pose_prior.csv", folder_ / "slam.csv");
  std::filesystem::remove(data_ / "groundtruth.csv");
  EXPECT_EQ(calibrate().exit_code, 65) << "there are no poses";
  const ChildResult result = calibrate({"--poses", folder_ / "slam.csv", "--from", "10", "--to", "60",
                                        "--anchors", "4,6,8", "--tags", "2", "--json"});
  ASSERT_THAT(result.exit_code, testing::AnyOf(0, 3, 65)) << result.err;
  const json calibration = json::parse(result.out);
  ASSERT_EQ(calibration["anchors"].size(), 3U);
  EXPECT_EQ(calibration["anchors"][1]["id"], 6);
  for (const json& pair : calibration["pairs"]) EXPECT_EQ(pair["tag"], 2);
  EXPECT_LE(calibration["ranges_used"].get<int>() + calibration["ranges_rejected"].get<int>(),
            50 * 100 / 4 + 50);
}

TEST_F(CliTest, DiffReportsMovedAnchors) {
  ASSERT_THAT(calibrate({"--to", "60"}).exit_code, testing::AnyOf(0, 3));
  const std::filesystem::path other = folder_ / "other.yaml";
  ASSERT_THAT(groma({"calibrate", data_, "--from", "20", "-o", other}).exit_code, testing::AnyOf(0, 3));
  const ChildResult same = groma({"diff", calibration_, other, "--json"});
  EXPECT_EQ(same.exit_code, 0) << same.out << same.err;
  const json output = json::parse(same.out);
  EXPECT_EQ(output.at("same"), true);
  ASSERT_EQ(output.at("anchors").size(), 6U);
  EXPECT_EQ(output.at("pairs").size(), 12U);
  for (const json& anchor : output.at("anchors")) EXPECT_EQ(anchor.at("change"), "same");
  for (const char* key : {"verdicts", "frame", "missing", "new"}) EXPECT_TRUE(output.contains(key));

  model::Calibration changed = io::read_calibration(other);
  changed.anchors[2].position_m.x() += 0.9;
  changed.anchors.pop_back();
  folder_.write("other.yaml", io::format_calibration(changed));
  const ChildResult moved = groma({"diff", calibration_, other});
  EXPECT_EQ(moved.exit_code, 3);
  EXPECT_THAT(moved.out, AllOf(HasSubstr("moved"), HasSubstr("anchor 9: missing"), HasSubstr("they differ")));
  const json differences = json::parse(groma({"diff", calibration_, other, "--json"}).out);
  for (const json& anchor : differences.at("anchors")) {
    EXPECT_EQ(anchor.at("change") == "moved", anchor.at("id") == 6) << anchor;
  }

  changed.frame = "yard";
  folder_.write("other.yaml", io::format_calibration(changed));
  const ChildResult frames = groma({"diff", calibration_, other});
  EXPECT_EQ(frames.exit_code, 65);
  EXPECT_THAT(frames.err, HasSubstr("other.yaml: is in the frame 'yard'"));
  EXPECT_EQ(groma({"diff", calibration_}).exit_code, 2);
  EXPECT_EQ(groma({"diff", calibration_, folder_ / "none.yaml"}).exit_code, 65);
}

TEST_F(CliTest, UpdateKeepsAndAddsAnchorsAndReportsMovedOnes) {
  ASSERT_THAT(calibrate({"--to", "60"}).exit_code, testing::AnyOf(0, 3));
  model::Calibration old = io::read_calibration(calibration_);
  const std::filesystem::path updated = folder_ / "updated.yaml";
  const auto update = [&] {
    return groma({"calibrate", data_, "--from", "20", "--update", calibration_, "-o", updated, "--json"});
  };
  ChildResult result = update();
  ASSERT_THAT(result.exit_code, testing::AnyOf(0, 3)) << result.err;
  json output = json::parse(result.out).at("update");
  for (const char* key : {"moved", "added", "kept"}) EXPECT_THAT(output.at(key), IsEmpty()) << key;
  const model::Calibration both = io::read_calibration(updated);
  for (std::size_t i = 0; i < both.anchors.size(); ++i) {
    EXPECT_LT(both.anchors[i].covariance.topLeftCorner(2, 2).trace(),
              old.anchors[i].covariance.topLeftCorner(2, 2).trace());
  }

  // An earlier state of the site: anchor 6 elsewhere, without 8, and with one anchor more.
  old.anchors[2].position_m.x() += 0.9;
  old.anchors.erase(old.anchors.begin() + 4);
  old.anchors.push_back(old.anchors.front());
  old.anchors.back().id = 20;
  folder_.write("calibration.yaml", io::format_calibration(old));
  result = update();
  EXPECT_EQ(result.exit_code, 3);
  output = json::parse(result.out);
  ASSERT_EQ(output.at("update").at("moved").size(), 1U) << result.out;
  EXPECT_EQ(output.at("update").at("moved")[0].at("id"), 6);
  EXPECT_NEAR(output.at("update").at("moved")[0].at("distance_m"), 0.9, 0.3);
  EXPECT_EQ(output.at("update").at("added"), json::array({8}));
  EXPECT_EQ(output.at("update").at("kept"), json::array({20}));
  ASSERT_EQ(output.at("anchors").size(), 7U);
  EXPECT_EQ(output.at("anchors")[2].at("verdict"), "moved");
  EXPECT_THAT(output.at("anchors")[2].at("advice"), HasSubstr("moved by 0."));
  EXPECT_EQ(groma({"calibrate", data_, "--update", calibration_, "--known-anchors", "-o", updated}).exit_code,
            2);
  EXPECT_EQ(groma({"calibrate", data_, "--update", folder_ / "none.yaml", "-o", updated}).exit_code, 65);
}

TEST_F(CliTest, ALogIsReadLikeAFolder) {
  const io::Dataset run = io::read_dataset(data_);
  io::LogEncoder log;
  log.begin_section(io::describe(run), 1);
  for (const auto& row : run.odometry) log.put(row);
  for (const auto& pose : run.pose_prior) log.put(pose);
  for (const auto& range : run.ranges) log.put(range);
  log.flush();
  const std::string bytes = log.take();
  folder_.write("drive.glog", bytes);
  write_calibration();
  const std::filesystem::path from_log = folder_ / "from_log.yaml";
  ASSERT_THAT(groma({"calibrate", folder_ / "drive.glog", "-o", from_log}).exit_code, testing::AnyOf(0, 3));
  const model::Calibration a = io::read_calibration(calibration_);
  const model::Calibration b = io::read_calibration(from_log);
  ASSERT_EQ(a.anchors.size(), b.anchors.size());
  for (std::size_t i = 0; i < a.anchors.size(); ++i) {
    // Ranges of a log are floats.
    EXPECT_LT((a.anchors[i].position_m - b.anchors[i].position_m).norm(), 1e-3);
  }
  EXPECT_EQ(groma({"replay", folder_ / "drive.glog", "--calibration", from_log, "-o", estimate_}).exit_code,
            0);

  folder_.write("drive.glog", bytes.substr(0, bytes.size() - 9) + bytes.substr(0, bytes.size() / 2));
  const ChildResult torn =
      groma({"calibrate", folder_ / "drive.glog", "--section", "1", "-o", from_log, "--json"});
  EXPECT_EQ(torn.exit_code, 3) << torn.err;
  EXPECT_THAT(torn.err, HasSubstr("bytes of the log are damaged"));
  EXPECT_THAT(torn.err, Not(HasSubstr("note: ")));
  EXPECT_THAT(groma({"calibrate", folder_ / "drive.glog", "-o", from_log}).err,
              HasSubstr("groma: note: the log has 2 sections, and the last is used"));
  EXPECT_EQ(groma({"calibrate", folder_ / "drive.glog", "--section", "3", "-o", from_log}).exit_code, 65);
  EXPECT_EQ(groma({"calibrate", data_, "--section", "1", "-o", from_log}).exit_code, 2);
  EXPECT_EQ(groma({"calibrate", calibration_, "-o", from_log}).exit_code, 65);
}

TEST_F(CliTest, ReplayIsCausal) {
  write_calibration();
  ASSERT_EQ(replay_calibrated().exit_code, 0);
  const std::string whole = read_text(estimate_);
  // All data after 40 s is different.
  io::Dataset other = test::make_small_run(kDrive_s, 1);
  for (model::RangeSample& range : other.ranges) range.range_m += range.t_s > 40.0 ? 3.0 : 0.0;
  for (model::OdometrySample& row : other.odometry) row.vx_mps += row.t_s > 40.0 ? 1.0 : 0.0;
  for (std::size_t i = 1; i < other.ground_truth.size(); ++i) other.ground_truth[i].x_m += 100.0;
  for (std::size_t i = 1; i < other.pose_prior.size(); ++i) other.pose_prior[i].x_m += 100.0;
  io::write_dataset(data_, other);
  ASSERT_EQ(replay_calibrated().exit_code, 3) << "ranges that are 3 m too long contradict the map";
  const std::string changed = read_text(estimate_);
  const std::size_t until = whole.find("\n40.05");
  ASSERT_NE(until, std::string::npos);
  EXPECT_EQ(changed.substr(0, until), whole.substr(0, until));
  EXPECT_NE(changed, whole);
}

TEST_F(CliTest, ReplayOfAPartStartsAtTheGivenTimeAndPose) {
  write_calibration();
  ASSERT_EQ(replay_calibrated({"--from", "20", "--to", "30"}).exit_code, 0);
  std::vector<model::PlanarEstimate> rows = io::read_estimate(estimate_);
  EXPECT_NEAR(rows.front().t_s, 20.0, 0.051);
  EXPECT_NEAR(rows.back().t_s, 30.0, 0.051);
  EXPECT_EQ(rows.size(), 201U);

  const model::PoseSample truth = test::make_small_run(kDrive_s, 1).ground_truth[400];
  const auto start = [](const model::PoseSample& pose) {
    std::ostringstream text;
    text << pose.x_m << ',' << pose.y_m << ',' << pose.yaw_rad;
    return text.str();
  };
  std::filesystem::remove(data_ / "pose_prior.csv");
  std::filesystem::remove(data_ / "groundtruth.csv");
  // Without a pose to start from, the start is found.
  ASSERT_EQ(replay_calibrated({"--from", "20"}).exit_code, 0);
  rows = io::read_estimate(estimate_);
  const model::PoseSample end = test::make_small_run(kDrive_s, 1).ground_truth.back();
  EXPECT_GT(rows.front().t_s, 20.1);
  EXPECT_NEAR(rows.back().t_s, end.t_s, 0.051);
  EXPECT_NEAR(rows.back().x_m, end.x_m, 0.3);
  EXPECT_NEAR(rows.back().y_m, end.y_m, 0.3);
  const ChildResult started = replay_calibrated({"--from", "20", "--start", start(truth)});
  ASSERT_EQ(started.exit_code, 0) << started.err;
  rows = io::read_estimate(estimate_);
  EXPECT_NEAR(rows.front().x_m, truth.x_m, 0.3);
  // A minus does not begin an option.
  const ChildResult elsewhere = replay_calibrated({"--start", "-1,-2,-0.5"});
  EXPECT_EQ(elsewhere.exit_code, 3) << elsewhere.err;
  EXPECT_THAT(elsewhere.err, HasSubstr("the start"));
}

TEST_F(CliTest, TheSameInputGivesTheSameFiles) {
  static_cast<void>(calibrate());
  static_cast<void>(replay_calibrated());
  const std::string calibration = read_text(calibration_);
  const std::string estimate = read_text(estimate_);
  static_cast<void>(calibrate());
  static_cast<void>(replay_calibrated());
  EXPECT_EQ(read_text(calibration_), calibration);
  EXPECT_EQ(read_text(estimate_), estimate);
}

// Without the samples, whose Base64 may contain any word.
std::string without_samples(std::string html) {
  const std::string mark = "data-p=\"";
  for (std::size_t at = 0; (at = html.find(mark, at)) != std::string::npos;)
    html.erase(at, html.find('"', at + mark.size()) + 1 - at);
  return html;
}

TEST_F(CliTest, EachReportIsOneSelfContainedPage) {
  const std::string surveyed = folder_ / "known.yaml";
  write_calibration();
  const std::string truth = data_ / "groundtruth.csv";
  const std::vector<std::pair<std::vector<std::string>, std::string>> commands{
      {{"calibrate", data_, "-o", surveyed, "--known-anchors"}, "its 95 % ellipse"},
      {{"replay", data_, "-o", estimate_, "--calibration", calibration_}, "Corrections by anchor"},
      {{"evaluate", estimate_, truth}, "DEGRADED|TRACKING"},
      {{"smooth", data_, "-o", folder_ / "smooth.csv", "--calibration", calibration_, "--to", "10"},
       "Residuals of each pair"},
      {{"explain", data_, "--calibration", calibration_, "--at", "30"}, "The pose around that moment"},
      {{"diff", calibration_, surveyed}, "Displacements"}};
  for (const auto& [command, text] : commands) {
    std::vector<std::string> arguments = command;
    arguments.insert(arguments.end(), {"--report", folder_ / "deep/report"});
    const ChildResult result = groma(arguments);
    ASSERT_THAT(result.exit_code, testing::AnyOf(0, 3)) << result.err;
    const std::string html = without_samples(read_text(folder_ / "deep/report/report.html"));
    EXPECT_THAT(html, AllOf(HasSubstr("<!doctype html>"), testing::ContainsRegex(text), HasSubstr("</html>"),
                            HasSubstr("<code>groma " + command.front())));
    EXPECT_THAT(html, AllOf(Not(HasSubstr("http")), Not(HasSubstr("src=")), Not(HasSubstr("nan")),
                            Not(HasSubstr("inf "))))
        << command.front();
  }
}

TEST_F(CliTest, AReportDoesNotChangeTheEstimate) {
  write_calibration();
  static_cast<void>(replay_calibrated());
  const std::string estimate = read_text(estimate_);
  ASSERT_EQ(replay_calibrated({"--report", folder_ / "report"}).exit_code, 0);
  EXPECT_EQ(read_text(estimate_), estimate);
}

TEST_F(CliTest, WrongRowsAreDroppedCountedAndEndWith3) {
  append("ranges.csv", "80.0,1,4,0,,");
  append("ranges.csv", "80.0,1,4,300000,,");
  append("ranges.csv", "80.0,99,4,5,,");
  append("ranges.csv", "3.0,1,4,5,,");
  const ChildResult calibrated = calibrate({"--json"});
  EXPECT_EQ(calibrated.exit_code, 3) << calibrated.err;
  EXPECT_THAT(calibrated.err, HasSubstr("4 rows dropped"));
  const json dropped = json::parse(calibrated.out)["dropped"];
  EXPECT_EQ(dropped["range_out_of_bounds"], 2);
  EXPECT_EQ(dropped["unknown_tag"], 1);
  EXPECT_EQ(dropped["late"], 1);
  EXPECT_EQ(replay_calibrated().exit_code, 3);

  append("ranges.csv", "80.0,1,77,5,,");
  const ChildResult surveyed = replay({"--surveyed"});
  EXPECT_EQ(surveyed.exit_code, 3);
  EXPECT_THAT(surveyed.err, HasSubstr("1 of an unknown anchor"));
}

TEST_F(CliTest, AnchorsThatTheCalibrationLacksAreIgnoredAndCounted) {
  ASSERT_THAT(calibrate({"--anchors", "4,5,6,7,8"}).exit_code, testing::AnyOf(0, 3));
  const ChildResult result = replay_calibrated({"--json"});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("that the calibration lacks"));
  const json summary = json::parse(result.out);
  EXPECT_NEAR(summary["ranges_unknown_anchor"].get<double>(), summary["ranges_seen"].get<double>() / 6.0,
              50.0);
}

TEST_F(CliTest, UnreadableDataEndsWith65AndItsPlace) {
  write_calibration();
  struct Fault {
    const char* file;
    const char* text;
    const char* place;
  };
  for (const Fault& fault :
       {Fault{"ranges.csv", "", "ranges.csv:1: the file is empty"},
        Fault{"ranges.csv", "t_s,tag_id,anchor_id\n0,1,4\n", "ranges.csv:1:1: column range_m is missing"},
        Fault{"ranges.csv", "t_s,tag_id,anchor_id,range_m\n0,1,4,nan\n", "ranges.csv:2:7: "},
        Fault{"ranges.csv", "t_s,tag_id,anchor_id,range_m\n0,1,4,far\n", "ranges.csv:2:7: 'far'"},
        Fault{"ranges.csv", "t_s,tag_id,anchor_id,range_m\n0,1\n", "ranges.csv:2:4: "},
        Fault{"tags.csv", "tag_id,x_m,y_m\n", "tags.csv:1:1: column z_m is missing"},
        Fault{"pose_prior.csv", "t_s,x_m,y_m,z_m,yaw_rad\n0,0,0,0,north\n", "pose_prior.csv:2:9: 'north'"}}) {
    const std::string before = read_text(data_ / fault.file);
    const std::string old = read_text(calibration_);
    folder_.write(std::string("data/") + fault.file, fault.text);
    for (const ChildResult& result : {calibrate({"--json"}), replay_calibrated({"--json"})}) {
      EXPECT_EQ(result.exit_code, 65) << fault.place;
      EXPECT_THAT(result.err, HasSubstr(fault.place));
      EXPECT_THAT(result.out, IsEmpty());
    }
    EXPECT_EQ(read_text(calibration_), old);
    EXPECT_FALSE(std::filesystem::exists(estimate_));
    folder_.write(std::string("data/") + fault.file, before);
  }
  std::filesystem::remove(data_ / "odometry.csv");
  EXPECT_THAT(replay_calibrated().err, HasSubstr("odometry.csv: does not exist"));
  EXPECT_EQ(groma({"calibrate", folder_ / "nowhere", "-o", calibration_}).exit_code, 65);
}

// Line 802 of odometry.csv has t_s = 40.
TEST_F(CliTest, ImplausibleOdometryIsDroppedCountedAndEndsWith3) {
  ASSERT_EQ(replay({"--surveyed"}).exit_code, 0);
  const double without_m = evaluate().at("ate_m").at("mean");
  for (const std::string wrong : {"40,1e308,0,0", "40,0.5,-1e12,0", "40,0.5,0,1e300", "40,-60,0,0"}) {
    replace_line("odometry.csv", 802, wrong);
    const ChildResult result = replay({"--surveyed", "--json"});
    EXPECT_EQ(result.exit_code, 3) << wrong;
    EXPECT_THAT(result.err, HasSubstr("warning: 1 odometry samples were dropped")) << wrong;
    EXPECT_EQ(json::parse(result.out).at("odometry_implausible"), 1) << wrong;
    EXPECT_LT(evaluate().at("ate_m").at("mean").get<double>(), 1.2 * without_m) << wrong;
    const std::string smoothed = folder_ / "smoothed.csv";
    const ChildResult smooth =
        groma({"smooth", data_, "--surveyed", "-o", smoothed, "--from", "35", "--to", "45", "--json"});
    EXPECT_EQ(smooth.exit_code, 3) << wrong << smooth.err;
    EXPECT_EQ(json::parse(smooth.out).at("odometry_implausible"), 1) << wrong;
    EXPECT_TRUE(json::parse(smooth.out).at("converged").get<bool>()) << wrong;
    const std::vector<model::PlanarEstimate> rows = io::read_estimate(smoothed);
    EXPECT_EQ(rows.size(), 201U) << wrong;
  }
}

TEST_F(CliTest, ImplausiblePosesAreDroppedCountedAndEndWith3) {
  replace_line("pose_prior.csv", 2, "0,1e300,0,0.25,0.8");
  const ChildResult result = replay({"--surveyed", "--json"});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("1 with a pose that no robot has"));
  EXPECT_EQ(json::parse(result.out).at("dropped").at("implausible"), 1);
  EXPECT_LT(evaluate().at("ate_m").at("mean").get<double>(), 0.1);
  folder_.write("data/imu.csv", "t_s,omega_radps\n10,0.1\n10.01,0.1\n10.02,1e308\n10.03,0.1\n");
  folder_.write("data/gnss.csv", "t_s,x_m,y_m,p_xx,p_xy,p_yy\n0,5,0,1,0,1\n1,5,0,1,0,1\n2,5,0,1,1e9,1\n");
  const ChildResult sensors = replay({"--surveyed", "--json"});
  EXPECT_EQ(sensors.exit_code, 3);
  EXPECT_THAT(sensors.err, HasSubstr("warning: 1 samples of imu were dropped"));
  EXPECT_EQ(json::parse(sensors.out).at("dropped").at("implausible"), 2);
  EXPECT_EQ(json::parse(sensors.out).at("sensors").at("imu").at("jumped"), 1);
}

TEST_F(CliTest, ANonFiniteResultEndsWith65AndWritesNothing) {
  const std::string description = read_text(data_ / "dataset.yaml");
  const std::size_t at = description.find("surface:");
  ASSERT_NE(at, std::string::npos);
  folder_.write("data/dataset.yaml",
                description.substr(0, at) + "surface: {type: plane, z_m: 0, normal: [1e300, 0, 1e-300]}\n");
  for (const std::string command : {"replay", "smooth"}) {
    const ChildResult result = groma({command, data_, "--surveyed", "-o", estimate_, "--to", "4"});
    EXPECT_EQ(result.exit_code, 65) << command;
    EXPECT_THAT(result.err, HasSubstr("odometry.csv:2: the estimate is not finite")) << command;
    EXPECT_FALSE(std::filesystem::exists(estimate_)) << command;
  }
}

TEST_F(CliTest, ARunThatUsesNoRangeEndsWith3) {
  for (const std::string command : {"replay", "smooth"}) {
    const ChildResult result = groma({command, data_, "--surveyed", "-o", estimate_, "--from", "10", "--to",
                                      "15", "--start", "5000,5000,0"});
    EXPECT_EQ(result.exit_code, 3) << command;
    EXPECT_THAT(result.err, AllOf(HasSubstr("none of the "), HasSubstr(" ranges was used"))) << command;
  }
  EXPECT_EQ(replay({"--surveyed", "--model", "odometry"}).exit_code, 0);
  EXPECT_EQ(replay({"--surveyed", "--start", "1e300,0,0"}).exit_code, 2);
}

TEST_F(CliTest, BadConfigurationEndsWith78AndItsPlace) {
  write_calibration();
  const std::string calibration = read_text(calibration_);
  folder_.write("calibration.yaml", calibration + "colour: red\n");
  const ChildResult unknown_key = replay_calibrated();
  EXPECT_EQ(unknown_key.exit_code, 78);
  EXPECT_THAT(unknown_key.err, AllOf(HasSubstr("calibration.yaml:"), HasSubstr(":1: unknown key 'colour'")));
  folder_.write("calibration.yaml", calibration);
  folder_.write("data/dataset.yaml", "schema: 1\nname: x\n");
  EXPECT_THAT(calibrate().err, HasSubstr("dataset.yaml:1:1: key origin is missing"));
  EXPECT_EQ(replay_calibrated().exit_code, 78);
  EXPECT_FALSE(std::filesystem::exists(estimate_));
}

TEST_F(CliTest, UsageEndsWith2) {
  const std::string data = data_;
  for (const std::vector<std::string>& arguments : std::vector<std::vector<std::string>>{
           {},
           {"dance"},
           {"calibrate"},
           {"calibrate", data},
           {"calibrate", data, "-o", calibration_, "--colour"},
           {"calibrate", data, "-o", calibration_, "--tags", "one"},
           {"calibrate", data, "-o", calibration_, "--tags", "70000"},
           {"calibrate", data, "-o", calibration_, "--tags", "9"},
           {"calibrate", data, "-o", calibration_, "--anchors", "4,99"},
           {"calibrate", data, "-o", calibration_, "--from", "3s"},
           {"replay", data, "-o", estimate_, "--surveyed", "--anchors", "99"},
           {"smooth", data, "-o", estimate_, "--surveyed", "--anchors", "4,99"},
           {"explain", data, "--surveyed", "--at", "5", "--anchors", "99"},
           {"explain", data, "--surveyed", "--at", "5", "--window", "0"},
           {"convert", data, "-o", estimate_, "--anchors", "99"},
           {"convert", data, "-o", estimate_, "--tags", "99"},
           {"calibrate", data, "-o", calibration_, "--anchors", "1,,2"},
           {"calibrate", data, "-o", calibration_, "--from", "nan"},
           {"calibrate", data, "-o", calibration_, "--from", "5", "--to", "4"},
           {"calibrate", data, "-o", folder_ / "none/c.yaml"},
           {"calibrate", data, "-o", data},
           {"replay", data, "-o", estimate_},
           {"replay", data, "-o", estimate_, "--surveyed", "--calibration", calibration_},
           {"replay", data, "-o", estimate_, "--surveyed", "--model", "magic"},
           {"replay", data, "-o", estimate_, "--surveyed", "--start", "1,2"},
           {"evaluate", estimate_}}) {
    const ChildResult result = groma(arguments);
    EXPECT_EQ(result.exit_code, 2) << testing::PrintToString(arguments);
    EXPECT_THAT(result.err, Not(IsEmpty()));
    EXPECT_THAT(result.out, IsEmpty());
  }
  EXPECT_EQ(files(), 1U);
}

TEST_F(CliTest, PlanPredictsTheFiguresOfASchedule) {
  const ChildResult result = groma({"plan", "--tags", "3", "--anchors", "12", "--loss", "0.3", "--json"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const json plan = json::parse(result.out);
  // POLL and twelve RESPONSEs of 215 and 195 us, pauses of 350 and 300, and 1.4 ms for beacon and shared
  // slot.
  EXPECT_NEAR(plan.at("superframe_s").get<double>(), 21.05e-3, 0.3e-3);
  EXPECT_NEAR(plan.at("ranges_per_s").get<double>(), 36.0 / plan.at("superframe_s").get<double>(), 1e-6);
  EXPECT_NEAR(plan.at("ranges_per_s_at_loss").get<double>(), 0.2401 * plan.at("ranges_per_s").get<double>(),
              1e-6);
  EXPECT_EQ(plan.at("links").size(), 3U);
  EXPECT_THAT(plan.at("warnings"), IsEmpty());

  const ChildResult tight = groma({"plan", "--turn-round", "150"});
  EXPECT_EQ(tight.exit_code, 3);
  EXPECT_THAT(tight.err, HasSubstr("groma: warning: schedule.turn_round_us: 150 is less"));
  EXPECT_THAT(tight.out, HasSubstr("superframe"));
  EXPECT_EQ(json::parse(groma({"plan", "--link", "can", "--json"}).out).at("links").size(), 1U);
  folder_.write("plan.yaml",
                "schema: 1\nnetwork_id: 7\nlink: {type: can-fd, can_interface: can0}\nnodes:\n"
                "  - {id: 1, role: tag}\n  - {id: 10, role: anchor}\n");
  const json of_file = json::parse(groma({"plan", folder_ / "plan.yaml", "--json"}).out);
  ASSERT_EQ(of_file.at("links").size(), 1U) << "the link of the plan";
  EXPECT_EQ(of_file.at("links")[0].at("link"), "CAN FD");
  EXPECT_EQ(groma({"plan", folder_ / "none.yaml"}).exit_code, 78);
  EXPECT_EQ(groma({"plan", "--tags", "17"}).exit_code, 2);
  EXPECT_EQ(groma({"plan", "x.yaml", "--tags", "2"}).exit_code, 2);
  EXPECT_EQ(groma({"plan", "--method", "aloha"}).exit_code, 2);
}

TEST_F(CliTest, HelpNamesTheDefaultModel) {
  const ChildResult help = groma({"replay", "--help"});
  EXPECT_EQ(help.exit_code, 0);
  EXPECT_THAT(help.out, AllOf(HasSubstr("Default: "), HasSubstr("measures best")));
  for (const std::string command : {"calibrate", "evaluate"})
    EXPECT_EQ(groma({command, "--help"}).exit_code, 0);
  const ChildResult version = groma({"--version"});
  EXPECT_EQ(version.exit_code, 0);
  EXPECT_THAT(version.out, testing::MatchesRegex("groma [0-9.]+\n"));
}

TEST_F(CliTest, EvaluateByHand) {
  folder_.write("e.csv",
                "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt\n"
                "0,3,4,0.1,1,0,0,4,0,0.01\n0.1,0,0,-0.2,1,0,0,1,0,0.04\n5,0,0,0,1,0,0,1,0,1\n");
  folder_.write("t.csv", "t_s,x_m,y_m,z_m,yaw_rad\n0,0,0,0,0\n0.1,0,0,0,0\n2,7,7,7,0\n");
  const ChildResult result = groma({"evaluate", folder_ / "e.csv", folder_ / "t.csv", "--json"});
  ASSERT_EQ(result.exit_code, 0) << result.err;
  const json score = json::parse(result.out);
  EXPECT_EQ(score["samples"], 2);
  EXPECT_EQ(score["ate_m"]["mean"], 2.5);
  EXPECT_EQ(score["ate_m"]["max"], 5.0);
  EXPECT_NEAR(score["nees"]["mean"], 2.5, 1e-12);
  EXPECT_EQ(score["nees"]["inside_95"], 0.5);
  EXPECT_THAT(groma({"evaluate", folder_ / "e.csv", folder_ / "t.csv"}).out, HasSubstr("2 samples"));

  EXPECT_NEAR(score["scored"]["estimate"], 2.0 / 3.0, 1e-12);
  EXPECT_NEAR(score["scored"]["truth"], 2.0 / 3.0, 1e-12);

  // Another drive that shares a few times.
  folder_.write("t.csv", "t_s,x_m,y_m,z_m,yaw_rad\n0,0,0,0,0\n2,7,7,7,0\n2.1,7,7,7,0\n");
  const ChildResult little = groma({"evaluate", folder_ / "e.csv", folder_ / "t.csv"});
  EXPECT_EQ(little.exit_code, 3);
  EXPECT_THAT(little.err, HasSubstr("only 66.7 % of "));
  EXPECT_THAT(little.err, HasSubstr("and 33.3 % of "));
  EXPECT_THAT(little.out, HasSubstr("scored: 66.7 % of the estimate, 33.3 % of the truth"));

  folder_.write("t.csv", "t_s,x_m,y_m,z_m,yaw_rad\n2,7,7,7,0\n");
  const ChildResult apart = groma({"evaluate", folder_ / "e.csv", folder_ / "t.csv", "--json"});
  EXPECT_EQ(apart.exit_code, 65);
  EXPECT_THAT(apart.err, HasSubstr("gaps over 0.3 s"));
  folder_.write("e.csv", "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt\n0,3,4,0.1,nan,0,0,4,0,0.01\n");
  EXPECT_THAT(groma({"evaluate", folder_ / "e.csv", folder_ / "t.csv"}).err, HasSubstr("e.csv:2:11: 'nan'"));
}

TEST_F(CliTest, EvaluateWarnsOnceOfATruthThatFreezesOften) {
  std::string estimate = "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt\n";
  std::string truth = "t_s,x_m,y_m,z_m,yaw_rad\n";
  for (int i = 0; i < 400; ++i) {
    const double t_s = 0.1 * i;
    const bool frozen = i % 50 >= 40;
    estimate += fmt::format("{},{},0,0,1,0,0,1,0,1\n", t_s, 0.1 * t_s);
    truth += fmt::format("{},{},0,0,0\n", t_s, frozen ? 0.01 * (i - i % 50 + 40) : 0.1 * t_s);
  }
  folder_.write("e.csv", estimate);
  folder_.write("t.csv", truth);
  const ChildResult result = groma({"evaluate", folder_ / "e.csv", folder_ / "t.csv"});
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_EQ(std::count(result.err.begin(), result.err.end(), '\n'), 1) << result.err;
  EXPECT_THAT(result.err, AllOf(HasSubstr("repeats one pose from 4.0"), HasSubstr("and 4 more times")));
}

TEST_F(CliTest, FitsASurfaceAndReplaysOnIt) {
  std::string heights = "x_m,y_m,z_m\n";
  for (int x_m = -20; x_m <= 20; x_m += 2) {
    for (int y_m = -20; y_m <= 20; y_m += 2)
      heights += fmt::format("{},{},{}\n", x_m, y_m, 0.25 + 0.01 * x_m);
  }
  folder_.write("heights.csv", heights);
  const ChildResult fit =
      groma({"surface", "fit", folder_ / "heights.csv", "-o", data_ / "ground.csv", "--json"});
  ASSERT_EQ(fit.exit_code, 0) << fit.err;
  const json output = json::parse(fit.out);
  EXPECT_EQ(output["points"], 21 * 21);
  EXPECT_LT(output["max_m"], 0.005);
  EXPECT_GT(output["mismatch"]["length_m"], 0.0);
  EXPECT_EQ(output["empty_share"], 0.0);

  const std::string before = read_text(data_ / "dataset.yaml");
  const std::size_t line = before.find("surface:");
  ASSERT_NE(line, std::string::npos);
  const std::string after =
      before.substr(0, line) +
      "surface: {type: bspline, file: ground.csv, mismatch: {sigma_m: 0.02, length_m: 3}}" +
      before.substr(before.find('\n', line));
  folder_.write("data/dataset.yaml", after);
  const ChildResult result = replay({"--surveyed"});
  ASSERT_EQ(result.exit_code, 0) << result.err;
  std::istringstream rows(read_text(estimate_));
  std::string row;
  std::getline(rows, row);
  EXPECT_EQ(row,
            "t_s,x_m,y_m,yaw_rad,p_xx,p_xy,p_xt,p_yy,p_yt,p_tt,state,reason,z_m,roll_rad,pitch_rad,p_zz,p_zr,"
            "p_zp,p_rr,p_rp,p_pp");
  std::size_t count = 0;
  for (; std::getline(rows, row); ++count) {
    std::vector<std::string> fields;
    std::istringstream of_row(row);
    for (std::string field; std::getline(of_row, field, ',');) fields.push_back(field);
    ASSERT_EQ(fields.size(), 21U);
    EXPECT_NEAR(std::stod(fields[12]), 0.25 + 0.01 * std::stod(fields[1]), 0.005);
    EXPECT_GT(std::stod(fields[15]), 0.9 * 0.02 * 0.02);
  }
  EXPECT_GT(count, 100U);
  EXPECT_GT(evaluate()["samples"], 100);

  folder_.write("heights.csv", "x_m,y_m,z_m\n0,0,0\n1,0,high\n2,2,0\n");
  const ChildResult bad = groma({"surface", "fit", folder_ / "heights.csv", "-o", folder_ / "s.csv"});
  EXPECT_EQ(bad.exit_code, 65);
  EXPECT_THAT(bad.err, HasSubstr("heights.csv:3:5"));
  EXPECT_FALSE(std::filesystem::exists(folder_ / "s.csv"));
}

// The printed line is pasted into the description, and the command runs in another folder.
TEST_F(CliTest, ThePrintedSurfaceCanBePasted) {
  folder_.write("heights.csv", "x_m,y_m,z_m\n-20,-20,0.25\n20,-20,0.25\n-20,20,0.25\n20,20,0.25\n0,0,0.25\n");
  const std::string before = read_text(data_ / "dataset.yaml");
  for (const std::filesystem::path& output : {data_ / "ground.csv", folder_ / "ground.csv"}) {
    const std::string relative = std::filesystem::relative(output);
    const ChildResult fit =
        groma({"surface", "fit", folder_ / "heights.csv", "--spacing", "20", "-o", relative});
    ASSERT_EQ(fit.exit_code, 0) << fit.err;
    const std::size_t line = fit.out.find("surface: {");
    ASSERT_NE(line, std::string::npos) << fit.out;
    folder_.write("data/dataset.yaml", before.substr(0, before.find("surface:")) + fit.out.substr(line));
    EXPECT_EQ(replay({"--surveyed"}).exit_code, 0) << output;
  }
}

TEST_F(CliTest, AFullDiskKeepsTheOldFiles) {
  write_calibration();
  static_cast<void>(replay_calibrated());
  const std::string calibration = read_text(calibration_);
  const std::string estimate = read_text(estimate_);
  const std::size_t before = files();
  ChildOptions full;
  full.max_file_bytes = 2000;
  const ChildResult calibrated = groma({"calibrate", data_, "-o", calibration_, "--from", "1"}, full);
  const ChildResult replayed =
      groma({"replay", data_, "-o", estimate_, "--calibration", calibration_, "--from", "1"}, full);
  for (const ChildResult& result : {calibrated, replayed}) {
    EXPECT_EQ(result.exit_code, 69);
    EXPECT_THAT(result.err, HasSubstr("cannot be written"));
  }
  EXPECT_EQ(read_text(calibration_), calibration);
  EXPECT_EQ(read_text(estimate_), estimate);
  EXPECT_EQ(files(), before) << "no temporary file is left";
}

TEST_F(CliTest, AKilledCommandLeavesACompleteFileOrNone) {
  write_calibration();
  ASSERT_EQ(replay_calibrated().exit_code, 0);
  const std::string whole = read_text(estimate_);
  for (unsigned i = 0; i < 25; ++i) {
    std::filesystem::remove(estimate_);
    ChildOptions options;
    options.kill_after_us = 2000 * i;
    static_cast<void>(groma({"replay", data_, "-o", estimate_, "--calibration", calibration_}, options));
    if (std::filesystem::exists(estimate_)) {
      EXPECT_EQ(read_text(estimate_), whole);
    }
  }
}

TEST_F(CliTest, ADeviceThatFailsEndsWith69) {
  EXPECT_EQ(groma({"replay", data_, "-o", "/dev/full", "--surveyed"}).exit_code, 69);
  ChildOptions options;
  options.stdout_path = "/dev/full";
  const ChildResult result = groma({"replay", data_, "-o", estimate_, "--surveyed", "--json"}, options);
  EXPECT_EQ(result.exit_code, 69);
  EXPECT_THAT(result.err, HasSubstr("standard output"));
  EXPECT_EQ(groma({"replay", data_, "-o", "/dev/null", "--surveyed"}).exit_code, 0);
}

TEST_F(CliTest, NoPermissionEndsWith77) {
  // Even root may not write to the kernel's own folders.
  const ChildResult result = groma({"replay", data_, "-o", "/sys/kernel/estimate.csv", "--surveyed"});
  EXPECT_EQ(result.exit_code, 77);
  EXPECT_THAT(result.err, HasSubstr("/sys/kernel/estimate.csv: cannot be written"));
}

}  // namespace
}  // namespace groma
