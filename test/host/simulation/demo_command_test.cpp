// groma demo as a child process: its bounds in the paper's hall, and the consistency of its report.
#include <gtest/gtest.h>

#include <filesystem>
#include <string>

#include <nlohmann/json.hpp>

#include "test/host/simulation/demo_bounds.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::simulation {
namespace {

using Json = nlohmann::json;

TEST(DemoCommand, KeepsItsBoundsAndItsReportIsConsistent) {
  const test::ScratchFolder scratch;
  const test::ChildResult demo =
      test::run_child({GROMA_EXECUTABLE, "demo", "--seed", "1", "--json", "--report", scratch / "report"});
  ASSERT_EQ(demo.exit_code, 0) << demo.err;
  const Json json = Json::parse(demo.out);

  expect_demo_bounds(json);
  const double schmidt_m = json.at("evaluation").at("schmidt").at("ate_m").at("mean").get<double>();

  const std::string truth = scratch / "report/second_drive/groundtruth.csv";
  const auto score = [&](const std::string& estimate) {
    const auto result = test::run_child({GROMA_EXECUTABLE, "evaluate", estimate, truth, "--json"});
    EXPECT_EQ(result.exit_code, 0) << result.err;
    return Json::parse(result.out).at("ate_m").at("mean").get<double>();
  };
  EXPECT_DOUBLE_EQ(score(scratch / "report/estimate_schmidt.csv"), schmidt_m);
  // The written drives can be replayed with the written calibration.
  const auto replay = test::run_child({GROMA_EXECUTABLE, "replay", scratch / "report/second_drive",
                                       "--calibration", scratch / "report/calibration.yaml", "--model",
                                       "schmidt", "-o", scratch / "estimate.csv"});
  EXPECT_EQ(replay.exit_code, 0) << replay.err;
  EXPECT_NEAR(score(scratch / "estimate.csv"), schmidt_m, 0.02);

  const std::string page = test::read_text(scratch / "report/report.html");
  EXPECT_NE(page.find("<svg"), std::string::npos);
  EXPECT_EQ(page.find("src="), std::string::npos) << "it loads no other resource";
  for (std::size_t at = page.find("href="); at != std::string::npos; at = page.find("href=", at + 1))
    EXPECT_EQ(page.substr(at, 7), "href=\"#") << "links stay on the page";
}

}  // namespace
}  // namespace groma::simulation
