// The site as calibrated, and the layout of its parameters (x_s of the source paper, equation (9)).
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

// Parameters of the range of one tag and one anchor, x_s,ij of equation (11), and those that the paper lacks.
struct PairParameters {
  Eigen::Vector3d position_m;  // of the anchor, without the error of the common frame
  model::TermVector terms;
  double range_bias_m = 0.0;
  Eigen::Vector3d lever_arm_m;
  Eigen::Vector4d frame = Eigen::Vector4d::Zero();
  model::PatternTerms pattern_m = model::PatternTerms::Zero();
  Eigen::Vector3d ground = Eigen::Vector3d::Zero();  // deviation from the surface: height (m), dS/dx, dS/dy
};
// Those of the original model's pure distance, equation (4): neutral terms, no slow range bias, no pattern.
[[nodiscard]] PairParameters without_biases(PairParameters pair) noexcept;

struct SiteAnchor {
  model::NodeId id = 0;
  bool is_estimated = false;  // verdict kOk; other anchors may have more than one solution and are considered
  std::array<bool, kMaxTags> knows_tag{};
  AnchorVector values;
  // Without the common frame's contribution. Last the slow range bias, uncorrelated.
  AnchorMatrix covariance;
};

// All anchors of the site and the tags of the robot.
struct Site {
  // Takes the first kMaxTags tags, and the anchors that have a finite position and a finite covariance of the
  // right size. The calibration's lever arms, if given, replace those of `tags`.
  Site(std::span<const model::Tag> tags, const model::Calibration& calibration, double lever_arm_sigma_m);

  [[nodiscard]] int anchor_count() const noexcept { return static_cast<int>(anchors.size()); }
  [[nodiscard]] int anchor_size() const noexcept { return model::anchor_size(tag_count) + 1; }

  // Index of an id; -1 if unknown.
  [[nodiscard]] int anchor_index(model::NodeId id) const noexcept {
    return id < index_by_id.size() ? index_by_id[id] : -1;
  }
  [[nodiscard]] int tag_slot(model::NodeId id) const noexcept;

  [[nodiscard]] const SiteAnchor& anchor(int index) const noexcept {
    return anchors[static_cast<std::size_t>(index)];
  }
  // Whether the calibration has this pair.
  [[nodiscard]] bool knows_pair(int index, int tag) const noexcept {
    return anchor(index).knows_tag[static_cast<std::size_t>(tag)];
  }
  // The parameters as calibrated.
  [[nodiscard]] PairParameters pair(int index, int tag) const noexcept;

  std::vector<SiteAnchor> anchors;
  std::vector<int> index_by_id;
  int tag_count = 0;
  std::array<model::NodeId, kMaxTags> tag_ids{};
  std::array<Eigen::Vector3d, kMaxTags> lever_arms_m;
  std::array<model::PatternTerms, kMaxTags> patterns_m;  // zero: the calibration has none
  double lever_arm_variance_m2;
  Eigen::Matrix4d frame_covariance;
  double range_bias_variance_m2 = 0.0;
};

using ParameterVector = Bounded<kMaxParameters, 1>;

// Parameters of a pair's range: position and terms, then the groups that begin at these indices.
inline constexpr int kOfLeverArm = model::kPairSize;
inline constexpr int kOfFrame = kOfLeverArm + 3;
inline constexpr int kOfRangeBias = kOfFrame + kFrameSize;
inline constexpr int kOfGround = kOfRangeBias + 1;
inline constexpr int kPairParameters = kOfGround + kGroundSize;
using PairIndices = std::array<int, kPairParameters>;

// Index of each parameter in the parameter vector. Active anchors are numbered by slot from 0, tags as in
// Site.
class Layout {
 public:
  Layout(int anchor_count, int tag_count) : anchor_count_(anchor_count), tag_count_(tag_count) {}

  [[nodiscard]] int anchor_count() const noexcept { return anchor_count_; }  // active
  [[nodiscard]] int tag_count() const noexcept { return tag_count_; }
  [[nodiscard]] int size() const noexcept { return ground() + kGroundSize; }

  // First index of each group.
  [[nodiscard]] static constexpr int frame() noexcept { return 0; }
  [[nodiscard]] static constexpr int lever_arm(int tag) noexcept { return kFrameSize + 3 * tag; }
  [[nodiscard]] int common_size() const noexcept { return lever_arm(tag_count_); }
  [[nodiscard]] int anchor_size() const noexcept { return model::anchor_size(tag_count_) + 1; }
  [[nodiscard]] int position(int slot) const noexcept { return common_size() + slot * anchor_size(); }
  [[nodiscard]] int range_bias(int slot) const noexcept { return position(slot + 1) - 1; }
  [[nodiscard]] int ground() const noexcept { return position(anchor_count_); }
  // Indices of the parameters of a pair's range, in the order of kPairParameters.
  [[nodiscard]] PairIndices pair_indices(int slot, int tag) const noexcept;

 private:
  int anchor_count_;
  int tag_count_;
};

// The parameters' values: the common ones and those of the active anchors.
class Parameters : public Layout {
 public:
  // Activates the site's first `capacity` anchors.
  explicit Parameters(const Site& site, int capacity = kMaxAnchors);

  // Index in Site of the anchor in a slot.
  [[nodiscard]] int anchor_in(int slot) const noexcept { return active_[static_cast<std::size_t>(slot)]; }
  // Slot of an anchor of the site; -1 if it is not active.
  [[nodiscard]] int slot_of(int index) const noexcept;

  [[nodiscard]] const ParameterVector& values() const noexcept { return values_; }
  [[nodiscard]] ParameterVector& values() noexcept { return values_; }
  [[nodiscard]] PairParameters pair(const Site& site, int slot, int tag) const noexcept;

  // Replaces the anchor in a slot.
  void exchange(int slot, int index, const AnchorVector& values) noexcept;

 private:
  std::array<int, kMaxAnchors> active_{};
  ParameterVector values_;
};

}  // namespace groma::filter
