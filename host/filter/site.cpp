#include "host/filter/site.hpp"

#include <algorithm>

#include "host/model/ablation.hpp"

namespace groma::filter {

Site::Site(std::span<const model::Tag> tags, const model::Calibration& calibration, double lever_arm_sigma_m)
    : lever_arm_variance_m2(model::square(lever_arm_sigma_m)),
      frame_covariance(model::is_ablated(model::Mechanism::kCommonFrame)
                           ? Eigen::Matrix4d::Zero()
                           : calibration.common_frame_covariance) {
  lever_arms_m.fill(Eigen::Vector3d::Zero());
  patterns_m.fill(model::PatternTerms::Zero());
  for (const model::Tag& tag : tags) {
    if (tag_count == kMaxTags) break;
    const auto slot = static_cast<std::size_t>(tag_count++);
    tag_ids[slot] = tag.id;
    lever_arms_m[slot] = tag.lever_arm_m;
  }
  for (const model::TagCalibration& calibrated : calibration.tags) {
    const int tag = tag_slot(calibrated.id);
    if (tag < 0) continue;
    if (calibrated.lever_arm) lever_arms_m[static_cast<std::size_t>(tag)] = calibrated.lever_arm->position_m;
    if (calibrated.pattern_m && !model::is_ablated(model::Mechanism::kAntennaPattern))
      patterns_m[static_cast<std::size_t>(tag)] = *calibrated.pattern_m;
  }
  if (calibration.range_noise) range_bias_variance_m2 = model::square(calibration.range_noise->bias_sigma_m);

  const int size = anchor_size();
  for (const model::AnchorCalibration& calibrated : calibration.anchors) {
    if (!model::has_position(calibrated)) continue;
    SiteAnchor anchor;
    anchor.id = calibrated.id;
    anchor.is_estimated = calibrated.verdict == model::AnchorVerdict::kOk;
    anchor.values.setZero(size);
    anchor.covariance.setZero(size, size);
    const Eigen::MatrixXd to =
        model::selection(std::span(tag_ids).first(static_cast<std::size_t>(tag_count)), calibrated);
    anchor.values.head(size - 1) = to * model::values_of(calibrated);
    // The common frame's error is a parameter of its own.
    anchor.covariance.topLeftCorner(size - 1, size - 1) =
        to * model::own_covariance(calibrated, frame_covariance) * to.transpose();
    anchor.covariance(size - 1, size - 1) = range_bias_variance_m2;
    for (const model::PairBias& pair : calibrated.pairs) {
      const int tag = tag_slot(pair.tag_id);
      if (tag >= 0) anchor.knows_tag[static_cast<std::size_t>(tag)] = true;
    }
    if (calibrated.id >= index_by_id.size()) index_by_id.resize(calibrated.id + std::size_t{1}, -1);
    index_by_id[calibrated.id] = anchor_count();
    anchors.push_back(anchor);
  }
}

int Site::tag_slot(model::NodeId id) const noexcept {
  for (int slot = 0; slot < tag_count; ++slot) {
    if (tag_ids[static_cast<std::size_t>(slot)] == id) return slot;
  }
  return -1;
}

PairParameters Site::pair(int index, int tag) const noexcept {
  const AnchorVector& values = anchor(index).values;
  return {.position_m = values.head<3>(),
          .terms = model::terms_of(values, tag, tag_count),
          .lever_arm_m = lever_arms_m[static_cast<std::size_t>(tag)],
          .pattern_m = patterns_m[static_cast<std::size_t>(tag)]};
}

PairParameters without_biases(PairParameters pair) noexcept {
  pair.terms = model::each_term([](const model::PairTerm& term) { return term.neutral; });
  pair.range_bias_m = 0.0;
  pair.pattern_m.setZero();
  return pair;
}

Parameters::Parameters(const Site& site, int capacity)
    : Layout(std::min({site.anchor_count(), capacity, kMaxAnchors}), site.tag_count) {
  values_.setZero(size());
  for (int tag = 0; tag < tag_count(); ++tag)
    values_.segment<3>(lever_arm(tag)) = site.lever_arms_m[static_cast<std::size_t>(tag)];
  for (int slot = 0; slot < anchor_count(); ++slot) exchange(slot, slot, site.anchor(slot).values);
}

PairIndices Layout::pair_indices(int slot, int tag) const noexcept {
  PairIndices out;
  auto* to = out.begin();
  for (const int index : model::pair_indices(tag, tag_count_)) *to++ = position(slot) + index;
  for (int i = 0; i < 3; ++i) *to++ = lever_arm(tag) + i;
  for (int i = 0; i < kFrameSize; ++i) *to++ = frame() + i;
  *to++ = range_bias(slot);
  for (int i = 0; i < kGroundSize; ++i) *to++ = ground() + i;
  return out;
}

PairParameters Parameters::pair(const Site& site, int slot, int tag) const noexcept {
  return {.position_m = values_.segment<3>(position(slot)),
          .terms = model::terms_of(values_.segment(position(slot), anchor_size()), tag, tag_count()),
          .range_bias_m = values_(range_bias(slot)),
          .lever_arm_m = values_.segment<3>(lever_arm(tag)),
          .frame = values_.segment<kFrameSize>(frame()),
          .pattern_m = site.patterns_m[static_cast<std::size_t>(tag)],
          .ground = values_.segment<kGroundSize>(ground())};
}

int Parameters::slot_of(int index) const noexcept {
  const auto end = active_.begin() + anchor_count();
  const auto found = std::find(active_.begin(), end, index);
  return found == end ? -1 : static_cast<int>(found - active_.begin());
}

void Parameters::exchange(int slot, int index, const AnchorVector& values) noexcept {
  active_[static_cast<std::size_t>(slot)] = index;
  values_.segment(position(slot), anchor_size()) = values;
}

}  // namespace groma::filter
