// What is told of a site before the filter starts: all of its anchors, however many, and the robot's tags.
// Made once and never changed.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/filter/state.hpp"
#include "host/model/antenna_pattern.hpp"
#include "host/model/calibration.hpp"
#include "host/model/types.hpp"

namespace groma::filter {

// What the range of one tag and one anchor depends on.
struct PairParameters {
  Eigen::Vector3d position_m;  // of the anchor, in the frame that the anchors share
  double beta_m = 0.0;
  double gamma = 1.0;
  double slow_error_m = 0.0;
  Eigen::Vector3d lever_arm_m;
  Eigen::Vector4d frame = Eigen::Vector4d::Zero();
  model::PatternTerms pattern_m = model::PatternTerms::Zero();
  Eigen::Vector3d ground = Eigen::Vector3d::Zero();  // higher (m) and steeper (dS/dx, dS/dy) than the surface
};

struct SiteAnchor {
  model::NodeId id = 0;
  bool is_learnt = false;  // the calibration is sure of it: one that is not may have more than one solution
  std::array<bool, kMaxTags> knows_tag{};
  AnchorVector values;
  // Without what the frame adds; the slow error's variance last, related to nothing.
  AnchorMatrix covariance;
};

class Site {
 public:
  // Takes the first kMaxTags tags, and the anchors that have a finite position and a finite covariance of
  // the right size. Lever arms are those of the calibration where it tells them.
  Site(std::span<const model::Tag> tags, const model::Calibration& calibration, double lever_arm_sigma_m);

  [[nodiscard]] int anchor_count() const noexcept { return static_cast<int>(anchors_.size()); }
  [[nodiscard]] int tag_count() const noexcept { return tag_count_; }
  [[nodiscard]] int anchor_size() const noexcept { return 3 + 2 * tag_count_ + 1; }

  // Index of an id, -1 where there is none.
  [[nodiscard]] int anchor_index(model::NodeId id) const noexcept {
    return id < index_by_id_.size() ? index_by_id_[id] : -1;
  }
  [[nodiscard]] int tag_slot(model::NodeId id) const noexcept;

  [[nodiscard]] const SiteAnchor& anchor(int index) const noexcept {
    return anchors_[static_cast<std::size_t>(index)];
  }
  // Whether the calibration knows this pair.
  [[nodiscard]] bool knows_pair(int index, int tag) const noexcept {
    return anchor(index).knows_tag[static_cast<std::size_t>(tag)];
  }
  [[nodiscard]] const Eigen::Vector3d& lever_arm_m(int tag) const noexcept {
    return lever_arms_m_[static_cast<std::size_t>(tag)];
  }
  // Of a tag's antenna, zero where the calibration tells none.
  [[nodiscard]] const model::PatternTerms& pattern_m(int tag) const noexcept {
    return patterns_m_[static_cast<std::size_t>(tag)];
  }
  [[nodiscard]] double lever_arm_variance_m2() const noexcept { return lever_arm_variance_m2_; }
  [[nodiscard]] const Eigen::Matrix4d& frame_covariance() const noexcept { return frame_covariance_; }
  [[nodiscard]] double slow_variance_m2() const noexcept { return slow_variance_m2_; }

  // As the site was told, before anything is learnt.
  [[nodiscard]] PairParameters pair(int index, int tag) const noexcept;

 private:
  std::vector<SiteAnchor> anchors_;
  std::vector<int> index_by_id_;
  std::array<model::NodeId, kMaxTags> tag_ids_{};
  std::array<Eigen::Vector3d, kMaxTags> lever_arms_m_;
  std::array<model::PatternTerms, kMaxTags> patterns_m_;
  int tag_count_ = 0;
  double lever_arm_variance_m2_;
  Eigen::Matrix4d frame_covariance_;
  double slow_variance_m2_ = 0.0;
};

}  // namespace groma::filter
