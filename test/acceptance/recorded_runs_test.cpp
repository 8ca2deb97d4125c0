// Accuracy of the commands on recorded and simulated runs that are not part of the project. Skipped if these
// are absent.
#include <gtest/gtest.h>

#include <cmath>
#include <iostream>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/dataset.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/shared_data.hpp"

namespace groma {
namespace {

using nlohmann::json;
using test::ChildResult;
using Arguments = std::vector<std::string>;

class RecordedRunsTest : public testing::Test {
 protected:
  // Runs a command with --json, checks that it ended with a result, and returns its JSON output.
  static json groma(const Arguments& arguments) {
    Arguments command{GROMA_EXECUTABLE, "--json"};
    command.insert(std::next(command.begin()), arguments.begin(), arguments.end());
    const ChildResult result = test::run_child(command);
    EXPECT_TRUE(result.exit_code == 0 || result.exit_code == 3) << result.exit_code << ": " << result.err;
    return json::parse(result.out, nullptr, false);
  }

  json calibrate(const std::filesystem::path& data, const Arguments& more = {}) const {
    Arguments arguments{"calibrate", data, "-o", calibration_};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return groma(arguments);
  }

  // The score of a replay with the calibration by calibrate().
  json score(const std::filesystem::path& data, const Arguments& more = {}) const {
    Arguments arguments{"replay", data, "--calibration", calibration_, "-o", estimate_};
    arguments.insert(arguments.end(), more.begin(), more.end());
    static_cast<void>(groma(arguments));
    json result = groma({"evaluate", estimate_, data / "groundtruth.csv"});
    if (result.is_object()) {
      std::cout << data.filename().string() << ": ATE " << result["ate_m"] << ", NEES " << result["nees"]
                << '\n';
    }
    return result;
  }

  static double mean_anchor_error_xy_m(const std::filesystem::path& data, const json& calibration) {
    double sum_m = 0.0;
    const auto anchors = io::read_dataset(data).surveyed_anchors;
    for (const model::Anchor& anchor : anchors) {
      for (const json& found : calibration["anchors"]) {
        if (found["id"] != anchor.id) continue;
        sum_m += std::hypot(found["position_m"][0].get<double>() - anchor.position_m.x(),
                            found["position_m"][1].get<double>() - anchor.position_m.y());
      }
    }
    return sum_m / static_cast<double>(anchors.size());
  }

  // The middle of a run's ranges in time.
  static std::string half_time_s(const std::filesystem::path& data) {
    const auto ranges = io::read_dataset(data).ranges;
    return std::to_string(0.5 * (ranges.front().t_s + ranges.back().t_s));
  }

  test::ScratchFolder folder_;
  std::filesystem::path calibration_ = folder_ / "calibration.yaml";
  std::filesystem::path estimate_ = folder_ / "estimate.csv";
};

TEST_F(RecordedRunsTest, LiasFastFromItsFirstHalf) {
  GROMA_SHARED_OR_SKIP(data, "real/lias_fast");
  const std::string half_s = half_time_s(data);
  calibrate(data, {"--to", half_s});
  EXPECT_LE(score(data, {"--from", half_s})["ate_m"]["mean"], 0.05);
}

TEST_F(RecordedRunsTest, Plaza1FromItsFirstHalf) {
  GROMA_SHARED_OR_SKIP(data, "real/plaza1");
  const std::string half_s = half_time_s(data);
  calibrate(data, {"--to", half_s});
  EXPECT_LE(score(data, {"--from", half_s})["ate_m"]["mean"], 0.50);
}

TEST_F(RecordedRunsTest, Plaza1AnchorsAndScale) {
  GROMA_SHARED_OR_SKIP(data, "real/plaza1");
  const json calibration = calibrate(data);
  EXPECT_LE(mean_anchor_error_xy_m(data, calibration), 0.12);
  for (const json& pair : calibration["pairs"]) EXPECT_NEAR(pair["gamma"], 1.07, 0.025);
}

TEST_F(RecordedRunsTest, McdOneDayToTheNight) {
  GROMA_SHARED_OR_SKIP(day, "real/mcd_ntu_day_09");
  GROMA_SHARED_OR_SKIP(night, "real/mcd_ntu_night_09");
  calibrate(day);
  const json result = score(night);
  EXPECT_LE(result["ate_m"]["mean"], 1.0);
  EXPECT_LE(result["ate_m"]["max"], 10.0) << "no divergence";
}

TEST_F(RecordedRunsTest, SimulatedCleanOnItself) {
  GROMA_SHARED_OR_SKIP(data, "simulated/clean");
  calibrate(data);
  const json schmidt = score(data, {"--model", "schmidt"});
  EXPECT_LE(schmidt["ate_m"]["mean"], 0.05);
  EXPECT_LE(schmidt["nees"]["mean"], 2.0);
}

}  // namespace
}  // namespace groma
