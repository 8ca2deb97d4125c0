// Results as the JSON objects that scripts read; what is unknown is null.
#pragma once

#include <nlohmann/json.hpp>

#include "host/calibration/calibrate.hpp"
#include "host/evaluation/evaluation.hpp"
#include "host/io/dataset.hpp"

namespace groma::cli {

using Json = nlohmann::ordered_json;

// verdict, ranges_used, ranges_rejected, anchors and pairs.
[[nodiscard]] Json to_json(const calibration::Result& result);
// samples, ate_m, ate_rad and nees.
[[nodiscard]] Json to_json(const evaluation::Evaluation& evaluation);
[[nodiscard]] Json to_json(const io::DroppedRows& dropped);

// The object, on lines of its own, to standard output.
void say_json(const Json& json);

}  // namespace groma::cli
