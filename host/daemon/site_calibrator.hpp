// Calibrates the site for gromad: once, from a drive at the start (`drive_s`), or while driving (`learn`).
// The solver and the writing of files have threads of their own; the loop collects their results by
// service(), and never waits.
#pragma once

#include <functional>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <string_view>

#include "host/calibration/calibrate.hpp"
#include "host/daemon/anchor_learner.hpp"
#include "host/daemon/calibration_drive.hpp"
#include "host/daemon/calibration_writer.hpp"
#include "host/daemon/config.hpp"
#include "host/daemon/localizer.hpp"
#include "host/daemon/session.hpp"
#include "host/model/calibration.hpp"

namespace groma::daemon {

// Verdict and advice, for the log.
[[nodiscard]] std::string describe(const model::Calibration& calibration);

class SiteCalibrator {
 public:
  using Log = std::function<void(std::string_view)>;

  // Attaches what it needs to the session. `known`: of the file that the configuration names. Config and
  // session have to outlive this.
  SiteCalibrator(const Config& config, std::optional<model::Calibration> known, Session& session, Log log);

  // Starts what is due and collects what is done; returns the calibration to adopt, if there is one, first
  // that of the file. now_s never decreases.
  [[nodiscard]] std::optional<model::Calibration> service(double now_s);
  // A pose of the filter, as of Localizer's on_settled.
  void on_settled(const PoseEstimate& pose);
  // At the end: learns from the samples since the last step too, and waits for a calibration that is being
  // solved and for the file. False: as failed(). Throws as io::write_file() does if the calibration cannot be
  // written even now.
  [[nodiscard]] bool finish();

  // The drive is over, and is being solved.
  [[nodiscard]] bool solving() const noexcept { return solution_.valid(); }
  // The drive gave no usable calibration.
  [[nodiscard]] bool failed() const noexcept { return failed_; }
  // Null without `learn`.
  [[nodiscard]] const AnchorLearner* learner() const noexcept { return learner_.get(); }

 private:
  [[nodiscard]] std::optional<model::Calibration> service_drive();
  [[nodiscard]] std::optional<model::Calibration> service_learner();
  void finish_drive();
  void finish_learning();

  const Config& config_;
  Session& session_;
  Log log_;
  std::optional<model::Calibration> known_;  // until it is adopted
  std::unique_ptr<CalibrationDrive> drive_;
  std::future<calibration::Result> solution_;
  bool failed_ = false;
  std::unique_ptr<AnchorLearner> learner_;
  bool in_use_ = false;  // a calibration is
  CalibrationWriter writer_;
};

}  // namespace groma::daemon
