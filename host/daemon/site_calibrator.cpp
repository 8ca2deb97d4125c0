#include "host/daemon/site_calibrator.hpp"

#include <fmt/format.h>

#include <chrono>
#include <utility>

#include "host/io/calibration_file.hpp"

namespace groma::daemon {
namespace {

constexpr std::size_t kMinAnchors = 3;  // to start localization
constexpr double kGoodPose_m = 0.3;     // maximum sigma of a pose used to calibrate anchors

template <typename Result>
bool is_done(const std::future<Result>& result) {
  return result.wait_for(std::chrono::seconds(0)) == std::future_status::ready;
}

}  // namespace

std::string describe(const model::Calibration& calibration) {
  std::string text =
      fmt::format("verdict {}, {} anchors", io::word(calibration.verdict), calibration.anchors.size());
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!anchor.advice.empty()) text += fmt::format("; anchor {}: {}", anchor.id, anchor.advice);
  }
  return text;
}

SiteCalibrator::SiteCalibrator(const Config& config, std::optional<model::Calibration> known,
                               Session& session, Log log)
    : config_(config),
      session_(session),
      log_(std::move(log)),
      known_(std::move(known)),
      writer_(config.calibration.output, log_) {
  const model::Calibration earlier = known_.value_or(model::Calibration{});
  // Without anchors there is nothing to localize by.
  if (config.calibration.learn && earlier.anchors.empty()) known_.reset();
  in_use_ = known_.has_value();
  if (config.calibration.learn) {
    learner_ = std::make_unique<AnchorLearner>(AnchorLearner::Setup{
        .tags = config.tags,
        .surface = config.surface,
        .priors = config.range,
        .earlier = earlier,
        .poses = in_use_ ? AnchorLearner::Poses::kFilter : AnchorLearner::Poses::kPriors});
    session_.attach(*learner_);
    log_(fmt::format("calibrates anchors while driving, from {}",
                     in_use_ ? "the filter's poses" : "the pose priors"));
  } else if (!known_) {
    drive_ = std::make_unique<CalibrationDrive>(config.tags, config.surface, config.range);
    session_.attach(*drive_);
    log_(fmt::format("calibrates from the first {} s with pose priors", config.calibration.drive_s));
  }
}

std::optional<model::Calibration> SiteCalibrator::service(double now_s) {
  writer_.service(now_s);
  if (known_) return std::exchange(known_, std::nullopt);
  if (drive_) return service_drive();
  if (learner_) return service_learner();
  return std::nullopt;
}

std::optional<model::Calibration> SiteCalibrator::service_drive() {
  if (!solution_.valid()) {
    if (drive_->duration_s() < config_.calibration.drive_s) return std::nullopt;
    session_.detach(*drive_);
    log_(fmt::format("solves the calibration from {} ranges and {} poses", drive_->range_count(),
                     drive_->pose_count()));
    solution_ = std::async(std::launch::async, [drive = drive_.get()] { return drive->solve(); });
    return std::nullopt;
  }
  if (!is_done(solution_)) return std::nullopt;
  model::Calibration calibration = solution_.get().calibration;
  drive_.reset();
  log_("calibration: " + describe(calibration));
  failed_ = calibration.verdict == model::Verdict::kUnusable;
  if (failed_) return std::nullopt;
  writer_.put(calibration);
  return calibration;
}

std::optional<model::Calibration> SiteCalibrator::service_learner() {
  const bool changed = learner_->service();
  for (const std::string& news : learner_->take_news()) log_(news);
  if (changed) writer_.put(learner_->live());
  if (!changed || !(in_use_ || learner_->live().anchors.size() >= kMinAnchors)) return std::nullopt;
  in_use_ = true;
  return learner_->live();
}

void SiteCalibrator::on_settled(const PoseEstimate& pose) {
  if (!learner_ || pose.state != filter::State::kTracking) return;
  const Eigen::Matrix3d& covariance = pose.planar_covariance;
  if (!(covariance(0, 0) + covariance(1, 1) < kGoodPose_m * kGoodPose_m)) return;
  learner_->on_filter_pose(
      {.t_s = pose.t_s, .x_m = pose.x_m, .y_m = pose.y_m, .z_m = pose.z_m, .yaw_rad = pose.yaw_rad});
}

bool SiteCalibrator::finish() {
  if (learner_) finish_learning();
  if (drive_) finish_drive();
  writer_.finish();
  return !failed_;
}

void SiteCalibrator::finish_drive() {
  if (!solution_.valid()) {
    log_(fmt::format("the calibration drive has ended after {:.0f} of {} s; nothing is calibrated",
                     drive_->duration_s(), config_.calibration.drive_s));
    return;
  }
  log_("waits for the calibration that is being solved");
  solution_.wait();
  static_cast<void>(service_drive());
}

void SiteCalibrator::finish_learning() {
  if (learner_->finish()) writer_.put(learner_->live());
  for (const std::string& news : learner_->take_news()) log_(news);
}

}  // namespace groma::daemon
