// The site's parameters as the filter numbers them, with their values.
#pragma once

#include <array>
#include <span>

#include <Eigen/Core>

#include "host/filter/state.hpp"
#include "host/model/calibration.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

using ParameterVector = Eigen::Matrix<double, Eigen::Dynamic, 1, Eigen::ColMajor, kMaxParameters, 1>;
// Too large for the stack; made in its full size at construction and never resized.
using ParameterMatrix = Eigen::MatrixXd;

// Where each parameter stands in the vector; anchors and tags are numbered by slots from 0.
class Parameters {
 public:
  // Takes the first kMaxTags tags, and the first kMaxAnchors anchors that have a finite position and a
  // finite covariance of the right size. Lever arms are those of the calibration where it tells them.
  Parameters(std::span<const model::Tag> tags, const model::Calibration& calibration);

  [[nodiscard]] int anchor_count() const noexcept { return anchor_count_; }
  [[nodiscard]] int tag_count() const noexcept { return tag_count_; }
  [[nodiscard]] int size() const noexcept { return slow_error(anchor_count_); }

  // Slot of an id, -1 where there is none.
  [[nodiscard]] int anchor_slot(model::NodeId id) const noexcept;
  [[nodiscard]] int tag_slot(model::NodeId id) const noexcept;
  // Whether the calibration knows this pair of slots.
  [[nodiscard]] bool knows_pair(int anchor, int tag) const noexcept;

  // First index of each.
  [[nodiscard]] int anchor_size() const noexcept { return 3 + 2 * tag_count_; }
  [[nodiscard]] int position(int anchor) const noexcept { return anchor * anchor_size(); }
  [[nodiscard]] int beta(int anchor, int tag) const noexcept { return position(anchor) + 3 + tag; }
  [[nodiscard]] int gamma(int anchor, int tag) const noexcept { return beta(anchor, tag) + tag_count_; }
  [[nodiscard]] int lever_arm(int tag) const noexcept { return anchor_count_ * anchor_size() + 3 * tag; }
  [[nodiscard]] int frame() const noexcept { return lever_arm(tag_count_); }

  [[nodiscard]] int slow_error(int anchor) const noexcept { return frame() + kFrameSize + anchor; }

  [[nodiscard]] const ParameterVector& values() const noexcept { return values_; }
  [[nodiscard]] ParameterVector& values() noexcept { return values_; }

  // Of a tag's antenna, zero where the calibration tells none.
  [[nodiscard]] const model::PatternTerms& pattern_m(int tag) const noexcept {
    return patterns_m_[static_cast<std::size_t>(tag)];
  }

  // The covariance they come with: a block of each anchor, of each lever arm, of the frame; the
  // variance of each slow error; nothing between.
  [[nodiscard]] ParameterMatrix prior_covariance(const model::Calibration& calibration,
                                                 double lever_arm_sigma_m) const;

 private:
  std::array<model::NodeId, kMaxAnchors> anchor_ids_{};
  std::array<model::NodeId, kMaxTags> tag_ids_{};
  std::array<std::array<bool, kMaxTags>, kMaxAnchors> known_pairs_{};
  std::array<model::PatternTerms, kMaxTags> patterns_m_;
  int anchor_count_ = 0;
  int tag_count_ = 0;
  ParameterVector values_;
};

}  // namespace groma::filter
