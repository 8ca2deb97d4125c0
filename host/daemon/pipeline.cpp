#include "host/daemon/pipeline.hpp"

#include <fmt/format.h>

#include <map>

#include "host/filter/config.hpp"

namespace groma::daemon {
namespace {

NodeStatus node_status(const Session::Node& node) {
  const wire::FrameCounters& frames = node.decoder().frame_counters();
  NodeStatus status{.frames = frames.frames,
                    .frames_dropped = std::uint64_t{frames.crc_errors} + frames.version_errors +
                                      frames.oversize + frames.cobs_errors + frames.truncated,
                    .bytes_discarded = frames.bytes_discarded,
                    .ranges = node.decoder().counters().ranges,
                    .tag_id = node.tag_id(),
                    .slots = node.slots()};
  if (node.hello()) status.hello = &*node.hello();
  if (node.network_status()) status.network = &*node.network_status();
  return status;
}

}  // namespace

Pipeline::Pipeline(const Config& config, Log log, Localizer::OnPose on_pose, Localizer::OnPose on_settled)
    : config_(config),
      log_(std::move(log)),
      on_pose_(std::move(on_pose)),
      on_settled_(std::move(on_settled)),
      session_({.reorder_lag_s = config.reorder_lag_s, .vehicle = config.steering, .log = log_}) {
  for (const NodeLink& node : config.nodes) session_.add_node(node.path.string(), node.baud);
  node_reports_.resize(config.nodes.size());
  session_.attach(watch_);
  session_.attach(odom_);
}

void Pipeline::take(Event event) {
  if (on_event_) on_event_(event);
  std::visit([this](auto& of) { process(of); }, event);
}

// The pose first; then the filter's work on the measurements that have waited.
void Pipeline::process(const io::LinkBytes& bytes) {
  now_s_ = bytes.now_s;
  if (is_node(bytes.link)) {
    session_.node_bytes(bytes.link - 1, bytes.bytes, now_s_);
  } else if (robot_of(bytes.link) < config_.robot_links()) {
    session_.robot_bytes(bytes.bytes, now_s_, robot_of(bytes.link));
  }
  session_.advance(now_s_);
}

void Pipeline::process(const io::LinkReopened& reopened) {
  if (is_node(reopened.link)) {
    session_.node_reopened(reopened.link - 1);
  } else if (robot_of(reopened.link) < config_.robot_links()) {
    session_.robot_reopened(robot_of(reopened.link));
  }
}

void Pipeline::process(const io::LoopTick& tick) {
  now_s_ = tick.now_s;
  session_.advance(now_s_);
}

void Pipeline::process(Adoption& adoption) {
  ++adopted_;
  anchors_.clear();
  for (const model::AnchorCalibration& anchor : adoption.calibration.anchors) {
    anchors_.push_back({anchor.id, anchor.verdict});
  }
  const model::ClockError clock = adoption.calibration.range_clock.value_or(model::ClockError{});
  session_.set_range_clock(clock);
  if (adoption.calibration.range_clock) {
    log_(
        fmt::format("corrects the times of ranges by {:+.3f} s and {:+.3g} s a second (range_clock of the "
                    "calibration)",
                    -clock.offset_s, -clock.drift));
  }
  if (localizer_) return localizer_->adopt(std::move(adoption.calibration), std::move(adoption.tags));
  frame_ = adoption.calibration.frame;
  const std::size_t anchors = adoption.calibration.anchors.size();
  make_localizer(std::move(adoption.tags), std::move(adoption.calibration));
  if (adoption.start) localizer_->start_at_next_odometry(*adoption.start);
  log_(fmt::format("localizes with model {} by {} of {} calibrated anchors; searching for the pose",
                   filter::model_name(config_.model), localizer_->filter().anchors(), anchors));
}

void Pipeline::make_localizer(std::vector<model::Tag> tags, model::Calibration calibration) {
  localizer_.emplace(
      Localizer::Setup{.surface = config_.surface,
                       .tags = std::move(tags),
                       .calibration = std::move(calibration),
                       .filter = config_.filter_config(),
                       .on_range = [this](const model::RangeSample& range,
                                          const filter::RangeResult& result) { watch_.note(range, result); }},
      [this](const PoseEstimate& pose) { take_pose(pose); }, on_settled_);
  session_.attach(*localizer_);
}

void Pipeline::archive(model::StateArchive& state) {
  bool localizes = localizer_.has_value();
  state(session_, odom_, frame_, adopted_, now_s_, pose_state_, last_pose_s_, logged_implausible_,
        has_finding_, localizes);
  if (!localizes) return;
  if (!localizer_) make_localizer(config_.tags, {});
  state(*localizer_);
}

void Pipeline::take_pose(const PoseEstimate& pose) {
  const std::pair state(pose.state, pose.reason);
  const bool changed = pose_state_ != state;
  pose_state_ = state;
  last_pose_s_ = now_s_;
  PoseEstimate with_odom = pose;
  with_odom.odom = odom_.at(pose.t_s, session_);
  on_pose_(with_odom);
  if (!changed) return;
  const std::string_view reason = filter::reason_name(pose.reason);
  log_(fmt::format("state {}{}{}", filter::state_name(pose.state), reason.empty() ? "" : ": ", reason));
}

std::string_view Pipeline::state(double now_s) const {
  if (!localizer_) return "CALIBRATION_DRIVE";
  if (!localizer_->started()) return filter::state_name(localizer_->state());
  if (pose_state_ && now_s - last_pose_s_ <= kStatusPeriod_s) return filter::state_name(pose_state_->first);
  const auto fault = session_.timestamp_fault(now_s);
  const bool comes = fault && now_s - fault->last_s < kStatusPeriod_s;
  return comes ? "ODOMETRY_TIMES_WRONG" : "WAITING_FOR_ODOMETRY";
}

Status Pipeline::status(double now_s) const {
  const SessionCounters& counters = session_.counters();
  Status status;
  status.state = state(now_s);
  status.odometry = counters.odometry;
  status.ranges = counters.ranges;
  status.frames_lost = session_.frames_lost();
  status.dropped = counters.dropped_late + counters.odometry_out_of_order + counters.sensors_out_of_order +
                   counters.robot_time_wrong + counters.robot_time_early + counters.steering_unknown +
                   counters.without_odometry + session_.robot_counters().dropped() +
                   (localizer_ ? localizer_->implausible() : 0);
  if (const auto fault = session_.timestamp_fault(now_s)) {
    status.diagnosis.push_back({.cause = cause_name(fault->cause),
                                .evidence = evidence(*fault),
                                .remedy = std::string(remedy(*fault)),
                                .value = {fault->value}});
  }
  if (localizer_) {
    if (auto finding = localizer_->finding()) status.diagnosis.push_back(*std::move(finding));
  }
  for (std::size_t i = 0; i < session_.node_count(); ++i) {
    const link::ReportCounters& node = session_.node(i).decoder().counters();
    status.dropped += node.messages_malformed + node.reports_repeated + node.ranges_not_ok +
                      node.ranges_out_of_bounds + node.ranges_bad_instant;
    status.links.push_back({.link = session_.node(i).name(),
                            .round_trip_s = session_.node(i).decoder().time().round_trip_s(),
                            .node = node_status(session_.node(i))});
  }
  status.t_s = session_.robot_time_s(now_s);
  status.driven_m = watch_.driven_m();
  status.turned_rad = watch_.turned_rad();
  status.anchors = anchors_;
  status.pairs = watch_.pairs();
  return status;
}

void Pipeline::log_duplicate_tag() {
  std::map<std::uint32_t, std::size_t> node_of;
  std::optional<std::pair<std::size_t, std::size_t>> duplicate;
  for (std::size_t node = 0; node < session_.node_count(); ++node) {
    const link::ReportDecoder& decoder = session_.node(node).decoder();
    if (std::exchange(node_reports_.at(node), decoder.counters().reports) == decoder.counters().reports)
      continue;
    const auto [other, is_first] = node_of.emplace(*decoder.tag_id(), node);
    if (!is_first) duplicate = std::pair(other->second, node);
  }
  duplicate_periods_ = duplicate && duplicate == duplicate_ ? duplicate_periods_ + 1 : 0;
  duplicate_ = duplicate;
  // Two tags that swap their ports look alike for a moment.
  if (duplicate_periods_ != 2) return;
  const Session::Node& second = session_.node(duplicate->second);
  log_(fmt::format(
      "{} and {}: both report tag {}, so that its ranges count twice; remove one of them from `nodes`",
      session_.node(duplicate->first).name(), second.name(), *second.decoder().tag_id()));
}

void Pipeline::log_faults() {
  log_duplicate_tag();
  if (!localizer_) return;
  const std::uint64_t implausible = localizer_->implausible();
  if (logged_implausible_.is_due(implausible)) {
    log_(fmt::format(
        "robot: {} physically impossible samples dropped so far; check the source of its odometry, "
        "IMU, GNSS and poses",
        implausible));
  }
  // A finding once, and again only after it was gone.
  const auto finding = localizer_->finding();
  if (finding && !has_finding_)
    log_(fmt::format("{}: {}; {}", finding->cause, finding->evidence, finding->remedy));
  has_finding_ = finding.has_value();
}

}  // namespace groma::daemon
