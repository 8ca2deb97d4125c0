#include "host/filter/parameters.hpp"

#include <algorithm>

namespace groma::filter {

Parameters::Parameters(const Site& site, int capacity)
    : Layout(std::min({site.anchor_count(), capacity, kMaxAnchors}), site.tag_count()) {
  values_.setZero(size());
  for (int tag = 0; tag < tag_count(); ++tag) values_.segment<3>(lever_arm(tag)) = site.lever_arm_m(tag);
  for (int slot = 0; slot < anchor_count(); ++slot) exchange(slot, slot, site.anchor(slot).values);
}

PairIndices Layout::pair_indices(int slot, int tag) const noexcept {
  const int p = position(slot);
  const int l = lever_arm(tag);
  const int f = frame();
  const int g = ground();
  return {p, p + 1, p + 2, beta(slot, tag), gamma(slot, tag), l, l + 1, l + 2,
          f, f + 1, f + 2, f + 3,           slow_error(slot), g, g + 1, g + 2};
}

PairParameters Parameters::pair(const Site& site, int slot, int tag) const noexcept {
  return {.position_m = values_.segment<3>(position(slot)),
          .beta_m = values_(beta(slot, tag)),
          .gamma = values_(gamma(slot, tag)),
          .slow_error_m = values_(slow_error(slot)),
          .lever_arm_m = values_.segment<3>(lever_arm(tag)),
          .frame = values_.segment<kFrameSize>(frame()),
          .pattern_m = site.pattern_m(tag),
          .ground = values_.segment<kGroundSize>(ground())};
}

void Parameters::exchange(int slot, int index, const AnchorVector& values) noexcept {
  active_[static_cast<std::size_t>(slot)] = index;
  values_.segment(position(slot), anchor_size()) = values;
}

}  // namespace groma::filter
