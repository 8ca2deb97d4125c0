#include "host/cli/json.hpp"

#include <optional>

#include "host/cli/terminal.hpp"
#include "host/io/calibration_file.hpp"

namespace groma::cli {

namespace {

Json to_json(const std::optional<double>& value) {
  return value ? Json(*value) : Json(nullptr);
}

Json to_json(const Eigen::Vector3d& vector) {
  return vector.array().isFinite().all() ? Json{vector.x(), vector.y(), vector.z()} : Json(nullptr);
}

Json to_json(const evaluation::Statistics& statistics) {
  return {
      {"max", statistics.max}, {"mean", statistics.mean}, {"std", statistics.std}, {"rmse", statistics.rmse}};
}

Json position_covariance(const model::AnchorCalibration& anchor) {
  if (anchor.covariance.rows() < 3 || anchor.covariance.cols() < 3) return nullptr;
  Json rows = Json::array();
  for (int i = 0; i < 3; ++i) {
    rows.push_back({anchor.covariance(i, 0), anchor.covariance(i, 1), anchor.covariance(i, 2)});
  }
  return rows;
}

Json to_json(const model::AnchorCalibration& anchor) {
  return {{"id", anchor.id},
          {"position_m", to_json(anchor.position_m)},
          {"covariance_m2", position_covariance(anchor)},
          {"held_out_rms_m", to_json(anchor.held_out_rms_m)},
          {"mirror_ratio", to_json(anchor.mirror_ratio)},
          {"verdict", io::word(anchor.verdict)},
          {"advice", anchor.advice},
          {"ranges_used", anchor.ranges_used},
          {"ranges_rejected", anchor.ranges_rejected}};
}

}  // namespace

Json to_json(const model::PairBias& pair, model::NodeId anchor_id) {
  Json json{{"tag", pair.tag_id}, {"anchor", anchor_id}};
  for (const model::PairTerm& term : model::kPairTerms) {
    json[term.key.value] = pair.*term.value;
    json[term.key.sigma] = pair.*term.sigma;
  }
  return json;
}

Json to_json(const calibration::Result& result) {
  Json json;
  json["verdict"] = io::word(result.calibration.verdict);
  json["ranges_used"] = result.ranges_used;
  json["ranges_rejected"] = result.ranges_rejected;
  json["anchors"] = Json::array();
  json["pairs"] = Json::array();
  for (const model::AnchorCalibration& anchor : result.calibration.anchors) {
    json["anchors"].push_back(to_json(anchor));
    for (const model::PairBias& pair : anchor.pairs) json["pairs"].push_back(to_json(pair, anchor.id));
  }
  return json;
}

Json to_json(const evaluation::Evaluation& evaluation) {
  Json json{{"samples", evaluation.samples},
            {"ate_m", to_json(evaluation.ate_m)},
            {"ate_rad", to_json(evaluation.ate_rad)},
            {"nees", nullptr}};
  if (evaluation.nees) {
    json["nees"] = {{"max", evaluation.nees->max},
                    {"mean", evaluation.nees->mean},
                    {"std", evaluation.nees->std},
                    {"inside_95", evaluation.nees->inside_95}};
  }
  return json;
}

Json to_json(const io::DroppedRows& dropped) {
  return {{"range_out_of_bounds", dropped.range_out_of_bounds},
          {"unknown_tag", dropped.unknown_tag},
          {"unknown_anchor", dropped.unknown_anchor},
          {"late", dropped.late},
          {"repeated", dropped.repeated},
          {"implausible", dropped.implausible}};
}

void say_json(const Json& json) {
  say(json.dump(2) + '\n');
}

}  // namespace groma::cli
