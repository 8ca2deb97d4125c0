// Places for the labels of marks, so that none lies over a mark or another label.
#pragma once

#include <span>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace groma::report {

struct Label {
  Eigen::Vector2d at_px;  // its mark
  std::string text;
};

struct LabelPlace {
  Eigen::Vector2d text_px;  // left end of the text's base line, from the mark
  Eigen::Vector2d
      lead_px;  // where the line from the mark to the label ends, from the mark; zero: none is needed
};

// marks_px: all marks, also those without a label. size_px: labels stay within the area as far as they can.
// In the order of `labels`: earlier ones are nearer to their marks.
[[nodiscard]] std::vector<LabelPlace> place_labels(std::span<const Label> labels,
                                                   std::span<const Eigen::Vector2d> marks_px,
                                                   const Eigen::Vector2d& size_px);

}  // namespace groma::report
