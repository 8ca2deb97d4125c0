// What is known of a site before the filter starts, and its parameters as the filter numbers them.
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

// All of the site's anchors, however many, and the robot's tags. Made once and never changed.
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

using ParameterVector = Bounded<kMaxParameters, 1>;

// Position, beta, gamma, lever arm, frame, slow error, ground.
inline constexpr int kPairParameters = 3 + 1 + 1 + 3 + kFrameSize + 1 + kGroundSize;
using PairIndices = std::array<int, kPairParameters>;

// Where each parameter stands in the vector; active anchors are numbered by slots from 0, tags as the site
// does.
class Layout {
 public:
  Layout(int anchor_count, int tag_count) : anchor_count_(anchor_count), tag_count_(tag_count) {}

  [[nodiscard]] int anchor_count() const noexcept { return anchor_count_; }  // active
  [[nodiscard]] int tag_count() const noexcept { return tag_count_; }
  [[nodiscard]] int size() const noexcept { return ground() + kGroundSize; }

  // First index of each.
  [[nodiscard]] static constexpr int frame() noexcept { return 0; }
  [[nodiscard]] static constexpr int lever_arm(int tag) noexcept { return kFrameSize + 3 * tag; }
  [[nodiscard]] int common_size() const noexcept { return lever_arm(tag_count_); }
  [[nodiscard]] int anchor_size() const noexcept { return 3 + 2 * tag_count_ + 1; }
  [[nodiscard]] int position(int slot) const noexcept { return common_size() + slot * anchor_size(); }
  [[nodiscard]] int beta(int slot, int tag) const noexcept { return position(slot) + 3 + tag; }
  [[nodiscard]] int gamma(int slot, int tag) const noexcept { return beta(slot, tag) + tag_count_; }
  [[nodiscard]] int slow_error(int slot) const noexcept { return position(slot + 1) - 1; }
  [[nodiscard]] int ground() const noexcept { return position(anchor_count_); }
  // Of what a pair's range depends on, in the order of kPairParameters.
  [[nodiscard]] PairIndices pair_indices(int slot, int tag) const noexcept;

 private:
  int anchor_count_;
  int tag_count_;
};

// The parameters with their values: those that all anchors share, and those of the active anchors.
class Parameters : public Layout {
 public:
  // The site's first `capacity` anchors are active.
  explicit Parameters(const Site& site, int capacity = kMaxAnchors);

  // The site's index of an active anchor.
  [[nodiscard]] int anchor_in(int slot) const noexcept { return active_[static_cast<std::size_t>(slot)]; }

  [[nodiscard]] const ParameterVector& values() const noexcept { return values_; }
  [[nodiscard]] ParameterVector& values() noexcept { return values_; }
  [[nodiscard]] PairParameters pair(const Site& site, int slot, int tag) const noexcept;

  // Another anchor in a slot, with these values.
  void exchange(int slot, int index, const AnchorVector& values) noexcept;

 private:
  std::array<int, kMaxAnchors> active_{};
  ParameterVector values_;
};

}  // namespace groma::filter
