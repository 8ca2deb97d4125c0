// Results as JSON objects for scripts; unknown values are null.
#pragma once

#include <nlohmann/json.hpp>

#include "host/calibration/calibrate.hpp"
#include "host/evaluation/evaluation.hpp"
#include "host/io/dataset.hpp"

namespace groma::cli {

using Json = nlohmann::ordered_json;

// tag, anchor, and each term of the range model with its sigma.
[[nodiscard]] Json to_json(const model::PairBias& pair, model::NodeId anchor_id);
// verdict, ranges_used, ranges_rejected, anchors and pairs.
[[nodiscard]] Json to_json(const calibration::Result& result);
// samples, ate_m, ate_rad and nees.
[[nodiscard]] Json to_json(const evaluation::Evaluation& evaluation);
[[nodiscard]] Json to_json(const io::DroppedRows& dropped);

// Prints the object to standard output, indented, with a final line end.
void say_json(const Json& json);

}  // namespace groma::cli
