// The parameters as the filter numbers them, with their values: those that all anchors share, and those of
// the anchors that are active.
#pragma once

#include <array>
#include <cstddef>

#include <Eigen/Core>

#include "host/filter/site.hpp"
#include "host/filter/state.hpp"

namespace groma::filter {

using ParameterVector = Eigen::Matrix<double, Eigen::Dynamic, 1, Eigen::ColMajor, kMaxParameters, 1>;

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
