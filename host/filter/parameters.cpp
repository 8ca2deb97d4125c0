#include "host/filter/parameters.hpp"

#include <cstddef>

namespace groma::filter {

Parameters::Parameters(std::span<const model::Tag> tags, const model::Calibration& calibration) {
  for (const model::Tag& tag : tags) {
    if (tag_count_ == kMaxTags) break;
    tag_ids_[static_cast<std::size_t>(tag_count_++)] = tag.id;
  }
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (anchor_count_ == kMaxAnchors) break;
    if (model::has_position(anchor)) anchor_ids_[static_cast<std::size_t>(anchor_count_++)] = anchor.id;
  }

  values_.setZero(size());
  for (int tag = 0; tag < tag_count_; ++tag) {
    values_.segment<3>(lever_arm(tag)) = tags[static_cast<std::size_t>(tag)].lever_arm_m;
  }
  patterns_m_.fill(model::PatternTerms::Zero());
  for (const model::TagCalibration& told : calibration.tags) {
    const int tag = tag_slot(told.id);
    if (tag < 0) continue;
    if (told.lever_arm) values_.segment<3>(lever_arm(tag)) = told.lever_arm->position_m;
    if (told.pattern_m) patterns_m_[static_cast<std::size_t>(tag)] = *told.pattern_m;
  }
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    const int slot = anchor_slot(anchor.id);
    if (slot < 0 || !model::has_position(anchor)) continue;
    values_.segment<3>(position(slot)) = anchor.position_m;
    for (const model::PairBias& pair : anchor.pairs) {
      const int tag = tag_slot(pair.tag_id);
      if (tag < 0) continue;
      values_(beta(slot, tag)) = pair.beta_m;
      values_(gamma(slot, tag)) = pair.gamma;
      known_pairs_[static_cast<std::size_t>(slot)][static_cast<std::size_t>(tag)] = true;
    }
  }
}

int Parameters::anchor_slot(model::NodeId id) const noexcept {
  for (int slot = 0; slot < anchor_count_; ++slot) {
    if (anchor_ids_[static_cast<std::size_t>(slot)] == id) return slot;
  }
  return -1;
}

int Parameters::tag_slot(model::NodeId id) const noexcept {
  for (int slot = 0; slot < tag_count_; ++slot) {
    if (tag_ids_[static_cast<std::size_t>(slot)] == id) return slot;
  }
  return -1;
}

bool Parameters::knows_pair(int anchor, int tag) const noexcept {
  return known_pairs_[static_cast<std::size_t>(anchor)][static_cast<std::size_t>(tag)];
}

ParameterMatrix Parameters::prior_covariance(const model::Calibration& calibration,
                                             double lever_arm_sigma_m) const {
  ParameterMatrix covariance = ParameterMatrix::Zero(size(), size());
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    const int slot = anchor_slot(anchor.id);
    if (slot < 0 || !model::has_position(anchor)) continue;
    // Where each row of the calibration's block goes, -1 for tags that are not ours.
    const auto target = [&](Eigen::Index row) {
      if (row < 3) return position(slot) + static_cast<int>(row);
      const auto pairs = static_cast<Eigen::Index>(anchor.pairs.size());
      const int tag = tag_slot(anchor.pairs[static_cast<std::size_t>((row - 3) % pairs)].tag_id);
      if (tag < 0) return -1;
      return row - 3 < pairs ? beta(slot, tag) : gamma(slot, tag);
    };
    for (Eigen::Index i = 0; i < anchor.covariance.rows(); ++i) {
      for (Eigen::Index j = 0; j < anchor.covariance.cols(); ++j) {
        const int row = target(i);
        const int column = target(j);
        if (row >= 0 && column >= 0) covariance(row, column) = anchor.covariance(i, j);
      }
    }
  }
  for (int tag = 0; tag < tag_count_; ++tag) {
    covariance.block<3, 3>(lever_arm(tag), lever_arm(tag))
        .diagonal()
        .setConstant(lever_arm_sigma_m * lever_arm_sigma_m);
  }
  if (calibration.range_noise) {
    const double sigma_m = calibration.range_noise->slow_sigma_m;
    covariance.diagonal().tail(anchor_count_).setConstant(sigma_m * sigma_m);
  }
  covariance.block<kFrameSize, kFrameSize>(frame(), frame()) = calibration.common_frame_covariance;
  return covariance;
}

}  // namespace groma::filter
