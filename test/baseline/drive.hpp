// What each method receives: a site as calibrated, and a drive's samples from its start on.
#pragma once

#include <cstddef>
#include <optional>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/io/dataset.hpp"
#include "host/model/anchor_parameters.hpp"
#include "host/model/calibration.hpp"
#include "host/model/pose.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::baseline {

inline constexpr double kStartSigma_m = 0.1;  // as groma replay
inline constexpr double kStartSigma_rad = 0.05;
inline constexpr double kLeverArmSigma_m = 0.01;

using PairMatrix = Eigen::Matrix<double, model::kPairSize, model::kPairSize>;

// The parameters of one pair's range, x_s,ij of the source paper, with their covariance.
struct Pair {
  std::size_t anchor = 0;  // index in Site
  std::size_t tag = 0;
  Eigen::Vector3d anchor_m;
  model::TermVector terms;
  Eigen::Vector3d lever_arm_m;
  PairMatrix covariance;  // anchor position, then the terms
  bool is_known = false;  // the calibration has this pair
};

struct SiteAnchor {
  model::NodeId id = 0;
  Eigen::VectorXd values;          // position, then the terms of each tag of the site
  Eigen::MatrixXd own_covariance;  // without the common frame's
};

class Site {
 public:
  // Takes the anchors that have a position; the calibration's lever arms replace those of `tags`.
  Site(std::span<const model::Tag> tags, const model::Calibration& calibration);

  // Null where the calibration lacks the anchor or the run the tag.
  [[nodiscard]] const Pair* find(model::NodeId tag_id, model::NodeId anchor_id) const noexcept;
  [[nodiscard]] const std::vector<SiteAnchor>& anchors() const noexcept { return anchors_; }
  [[nodiscard]] const std::vector<model::Tag>& tags() const noexcept { return tags_; }
  [[nodiscard]] const Eigen::Matrix4d& frame_covariance() const noexcept { return frame_covariance_; }

 private:
  std::vector<SiteAnchor> anchors_;
  std::vector<model::Tag> tags_;  // by id
  std::vector<Pair> pairs_;       // by anchor, then tag
  Eigen::Matrix4d frame_covariance_;
};

struct Start {
  double t_s = 0.0;
  model::PlanarPose pose;
};

struct Range {
  double t_s = 0.0;
  const Pair* pair = nullptr;
  double range_m = 0.0;
};

// A drive as the methods see it. Referenced surfaces and sites must outlive it.
struct Drive {
  const model::Surface* surface = nullptr;
  const Site* site = nullptr;
  Start start;
  std::vector<model::OdometrySample> odometry;  // from the one that is held at the start on
  std::vector<Range> ranges;                    // of known pairs, from the start on
  double odometry_interval_s = 0.02;            // median
  model::OdometryNoise odometry_noise;
  double range_sigma_m = 0.1;     // of the data set's prior
  model::RangeNoise range_noise;  // the calibration's, or the data set's prior without a slow bias
  double range_delay_s = 0.0;     // the calibration's; sigma as the filter has it
  double range_delay_sigma_s = 0.0;
  std::size_t unknown_ranges = 0;  // of anchors or pairs that the calibration lacks
};

struct DriveOptions {
  std::optional<double> from_s;
  std::optional<double> to_s;
  std::vector<model::NodeId> tags;     // empty: all
  std::vector<model::NodeId> anchors;  // empty: all
};

// None if there is no pose prior to start from, or no odometry, in the chosen time.
[[nodiscard]] std::optional<Drive> make_drive(const io::Dataset& dataset, const model::Surface& surface,
                                              const Site& site, const model::Calibration& calibration,
                                              const DriveOptions& options);

}  // namespace groma::baseline
