#include "host/io/calibration_file.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <optional>
#include <vector>

#include <Eigen/Eigenvalues>
#include <nlohmann/json.hpp>

#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"

namespace groma::io {

namespace {

// In the order of their enumerations.
constexpr std::array<std::string_view, 6> kAnchorVerdicts{"ok",    "weak-z", "weak", "never-in-sight",
                                                          "moved", "no-data"};
constexpr std::array<std::string_view, 3> kVerdicts{"usable", "warnings", "unusable"};

// Relative tolerance: a file edited by hand may be inconsistent by rounding.
constexpr double kAgreement = 1e-6;
// Of a robot in a hall, to read files whose range noise has a time in place of a length.
constexpr double kFormerSpeed_mps = 1.0;

using Output = std::back_insert_iterator<std::string>;

// A JSON string is a valid double-quoted YAML 1.2 string.
std::string yaml_text(std::string_view text) {
  return nlohmann::json(text).dump(-1, ' ', true, nlohmann::json::error_handler_t::replace);
}

std::string yaml_number(const std::optional<double>& value) {
  return value && std::isfinite(*value) ? fmt::format("{}", *value) : "null";
}

std::string yaml_list(const Eigen::VectorXd& values) {
  return fmt::format("[{}]", fmt::join(values.begin(), values.end(), ", "));
}

void write_matrix(Output out, std::string_view indent, std::string_view key, const Eigen::MatrixXd& matrix) {
  fmt::format_to(out, "{}{}:\n", indent, key);
  for (const auto& row : matrix.rowwise())
    fmt::format_to(out, "{}  - {}\n", indent, yaml_list(row.transpose()));
}

void write_anchor(Output out, const model::AnchorCalibration& anchor) {
  fmt::format_to(out, "  - id: {}\n", anchor.id);
  fmt::format_to(out, "    verdict: {}\n", word(anchor.verdict));
  fmt::format_to(out, "    advice: {}\n", yaml_text(anchor.advice));
  fmt::format_to(out, "    ranges_used: {}\n", anchor.ranges_used);
  fmt::format_to(out, "    ranges_rejected: {}\n", anchor.ranges_rejected);
  fmt::format_to(out, "    held_out_rms_m: {}\n", yaml_number(anchor.held_out_rms_m));
  fmt::format_to(out, "    held_out_robust_rms_m: {}\n", yaml_number(anchor.held_out_robust_rms_m));
  fmt::format_to(out, "    mirror_ratio: {}\n", yaml_number(anchor.mirror_ratio));
  if (!model::has_position(anchor)) {
    fmt::format_to(out, "    position_m: null\n    covariance_m2: null\n    pairs: []\n");
    return;
  }
  fmt::format_to(out, "    position_m: {}\n", yaml_list(anchor.position_m));
  write_matrix(out, "    ", "covariance_m2", anchor.covariance.topLeftCorner<3, 3>());
  fmt::format_to(out, "    pairs:{}\n", anchor.pairs.empty() ? " []" : "");
  for (const model::PairBias& pair : anchor.pairs) {
    fmt::format_to(out, "      - {{tag: {}", pair.tag_id);
    for (const model::PairTerm& term : model::kPairTerms) {
      fmt::format_to(out, ", {}: {}, {}: {}", term.key.value, pair.*term.value, term.key.variance,
                     model::square(pair.*term.sigma));
    }
    fmt::format_to(out, "}}\n");
  }
  write_matrix(out, "    ", "block_covariance", anchor.covariance);
}

void write_tag(Output out, const model::TagCalibration& tag) {
  fmt::format_to(out, "  - tag: {}\n", tag.id);
  if (tag.lever_arm) {
    const Eigen::Vector3d& sigma_m = tag.lever_arm->sigma_m;
    const auto variance = [&](Eigen::Index axis) { return yaml_number(sigma_m(axis) * sigma_m(axis)); };
    fmt::format_to(out, "    lever_arm_m: {}\n", yaml_list(tag.lever_arm->position_m));
    fmt::format_to(out, "    lever_arm_variance_m2: [{}, {}, {}]\n", variance(0), variance(1), variance(2));
  }
  if (tag.pattern_m) fmt::format_to(out, "    antenna_pattern_m: {}\n", yaml_list(*tag.pattern_m));
}

Eigen::MatrixXd parse_covariance(const YamlValue& yaml, std::size_t size) {
  const auto n = static_cast<Eigen::Index>(size);
  Eigen::MatrixXd matrix(n, n);
  Eigen::Index row = 0;
  for (const YamlValue& values : yaml.list_of(size)) {
    Eigen::Index column = 0;
    for (const double value : values.numbers(size)) matrix(row, column++) = value;
    ++row;
  }
  const double scale = matrix.cwiseAbs().maxCoeff();
  if (!((matrix - matrix.transpose()).cwiseAbs().maxCoeff() <= kAgreement * scale)) {
    yaml.fail("is not symmetric", "make the entries across the diagonal equal");
  }
  const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> eigen(matrix, Eigen::EigenvaluesOnly);
  if (!(eigen.eigenvalues().minCoeff() >= -kAgreement * scale)) {
    yaml.fail("is not a covariance: a variance would be negative", "correct its entries, or calibrate again");
  }
  return matrix;
}

bool agree(const Eigen::MatrixXd& a, const Eigen::MatrixXd& b) {
  return (a - b).cwiseAbs().maxCoeff() <=
         kAgreement * std::max(a.cwiseAbs().maxCoeff(), b.cwiseAbs().maxCoeff());
}

double parse_variance(const YamlValue& yaml) {
  const double variance = yaml.number();
  if (variance < 0.0) yaml.fail("is negative", "it has to be 0 or above");
  return variance;
}

model::RangeNoise parse_range_noise(const YamlValue& yaml) {
  yaml.expect_keys({{"white_variance_m2", "slow_variance_m2"}, {"slow_length_m", "slow_time_s"}});
  model::RangeNoise noise;
  const double white_m2 = yaml.at("white_variance_m2").positive_number();
  noise.white_sigma_m = std::sqrt(white_m2);
  noise.bias_sigma_m = std::sqrt(parse_variance(yaml.at("slow_variance_m2")));
  const auto time_s = yaml.find("slow_time_s");
  if (time_s && yaml.find("slow_length_m"))
    time_s->fail("contradicts slow_length_m, which took its place", "remove it");
  noise.bias_length_m =
      time_s ? kFormerSpeed_mps * time_s->positive_number() : yaml.at("slow_length_m").positive_number();
  return noise;
}

std::vector<model::PairBias> parse_pairs(const YamlValue& yaml) {
  YamlValue::Keys keys{{"tag"}};
  for (const model::PairTerm& term : model::kPairTerms) {
    keys.required.emplace_back(term.key.value);
    keys.required.emplace_back(term.key.variance);
  }
  std::vector<model::PairBias> pairs;
  for (const YamlValue& entry : yaml.list()) {
    entry.expect_keys(keys);
    model::PairBias pair;
    pair.tag_id =
        static_cast<model::NodeId>(entry.at("tag").integer(0, std::numeric_limits<model::NodeId>::max()));
    for (const model::PairTerm& term : model::kPairTerms) {
      const YamlValue value = entry.at(term.key.value);
      pair.*term.value = term.neutral > 0.0 ? value.positive_number() : value.number();
      pair.*term.sigma = std::sqrt(parse_variance(entry.at(term.key.variance)));
    }
    if (!pairs.empty() && pair.tag_id <= pairs.back().tag_id) {
      entry.fail("is out of order", "write the pairs by tag, ascending, each once");
    }
    pairs.push_back(pair);
  }
  return pairs;
}

model::TagCalibration parse_tag(const YamlValue& yaml) {
  yaml.expect_keys({{"tag"}, {"lever_arm_m", "lever_arm_variance_m2", "antenna_pattern_m"}});
  model::TagCalibration tag;
  tag.id = static_cast<model::NodeId>(yaml.at("tag").integer(0, std::numeric_limits<model::NodeId>::max()));
  if (const auto lever_arm_m = yaml.find("lever_arm_m")) {
    const std::vector<double> values = lever_arm_m->numbers(3);
    tag.lever_arm.emplace();
    tag.lever_arm->position_m << values[0], values[1], values[2];
    Eigen::Index axis = 0;
    for (const YamlValue& variance : yaml.at("lever_arm_variance_m2").list_of(3)) {
      if (!variance.is_null()) tag.lever_arm->sigma_m(axis) = std::sqrt(parse_variance(variance));
      ++axis;
    }
  } else if (const auto variance = yaml.find("lever_arm_variance_m2")) {
    variance->fail("is given without lever_arm_m", "write both, or neither");
  }
  if (const auto pattern_m = yaml.find("antenna_pattern_m")) {
    const std::vector<double> values = pattern_m->numbers(model::kPatternTerms);
    tag.pattern_m = Eigen::Map<const model::PatternTerms>(values.data());
  }
  return tag;
}

// The anchor's block from the position's covariance and the pairs' variances, for a file without
// block_covariance.
Eigen::MatrixXd block_of(const Eigen::MatrixXd& position, const std::vector<model::PairBias>& pairs) {
  const Eigen::Index size = model::anchor_size(std::ssize(pairs));
  Eigen::MatrixXd block = Eigen::MatrixXd::Zero(size, size);
  block.topLeftCorner<3, 3>() = position;
  Eigen::Index at = 3;
  for (const model::PairTerm& term : model::kPairTerms) {
    for (const model::PairBias& pair : pairs) block.diagonal()(at++) = model::square(pair.*term.sigma);
  }
  return block;
}

std::optional<double> parse_optional(const YamlValue& yaml) {
  if (yaml.is_null()) return std::nullopt;
  return yaml.number();
}

model::AnchorCalibration parse_anchor(const YamlValue& yaml) {
  yaml.expect_keys({{"id", "verdict", "position_m", "covariance_m2", "pairs"},
                    {"advice", "ranges_used", "ranges_rejected", "held_out_rms_m", "held_out_robust_rms_m",
                     "mirror_ratio", "block_covariance"}});
  constexpr std::int64_t kMaxCount = std::numeric_limits<std::int64_t>::max();
  model::AnchorCalibration anchor;
  anchor.id = static_cast<model::NodeId>(yaml.at("id").integer(0, std::numeric_limits<model::NodeId>::max()));
  anchor.verdict = static_cast<model::AnchorVerdict>(yaml.at("verdict").one_of(kAnchorVerdicts));
  if (const auto advice = yaml.find("advice")) anchor.advice = advice->text();
  if (const auto used = yaml.find("ranges_used")) {
    anchor.ranges_used = static_cast<std::size_t>(used->integer(0, kMaxCount));
  }
  if (const auto rejected = yaml.find("ranges_rejected")) {
    anchor.ranges_rejected = static_cast<std::size_t>(rejected->integer(0, kMaxCount));
  }
  if (const auto rms_m = yaml.find("held_out_rms_m")) anchor.held_out_rms_m = parse_optional(*rms_m);
  if (const auto rms_m = yaml.find("held_out_robust_rms_m")) {
    anchor.held_out_robust_rms_m = parse_optional(*rms_m);
  }
  if (const auto ratio = yaml.find("mirror_ratio")) anchor.mirror_ratio = parse_optional(*ratio);

  if (yaml.at("position_m").is_null()) {
    anchor.position_m.setConstant(std::numeric_limits<double>::quiet_NaN());
    if (!yaml.at("covariance_m2").is_null()) {
      yaml.at("covariance_m2").fail("is given without a position", "write both, or null for both");
    }
    return anchor;
  }
  const std::vector<double> position_m = yaml.at("position_m").numbers(3);
  anchor.position_m << position_m[0], position_m[1], position_m[2];
  anchor.pairs = parse_pairs(yaml.at("pairs"));
  const Eigen::MatrixXd own = block_of(parse_covariance(yaml.at("covariance_m2"), 3), anchor.pairs);
  anchor.covariance = own;
  if (const auto block = yaml.find("block_covariance")) {
    anchor.covariance = parse_covariance(*block, static_cast<std::size_t>(own.rows()));
    const bool same = agree(own.topLeftCorner<3, 3>(), anchor.covariance.topLeftCorner<3, 3>()) &&
                      agree(own.diagonal(), anchor.covariance.diagonal());
    if (!same) {
      block->fail("disagrees with covariance_m2 or the pairs' variances",
                  "change both consistently, or omit block_covariance");
    }
  }
  return anchor;
}

}  // namespace

std::string_view word(model::AnchorVerdict verdict) {
  return kAnchorVerdicts.at(static_cast<std::size_t>(verdict));
}

std::string_view word(model::Verdict verdict) {
  return kVerdicts.at(static_cast<std::size_t>(verdict));
}

std::string format_calibration(const model::Calibration& calibration) {
  std::string text;
  const Output out(text);
  fmt::format_to(out, "%YAML 1.2\n---\nschema: 1\n");
  fmt::format_to(out, "program_version: {}\n", yaml_text(calibration.program_version));
  fmt::format_to(out, "input_sha256: {}\n", yaml_text(calibration.input_sha256));
  fmt::format_to(out, "frame: {}\n", yaml_text(calibration.frame));
  fmt::format_to(out, "verdict: {}\n", word(calibration.verdict));
  fmt::format_to(
      out, "# Of the shift (x, y, z in m) and turn (yaw in rad) that all anchors share through the poses.\n");
  write_matrix(out, "", "common_frame_covariance", calibration.common_frame_covariance);
  fmt::format_to(out, "# Of ranges behind the poses; a variance of 0: not observed.\n");
  fmt::format_to(out, "range_delay: {{mean_s: {}, variance_s2: {}}}\n", calibration.range_delay_s,
                 calibration.range_delay_sigma_s * calibration.range_delay_sigma_s);
  if (calibration.range_clock) {
    const model::ClockError& clock = *calibration.range_clock;
    fmt::format_to(out,
                   "# Of range times, late by offset_s + drift (t_s - reference_s): corrected before use.\n");
    fmt::format_to(out, "range_clock: {{offset_s: {}, drift: {}, reference_s: {}}}\n", clock.offset_s,
                   clock.drift, clock.reference_s);
  }
  if (calibration.range_noise) {
    const model::RangeNoise& noise = *calibration.range_noise;
    fmt::format_to(out,
                   "# Noise of LOS ranges: white, and a Gauss-Markov bias that an anchor's tags share.\n");
    fmt::format_to(out, "range_noise: {{white_variance_m2: {}, slow_variance_m2: {}, slow_length_m: {}}}\n",
                   noise.white_sigma_m * noise.white_sigma_m, noise.bias_sigma_m * noise.bias_sigma_m,
                   noise.bias_length_m);
  }
  if (!calibration.tags.empty()) {
    fmt::format_to(
        out,
        "# antenna_pattern_m: of x^2 - y^2, 2 x y, 2 x z, 2 y z and 3 z^2 - 1 of the way to an anchor.\n");
    fmt::format_to(out, "tags:\n");
    for (const model::TagCalibration& tag : calibration.tags) write_tag(out, tag);
  }
  fmt::format_to(out, "# block_covariance: position");
  for (const model::PairTerm& term : model::kPairTerms)
    fmt::format_to(out, ", then {} of each pair", term.text.name);
  fmt::format_to(out, ".\n");
  fmt::format_to(out, "anchors:{}\n", calibration.anchors.empty() ? " []" : "");
  for (const model::AnchorCalibration& anchor : calibration.anchors) write_anchor(out, anchor);
  return text;
}

model::Calibration parse_calibration(const std::filesystem::path& path, const std::string& text) {
  const YamlValue yaml = YamlValue::parse(path, text);
  yaml.expect_keys({{"schema", "frame", "anchors"},
                    {"program_version", "input_sha256", "verdict", "common_frame_covariance", "range_delay",
                     "range_clock", "range_noise", "tags"}});
  if (yaml.at("schema").integer(0, std::numeric_limits<std::int64_t>::max()) != 1) {
    yaml.at("schema").fail("is not 1", "this program reads schema 1 only");
  }
  model::Calibration calibration;
  calibration.frame = yaml.at("frame").text();
  if (const auto version = yaml.find("program_version")) calibration.program_version = version->text();
  if (const auto sha256 = yaml.find("input_sha256")) calibration.input_sha256 = sha256->text();
  calibration.verdict = model::Verdict::kUsable;
  if (const auto verdict = yaml.find("verdict")) {
    calibration.verdict = static_cast<model::Verdict>(verdict->one_of(kVerdicts));
  }
  if (const auto frame = yaml.find("common_frame_covariance")) {
    calibration.common_frame_covariance = parse_covariance(*frame, 4);
  }
  if (const auto delay = yaml.find("range_delay")) {
    delay->expect_keys({{"mean_s", "variance_s2"}});
    calibration.range_delay_s = delay->at("mean_s").number();
    calibration.range_delay_sigma_s = std::sqrt(parse_variance(delay->at("variance_s2")));
  }
  if (const auto clock = yaml.find("range_clock")) {
    clock->expect_keys({{"offset_s", "drift", "reference_s"}});
    calibration.range_clock = model::ClockError{.offset_s = clock->at("offset_s").number(),
                                                .drift = clock->at("drift").number(),
                                                .reference_s = clock->at("reference_s").number()};
  }
  if (const auto noise = yaml.find("range_noise")) calibration.range_noise = parse_range_noise(*noise);
  if (const auto tags = yaml.find("tags")) {
    for (const YamlValue& entry : tags->list()) {
      const model::TagCalibration tag = parse_tag(entry);
      if (!calibration.tags.empty() && tag.id <= calibration.tags.back().id) {
        entry.fail("is out of order", "write the tags by id, ascending, each once");
      }
      calibration.tags.push_back(tag);
    }
  }
  for (const YamlValue& entry : yaml.at("anchors").list()) {
    calibration.anchors.push_back(parse_anchor(entry));
    if (calibration.anchors.size() > 1 &&
        entry.at("id").integer(0, 65535) <= std::prev(calibration.anchors.end(), 2)->id) {
      entry.at("id").fail("is out of order", "write the anchors by id, ascending, each once");
    }
  }
  return calibration;
}

model::Calibration read_calibration(const std::filesystem::path& path) {
  return parse_calibration(path, read_file(path));
}

}  // namespace groma::io
