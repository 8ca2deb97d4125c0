// Collects a drive with pose priors and calibrates the anchors from it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "host/daemon/measurement_sink.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

class CalibrationDrive : public MeasurementSink {
 public:
  // Three hours of 300 ranges a second; later samples are ignored.
  static constexpr std::size_t kMaxRanges = 3'240'000;
  static constexpr std::size_t kMaxPoses = 1'000'000;

  CalibrationDrive(std::vector<model::Tag> tags, model::Surface surface, model::RangePriors priors);

  void on_odometry(const model::OdometrySample& /*sample*/) override {}
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& pose) override;
  void on_clock_set() override;  // starts the drive again

  // From the first pose to the last; 0 without poses.
  [[nodiscard]] double duration_s() const noexcept;
  [[nodiscard]] std::size_t range_count() const noexcept { return ranges_.size(); }
  [[nodiscard]] std::size_t pose_count() const noexcept { return poses_.size(); }
  // Ranges of tags that are not the robot's.
  [[nodiscard]] std::size_t unknown_tags() const noexcept { return unknown_tags_; }

  // Sorts the collected samples and calibrates; takes seconds. input_sha256 is the sample_digest().
  [[nodiscard]] calibration::Result solve(const calibration::Options& options = {});

 private:
  std::vector<model::Tag> tags_;
  model::Surface surface_;
  model::RangePriors priors_;
  std::vector<model::RangeSample> ranges_;
  std::vector<model::PoseSample> poses_;
  std::size_t unknown_tags_ = 0;
};

}  // namespace groma::daemon
