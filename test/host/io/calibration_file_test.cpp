#include "host/io/calibration_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>

#include "host/io/error.hpp"
#include "host/io/output_file.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::io {
namespace {

using testing::HasSubstr;
using testing::ThrowsMessage;

// Numbers without a short decimal form.
Eigen::MatrixXd awkward_covariance(Eigen::Index size, double seed) {
  Eigen::MatrixXd root(size, size);
  for (Eigen::Index i = 0; i < size; ++i) {
    for (Eigen::Index j = 0; j < size; ++j)
      root(i, j) = std::sin(seed + 1.7 * static_cast<double>(i * size + j)) / 30.0;
  }
  const Eigen::MatrixXd product = root * root.transpose();
  return 0.5 * (product + product.transpose());
}

model::AnchorCalibration make_anchor(model::NodeId id, std::initializer_list<model::NodeId> tags) {
  model::AnchorCalibration anchor;
  anchor.id = id;
  anchor.position_m = {std::sqrt(2.0) * id, -1.0 / 3.0, 1e-17};
  for (const model::NodeId tag : tags)
    anchor.pairs.push_back({.tag_id = tag, .beta_m = 0.1 / 3.0 * tag, .gamma = 1.0 + 1e-3 / 7.0});
  set_values(anchor, values_of(anchor),
             awkward_covariance(model::anchor_size(static_cast<Eigen::Index>(tags.size())), id));
  anchor.ranges_used = 1234;
  anchor.ranges_rejected = 5;
  anchor.held_out_rms_m = 0.1 + 0.2;
  anchor.mirror_ratio = std::nullopt;
  anchor.verdict = model::AnchorVerdict::kWeakZ;
  anchor.advice = "drive \"past\" it:\n within 3 m, #1 \\ é";
  return anchor;
}

model::Calibration make_calibration() {
  model::Calibration calibration;
  calibration.frame = "hall: 2";
  calibration.anchors = {make_anchor(4, {1, 2, 3}), make_anchor(65535, {7})};
  calibration.common_frame_covariance = awkward_covariance(4, 0.3);
  calibration.tags.resize(2);
  calibration.tags[0].id = 1;
  calibration.tags[0].pattern_m = model::PatternTerms::LinSpaced(-0.01, 0.02);
  calibration.tags[1].id = 3;
  calibration.tags[1].lever_arm.emplace();
  calibration.tags[1].lever_arm->position_m = {0.1 / 3.0, -0.2, 0.3};
  calibration.tags[1].lever_arm->sigma_m(1) = 0.004;
  calibration.range_delay_s = 0.0211;
  calibration.range_delay_sigma_s = 0.0017;
  calibration.range_noise = {.white_sigma_m = 0.05, .bias_sigma_m = 0.07, .bias_length_m = 1.0 / 3.0};
  calibration.verdict = model::Verdict::kWarnings;
  calibration.input_sha256 = "00e1";
  calibration.program_version = "0.1.0";
  return calibration;
}

model::Calibration round_trip(const model::Calibration& calibration) {
  return parse_calibration("c.yaml", format_calibration(calibration));
}

TEST(CalibrationFileTest, EveryNumberSurvivesExactly) {
  const model::Calibration before = make_calibration();
  const model::Calibration after = round_trip(before);
  EXPECT_EQ(after.frame, before.frame);
  EXPECT_EQ(after.common_frame_covariance, before.common_frame_covariance);
  ASSERT_EQ(after.tags.size(), before.tags.size());
  EXPECT_EQ(after.tags[0].id, before.tags[0].id);
  EXPECT_EQ(after.tags[0].pattern_m, before.tags[0].pattern_m);
  EXPECT_FALSE(after.tags[0].lever_arm.has_value());
  EXPECT_FALSE(after.tags[1].pattern_m.has_value());
  ASSERT_TRUE(after.tags[1].lever_arm.has_value());
  EXPECT_EQ(after.tags[1].lever_arm->position_m, before.tags[1].lever_arm->position_m);
  EXPECT_TRUE(std::isnan(after.tags[1].lever_arm->sigma_m(0)));
  EXPECT_DOUBLE_EQ(after.tags[1].lever_arm->sigma_m(1), 0.004);
  EXPECT_EQ(after.range_delay_s, before.range_delay_s);
  EXPECT_DOUBLE_EQ(after.range_delay_sigma_s, before.range_delay_sigma_s);
  ASSERT_TRUE(after.range_noise.has_value());
  EXPECT_DOUBLE_EQ(after.range_noise->white_sigma_m, 0.05);
  EXPECT_DOUBLE_EQ(after.range_noise->bias_sigma_m, 0.07);
  EXPECT_EQ(after.range_noise->bias_length_m, before.range_noise->bias_length_m);
  EXPECT_EQ(after.verdict, before.verdict);
  EXPECT_EQ(after.input_sha256, before.input_sha256);
  EXPECT_EQ(after.program_version, before.program_version);
  ASSERT_EQ(after.anchors.size(), before.anchors.size());
  for (std::size_t i = 0; i < before.anchors.size(); ++i) {
    const model::AnchorCalibration& a = before.anchors[i];
    const model::AnchorCalibration& b = after.anchors[i];
    EXPECT_EQ(b.id, a.id);
    EXPECT_EQ(b.position_m, a.position_m);
    EXPECT_EQ(b.covariance, a.covariance);
    EXPECT_EQ(b.ranges_used, a.ranges_used);
    EXPECT_EQ(b.ranges_rejected, a.ranges_rejected);
    EXPECT_EQ(b.held_out_rms_m, a.held_out_rms_m);
    EXPECT_EQ(b.mirror_ratio, a.mirror_ratio);
    EXPECT_EQ(b.verdict, a.verdict);
    EXPECT_EQ(b.advice, a.advice);
    ASSERT_EQ(b.pairs.size(), a.pairs.size());
    for (std::size_t j = 0; j < a.pairs.size(); ++j) {
      EXPECT_EQ(b.pairs[j].tag_id, a.pairs[j].tag_id);
      for (const model::PairTerm& term : model::kPairTerms) {
        EXPECT_EQ(b.pairs[j].*term.value, a.pairs[j].*term.value) << term.text.name;
        EXPECT_EQ(b.pairs[j].*term.sigma, a.pairs[j].*term.sigma) << "written as a variance";
      }
    }
  }
  EXPECT_EQ(format_calibration(after), format_calibration(before));
}

// As written before slow_length_m.
TEST(CalibrationFileTest, ReadsATimeOfTheSlowBiasAsTheWayAtOneMetrePerSecond) {
  std::string text = format_calibration(make_calibration());
  const std::size_t at = text.find("slow_length_m:");
  ASSERT_NE(at, std::string::npos);
  text.replace(at, std::string("slow_length_m:").size(), "slow_time_s:");
  EXPECT_DOUBLE_EQ(parse_calibration("c.yaml", text).range_noise->bias_length_m, 1.0 / 3.0);
  text.insert(at, "slow_length_m: 0.3, ");
  EXPECT_THAT([&] { static_cast<void>(parse_calibration("c.yaml", text)); },
              ThrowsMessage<ConfigError>(HasSubstr("contradicts slow_length_m")));
}

TEST(CalibrationFileTest, EveryVerdictHasAName) {
  for (int i = 0; i <= static_cast<int>(model::AnchorVerdict::kNoData); ++i) {
    model::Calibration calibration = make_calibration();
    calibration.anchors[0].verdict = static_cast<model::AnchorVerdict>(i);
    EXPECT_EQ(round_trip(calibration).anchors[0].verdict, static_cast<model::AnchorVerdict>(i));
  }
  for (int i = 0; i <= static_cast<int>(model::Verdict::kUnusable); ++i) {
    model::Calibration calibration = make_calibration();
    calibration.verdict = static_cast<model::Verdict>(i);
    EXPECT_EQ(round_trip(calibration).verdict, static_cast<model::Verdict>(i));
  }
}

TEST(CalibrationFileTest, AnAnchorWithoutAPositionIsWrittenAsNull) {
  model::Calibration calibration = make_calibration();
  calibration.anchors[0].covariance(2, 2) = std::numeric_limits<double>::infinity();
  calibration.anchors[1].covariance.resize(0, 0);
  for (const model::AnchorCalibration& anchor : round_trip(calibration).anchors) {
    EXPECT_TRUE(anchor.position_m.array().isNaN().all());
    EXPECT_EQ(anchor.covariance.size(), 0);
    EXPECT_TRUE(anchor.pairs.empty());
    EXPECT_EQ(anchor.ranges_used, 1234U);
  }
}

TEST(CalibrationFileTest, ACalibrationMayHaveNoAnchors) {
  model::Calibration calibration = make_calibration();
  calibration.anchors.clear();
  EXPECT_TRUE(round_trip(calibration).anchors.empty());
}

// A file as a user would write it.
const std::string kByHand =
    "schema: 1\n"
    "frame: map\n"
    "anchors:\n"
    "  - id: 4\n"
    "    verdict: ok\n"
    "    position_m: [1, 2, 3]\n"
    "    covariance_m2: [[0.04, 0, 0], [0, 0.04, 0], [0, 0, 0.09]]\n"
    "    pairs: [{tag: 1, beta_m: 0.2, beta_variance_m2: 0.25, gamma: 1, gamma_variance: 0.0001}]\n";

TEST(CalibrationFileTest, TheBlockIsOptional) {
  const model::Calibration calibration = parse_calibration("c.yaml", kByHand);
  ASSERT_EQ(calibration.anchors.size(), 1U);
  const Eigen::VectorXd diagonal = calibration.anchors[0].covariance.diagonal();
  EXPECT_EQ(diagonal.head<5>(), (Eigen::VectorXd(5) << 0.04, 0.04, 0.09, 0.25, 0.0001).finished());
  EXPECT_EQ(calibration.anchors[0].covariance.sum(), diagonal.sum()) << "nothing off the diagonal";
  EXPECT_EQ(calibration.anchors[0].pairs[0].beta_sigma_m, 0.5);
}

struct Fault {
  std::string name;
  std::string from;  // in kByHand
  std::string to;
  std::string place;
  std::string problem;
};

std::ostream& operator<<(std::ostream& out, const Fault& fault) {
  return out << fault.name;
}

class CalibrationFaultTest : public testing::TestWithParam<Fault> {};

TEST_P(CalibrationFaultTest, IsAConfigErrorWithItsPlace) {
  const Fault& fault = GetParam();
  std::string text = kByHand;
  const std::size_t at = text.find(fault.from);
  ASSERT_NE(at, std::string::npos);
  text.replace(at, fault.from.size(), fault.to);
  try {
    static_cast<void>(parse_calibration("c.yaml", text));
    FAIL() << "no error";
  } catch (const ConfigError& error) {
    EXPECT_THAT(error.what(), HasSubstr("c.yaml:" + fault.place + ": "));
    EXPECT_THAT(error.what(), HasSubstr(fault.problem));
  }
}

INSTANTIATE_TEST_SUITE_P(
    Yaml, CalibrationFaultTest,
    testing::Values(
        Fault{"UnknownKey", "frame: map", "frame: map\nfrme: x", "3:1", "unknown key 'frme'"},
        Fault{"UnknownAnchorKey", "    verdict: ok", "    verdict: ok\n    colour: red", "6:5",
              "unknown key 'colour'"},
        Fault{"UnknownPairKey", "gamma: 1,", "gamma: 1, delta: 2,", "8:69", "unknown key 'delta'"},
        Fault{"MissingKey", "    position_m: [1, 2, 3]\n", "", "4:5", "anchors[0] lacks the key position_m"},
        Fault{"OtherSchema", "schema: 1", "schema: 2", "1:9", "this program reads schema 1 only"},
        Fault{"Verdict", "verdict: ok", "verdict: good", "5:14", "anchors[0].verdict is 'good'"},
        Fault{"IdTooLarge", "id: 4", "id: 65536", "4:9", "is 65536"},
        Fault{"TextForNumber", "[1, 2, 3]", "[1, two, 3]", "6:21",
              "anchors[0].position_m[1] is not a number: 'two'"},
        Fault{"NaN", "[1, 2, 3]", "[1, .nan, 3]", "6:21", "is not a number"},
        Fault{"TwoCoordinates", "[1, 2, 3]", "[1, 2]", "6:17", "has 2 entries"},
        Fault{"NotSquare", "[0, 0.04, 0], [0, 0, 0.09]", "[0, 0.04], [0, 0, 0.09]", "7:35", "has 2 entries"},
        Fault{"NotSymmetric", "[0, 0.04, 0]", "[0.01, 0.04, 0]", "7:20", "is not symmetric"},
        Fault{"NegativeVariance", "0, 0, 0.09", "0, 0, -0.09", "7:20", "is not a covariance"},
        Fault{"Indefinite", "[0.04, 0, 0], [0, 0.04, 0]", "[0.04, 0.05, 0], [0.05, 0.04, 0]", "7:20",
              "is not a covariance"},
        Fault{"NegativeBetaVariance", "beta_variance_m2: 0.25", "beta_variance_m2: -0.25", "8:53",
              "is negative"},
        Fault{"GammaZero", "gamma: 1,", "gamma: 0,", "8:66", "is 0"},
        Fault{"PairTwice", "0.0001}]",
              "0.0001}, {tag: 1, beta_m: 0, beta_variance_m2: 1, gamma: 1, gamma_variance: 1}]", "8:94",
              "out of order"},
        Fault{"AnchorTwice", "anchors:\n",
              "anchors:\n  - {id: 4, verdict: no-data, position_m: null, covariance_m2: null, pairs: []}\n",
              "5:9", "out of order"},
        Fault{"BlockDisagrees", "    pairs",
              "    block_covariance: "
              "[[1,0,0,0,0],[0,0.04,0,0,0],[0,0,0.09,0,0],[0,0,0,0.25,0],[0,0,0,0,0.0001]]\n    pairs",
              "8:23", "disagrees"},
        Fault{"BlockSize", "    pairs", "    block_covariance: [[1]]\n    pairs", "8:23", "has 1 entries"},
        Fault{"CovarianceAlone", "position_m: [1, 2, 3]", "position_m: null", "7:20", "without a position"}),
    [](const auto& fault) { return fault.param.name; });

TEST(CalibrationFileTest, AMissingFileIsADataError) {
  EXPECT_THROW(static_cast<void>(read_calibration("/nowhere/c.yaml")), DataError);
}

}  // namespace
}  // namespace groma::io
