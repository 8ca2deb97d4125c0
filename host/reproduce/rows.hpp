// Rows of a table: each drive localized by the source paper's filters, and by ours.
#pragma once

#include <string>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "host/io/dataset.hpp"
#include "host/reproduce/score.hpp"
#include "host/reproduce/study.hpp"

namespace groma::reproduce {

struct Row {
  std::string key;
  std::string published;  // method of groma-baselines; empty: none
  filter::Model ours;
  Subset subset;
};

// The surface becomes the plane at zero height.
void flatten(io::Dataset& drive);
// As `groma calibrate`.
[[nodiscard]] calibration::Result calibrate(const io::Dataset& drive);

// What a filter gets.
struct Input {
  const io::Dataset& drive;
  const model::Calibration& calibration;
};

// {key: {"ours": {"score", "update_ns", "propagate_ns"}, "published": {"score", "facts"}}, ...}, both with
// "errors", "path", "truth" and "ellipses" if the settings ask for curves. Without groma-baselines nothing is
// published.
[[nodiscard]] Json run_rows(const std::vector<Row>& rows, const Input& ours, const Input& published,
                            const Settings& settings);

}  // namespace groma::reproduce
