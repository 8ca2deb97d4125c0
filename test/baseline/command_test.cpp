// groma-baselines as a program: its files, its JSON and its errors.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/estimate_file.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"
#include "test/support/small_run.hpp"

namespace groma::baseline {
namespace {

using testing::HasSubstr;
using Json = nlohmann::json;

class BaselinesTest : public testing::Test {
 protected:
  BaselinesTest() {
    const io::Dataset run = test::make_small_run(5.0, 5);
    io::write_dataset(folder_ / "run", run);
    model::RangePriors priors;
    priors.beta_m = {0.3, 0.2};
    folder_.write("site.yaml", io::format_calibration(model::surveyed_calibration(run.surveyed_anchors,
                                                                                  run.tags, priors, 0.02)));
    samples_ = run.odometry.size();
  }

  test::ChildResult call(std::vector<std::string> arguments) const {
    arguments.insert(arguments.begin(), GROMA_BASELINES);
    return test::run_child(arguments);
  }
  test::ChildResult run_method(const std::string& method, std::vector<std::string> more = {}) const {
    std::vector<std::string> arguments{"run",  path("run"), "--calibration", path("site.yaml"), "--methods",
                                       method, "--output",  path("out"),     "--json"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return call(arguments);
  }
  [[nodiscard]] std::string path(const char* name) const { return (folder_ / name).string(); }

  test::ScratchFolder folder_;
  std::size_t samples_ = 0;
};

TEST_F(BaselinesTest, WritesAnEstimateAndALineForEachMethod) {
  const test::ChildResult result = run_method("paper-adapted,paper-anchor-states");
  EXPECT_EQ(result.exit_code, 0) << result.err;
  const std::size_t end = result.out.find('\n');
  const Json first = Json::parse(result.out.substr(0, end));
  const Json second = Json::parse(result.out.substr(end + 1));
  EXPECT_EQ(first.at("method"), "paper-adapted");
  EXPECT_EQ(first.at("rows"), samples_);
  EXPECT_GT(first.at("ranges"), 0);
  EXPECT_GT(first.at("ns_per_range"), 0.0);
  EXPECT_GT(first.at("ns_per_odometry"), 0.0);
  EXPECT_EQ(io::read_estimate(first.at("estimate").get<std::string>()).size(), samples_);
  const std::string anchors = test::read_text(second.at("anchors").get<std::string>());
  EXPECT_THAT(anchors, testing::StartsWith("t_s,anchor_id,x_m,y_m,z_m\n0,4,"));
}

TEST_F(BaselinesTest, SameSeedSameBytes) {
  ASSERT_EQ(run_method("particle-filter", {"--seed", "3"}).exit_code, 0);
  const std::string first = test::read_text(folder_ / "out/particle-filter.csv");
  ASSERT_EQ(run_method("particle-filter", {"--seed", "3"}).exit_code, 0);
  EXPECT_EQ(test::read_text(folder_ / "out/particle-filter.csv"), first);
  ASSERT_EQ(run_method("particle-filter", {"--seed", "4"}).exit_code, 0);
  EXPECT_NE(test::read_text(folder_ / "out/particle-filter.csv"), first);
}

TEST_F(BaselinesTest, TakesAPlaneInPlaceOfTheSurface) {
  ASSERT_EQ(run_method("paper-original").exit_code, 0);
  const std::string with_surface = test::read_text(folder_ / "out/paper-original.csv");
  ASSERT_EQ(run_method("paper-original", {"--plane", "0.25"}).exit_code, 0);
  EXPECT_EQ(test::read_text(folder_ / "out/paper-original.csv"), with_surface);  // the run's own plane
  ASSERT_EQ(run_method("paper-original", {"--plane", "1.5"}).exit_code, 0);
  EXPECT_NE(test::read_text(folder_ / "out/paper-original.csv"), with_surface);
}

TEST_F(BaselinesTest, ListsTheMethods) {
  const Json all = Json::parse(call({"list", "--json"}).out);
  EXPECT_EQ(all.size(), 9U);
  EXPECT_THAT(call({"list"}).out, HasSubstr("trilateration"));
}

TEST_F(BaselinesTest, ReferenceHasARowForEachInstant) {
  const test::ChildResult result = call({"reference", path("run"), "--calibration", path("site.yaml"),
                                         "--instants", "1,2.5", "-o", path("reference.csv"), "--json"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  EXPECT_EQ(Json::parse(result.out).at("rows"), 2);
  EXPECT_EQ(io::read_estimate(folder_ / "reference.csv").size(), 2U);
  EXPECT_EQ(call({"reference", path("run"), "--calibration", path("site.yaml"), "--instants", "-3", "-o",
                  path("reference.csv")})
                .exit_code,
            65);
}

TEST_F(BaselinesTest, TuneIsNoWorseThanThePlainParameters) {
  const test::ChildResult result =
      call({"tune", "paper-original", "--runs", path("run") + "=" + path("site.yaml"), "--draws", "3"});
  EXPECT_EQ(result.exit_code, 0) << result.err;
  std::vector<Json> lines;
  for (std::size_t from = 0; from < result.out.size();) {
    const std::size_t end = result.out.find('\n', from);
    lines.push_back(Json::parse(result.out.substr(from, end - from)));
    from = end + 1;
  }
  ASSERT_EQ(lines.size(), 5U);
  EXPECT_EQ(lines.front().at("draw"), "plain");
  EXPECT_EQ(lines.back().at("draw"), "best");
  for (const Json& line : lines) EXPECT_LE(lines.back().at("ate_m"), line.at("ate_m"));
}

TEST_F(BaselinesTest, BadInputHasItsExitCode) {
  const auto expect = [&](const test::ChildResult& result, int code, const char* text) {
    EXPECT_EQ(result.exit_code, code) << result.err;
    EXPECT_THAT(result.err, HasSubstr(text));
  };
  expect(run_method("kalman"), 2, "no method 'kalman'");
  expect(run_method("paper-adapted", {"--tags", "7"}), 2, "7");
  expect(run_method("paper-adapted", {"--tags", "1,x"}), 2, "'1,x' is not a list of ids");
  expect(run_method("paper-adapted", {"--anchors", "99"}), 2, "99");
  expect(run_method("paper-adapted", {"--from", "3", "--to", "2"}), 2, "not after --from");
  expect(run_method("paper-adapted", {"--from", "nan"}), 2, "not a number");
  expect(run_method("paper-adapted", {"--plane", "1,2"}), 2, "not a number");
  expect(run_method("paper-adapted", {"--from", "99"}), 65, "no pose prior");
  expect(call({"run", path("absent"), "--calibration", path("site.yaml"), "--methods", "paper-adapted", "-o",
               path("out")}),
         65, "absent");
  expect(call({"run", path("run"), "--calibration", path("absent.yaml"), "--methods", "paper-adapted", "-o",
               path("out")}),
         65, "absent.yaml");
  folder_.write("bad.yaml", "schema: 7\n");
  expect(call({"run", path("run"), "--calibration", path("bad.yaml"), "--methods", "paper-adapted", "-o",
               path("out")}),
         78, "bad.yaml");
  expect(call({"tune", "paper-adapted", "--runs", path("run")}), 2, "DATASET=CALIBRATION");
  expect(call({"fly"}), 2, "unknown command 'fly'");
  EXPECT_EQ(call({}).exit_code, 2);
  EXPECT_EQ(call({"--help"}).exit_code, 0);
}

TEST_F(BaselinesTest, AnchorsThatTheCalibrationLacksAreAWarning) {
  io::Dataset run = test::make_small_run(5.0, 5);
  run.surveyed_anchors.pop_back();
  folder_.write("site.yaml", io::format_calibration(model::surveyed_calibration(
                                 run.surveyed_anchors, run.tags, run.range_priors, 0.02)));
  const test::ChildResult result = run_method("paper-adapted");
  EXPECT_EQ(result.exit_code, 3);
  EXPECT_THAT(result.err, HasSubstr("ranges are of anchors or pairs that"));
}

}  // namespace
}  // namespace groma::baseline
