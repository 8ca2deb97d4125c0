#include "host/daemon/daemon.hpp"

#include <fmt/format.h>
#include <pb_encode.h>
#include <poll.h>

#include <array>
#include <bit>
#include <cerrno>
#include <chrono>
#include <filesystem>
#include <system_error>
#include <utility>

#include "groma.pb.h"
#include "host/filter/config.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/error.hpp"
#include "host/io/output_file.hpp"
#include "proto/frame_codec.hpp"

namespace groma::daemon {
namespace {

constexpr int kPollTimeout_ms = 10;  // maximum extra wait of a measurement beyond reorder_lag_s
constexpr double kStatusPeriod_s = 1.0;
constexpr double kTimeRequestPeriod_s = 1.0;  // to each node
constexpr std::size_t kMinAnchors = 3;        // to start localization
constexpr double kGoodPose_m = 0.3;           // maximum sigma of a pose used to calibrate anchors
constexpr std::size_t kReadsPerTurn = 16;     // of one link, so that no link delays the others

link::OpenedLink open_input(const std::string& path, unsigned baud) {
  std::error_code ignored;  // open_link() explains such errors
  if (std::filesystem::is_regular_file(path, ignored)) {
    return {nullptr,
            {link::LinkFault::kUnsuitable, fmt::format("{}: a file is not a live link; name a serial port, a "
                                                       "pseudo-terminal, a node on a CAN bus or a socket",
                                                       path)}};
  }
  return link::open_link(path, baud);
}

// A frame that requests a node's Hello.
std::vector<std::uint8_t> hello_request() {
  groma_HostToNode message = groma_HostToNode_init_zero;
  message.request_id = 1;
  message.which_body = groma_HostToNode_get_hello_tag;
  std::array<std::uint8_t, groma_HostToNode_size> payload{};
  pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
  if (!pb_encode(&stream, groma_HostToNode_fields, &message)) return {};
  const auto content = std::span(payload).first(stream.bytes_written);
  std::vector<std::uint8_t> frame(wire::max_encoded_size(content.size()));
  frame.resize(wire::encode_frame(content, frame));
  return frame;
}

std::string describe(const model::Calibration& calibration) {
  std::string text =
      fmt::format("verdict {}, {} anchors", io::word(calibration.verdict), calibration.anchors.size());
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!anchor.advice.empty()) text += fmt::format("; anchor {}: {}", anchor.id, anchor.advice);
  }
  return text;
}

}  // namespace

Daemon::Daemon(Config config, std::optional<model::Calibration> calibration, Log log)
    : config_(std::move(config)),
      log_(std::move(log)),
      calibration_(std::move(calibration)),
      session_({.reorder_lag_s = config_.reorder_lag_s, .log = log_}) {
  for (const NodeLink& node : config_.nodes) {
    const std::string path = node.path.string();
    inputs_.push_back(
        {.name = path,
         .link = link::ReconnectingLink([path, baud = node.baud] { return open_input(path, baud); }),
         .is_robot = false,
         .node = session_.add_node(path, node.baud),
         .logged_error = {}});
  }
  const std::string path = config_.robot_socket.string();
  inputs_.push_back({.name = path,
                     .link = link::ReconnectingLink([path] { return open_input(path, 0); }),
                     .is_robot = true,
                     .node = 0,
                     .logged_error = {}});
}

Daemon::~Daemon() = default;

link::LinkError Daemon::open() {
  PoseServer::Opened opened = PoseServer::open(config_.address, config_.port, version_line());
  if (!opened.server) return opened.error;
  server_ = std::move(opened.server);
  log_(fmt::format("pose stream on {} port {}", config_.address, server_->port()));
  for (Input& input : inputs_) {
    if (!input.link.service(now_s())) return input.link.last_error();
    this->opened(input);
  }
  if (config_.log) {
    recorder_ = std::make_unique<LogRecorder>(*config_.log, config_.description());
    session_.attach(*recorder_);
    log_(fmt::format("recording into {}", config_.log->string()));
  }
  return {};
}

bool Daemon::run(int stop_fd) {
  if (config_.calibration.learn) {
    const bool known = calibration_.has_value() && !calibration_->anchors.empty();
    learner_ = std::make_unique<AnchorLearner>(
        AnchorLearner::Setup{.tags = config_.tags,
                             .surface = config_.surface,
                             .priors = config_.range,
                             .earlier = calibration_.value_or(model::Calibration{}),
                             .poses = known ? AnchorLearner::Poses::kFilter : AnchorLearner::Poses::kPriors});
    session_.attach(*learner_);
    log_(fmt::format("calibrates anchors while driving, from {}",
                     known ? "the filter's poses" : "the pose priors"));
    if (!known) calibration_.reset();
  }
  if (calibration_) {
    localize(*std::exchange(calibration_, std::nullopt));
  } else if (!learner_) {
    drive_ = std::make_unique<CalibrationDrive>(config_.tags, config_.surface, config_.range);
    session_.attach(*drive_);
    log_(fmt::format("calibrates from the first {} s with pose priors", config_.calibration.drive_s));
  }
  bool stop = false;
  while (!stop) {
    wait(stop_fd, stop);
    for (Input& input : inputs_) service(input);
    request_times();
    session_.advance(now_s());
    record();
    if (drive_ && !calibrate()) return false;
    if (learner_) learn();
    publish_status();
    server_->service();
  }
  finish_learning();
  return true;
}

double Daemon::now_s() const {
  const std::chrono::duration<double> since_start = std::chrono::steady_clock::now().time_since_epoch();
  return config_.speed * since_start.count();
}

void Daemon::wait(int stop_fd, bool& stop) {
  std::vector<pollfd> entries{{stop_fd, POLLIN, 0}};
  for (const Input& input : inputs_) {
    if (input.link.get() != nullptr) entries.push_back({input.link.get()->poll_fd(), POLLIN, 0});
  }
  server_->append_poll(entries);
  if (::poll(entries.data(), entries.size(), kPollTimeout_ms) > 0) {
    stop = (entries.front().revents & POLLIN) != 0;
  }
}

void Daemon::service(Input& input) {
  if (input.link.service(now_s())) {
    log_(fmt::format("{}: reopened", input.name));
    if (input.is_robot) {
      session_.robot_reopened();
    } else {
      session_.node_reopened(input.node);
    }
    opened(input);
  }
  if (input.link.get() != nullptr) {
    read(input);
    log_news(input);
  } else if (input.logged_error != input.link.last_error().message) {
    input.logged_error = input.link.last_error().message;
    if (!input.logged_error.empty()) log_(input.logged_error);
  }
}

void Daemon::read(Input& input) {
  std::array<std::uint8_t, 4096> buffer{};
  for (std::size_t i = 0; i < kReadsPerTurn; ++i) {
    const link::ReadResult result = input.link.read(buffer, now_s());
    if (result.gone) {
      log_(fmt::format("{}: the link is lost; it will be reopened as soon as possible", input.name));
      return;
    }
    if (result.bytes == 0) return;
    const auto bytes = std::span(buffer).first(result.bytes);
    if (input.is_robot) {
      session_.robot_bytes(bytes, now_s());
    } else {
      session_.node_bytes(input.node, bytes, now_s());
    }
  }
}

void Daemon::log_news(Input& input) {
  if (input.link.get() == nullptr) return;
  if (const std::string news = input.link.get()->take_news(); !news.empty()) log_(news);
}

void Daemon::opened(Input& input) {
  input.logged_error.clear();
  // Do not wait for the answer.
  if (!input.is_robot) static_cast<void>(input.link.get()->write(hello_request()));
}

// The answers give the delay of each node's link. A request that fails is repeated in the next period.
void Daemon::request_times() {
  if (now_s() < next_time_request_s_) return;
  next_time_request_s_ = now_s() + kTimeRequestPeriod_s;
  for (Input& input : inputs_) {
    if (input.is_robot || input.link.get() == nullptr) continue;
    static_cast<void>(input.link.get()->write(link::time_request(now_s())));
  }
}

bool Daemon::calibrate() {
  if (!solution_.valid()) {
    if (drive_->duration_s() < config_.calibration.drive_s) return true;
    session_.detach(*drive_);
    log_(fmt::format("solves the calibration from {} ranges and {} poses", drive_->range_count(),
                     drive_->pose_count()));
    solution_ = std::async(std::launch::async, [this] { return drive_->solve(); });
    return true;
  }
  if (solution_.wait_for(std::chrono::seconds(0)) != std::future_status::ready) return true;
  model::Calibration calibration = solution_.get().calibration;
  drive_.reset();
  log_("calibration: " + describe(calibration));
  if (calibration.verdict == model::Verdict::kUnusable) return false;
  if (config_.calibration.output) {
    io::write_file(*config_.calibration.output, io::format_calibration(calibration));
    log_(fmt::format("calibration written to {}", config_.calibration.output->string()));
  }
  localize(std::move(calibration));
  return true;
}

void Daemon::localize(model::Calibration calibration) {
  frame_ = calibration.frame;
  const std::size_t anchors = calibration.anchors.size();
  localizer_ = std::make_unique<Localizer>(
      Localizer::Setup{.surface = config_.surface,
                       .tags = config_.tags,
                       .calibration = std::move(calibration),
                       .filter = config_.filter_config()},
      [this](const PoseEstimate& pose) { publish(pose); },
      [this](const PoseEstimate& pose) { learn_from(pose); });
  session_.attach(*localizer_);
  log_(fmt::format("localizes with model {} by {} of {} calibrated anchors; searching for the pose",
                   filter::model_name(config_.model), localizer_->filter().anchors(), anchors));
}

void Daemon::learn() {
  if (learner_->service()) use_calibrated();
  for (const std::string& news : learner_->take_news()) log_(news);
  write_calibrated();
}

void Daemon::use_calibrated() {
  to_write_ = config_.calibration.output.has_value();
  if (localizer_) {
    localizer_->adopt(learner_->live());
  } else if (learner_->live().anchors.size() >= kMinAnchors) {
    localize(learner_->live());
  }
}

// Writes one file at a time, in a thread that may wait for the disk.
void Daemon::write_calibrated() {
  if (writing_.valid()) {
    if (writing_.wait_for(std::chrono::seconds(0)) != std::future_status::ready) return;
    if (const std::string error = writing_.get(); !error.empty()) log_(error);
  }
  if (!std::exchange(to_write_, false)) return;
  writing_ = std::async(std::launch::async, [path = *config_.calibration.output,
                                             text = io::format_calibration(learner_->live())] {
    try {
      io::write_file(path, text);
    } catch (const io::Error& error) {
      return std::string(error.what());
    }
    return std::string();
  });
}

// Uses the samples since the last step too.
void Daemon::finish_learning() {
  if (!learner_) return;
  to_write_ = learner_->finish() || to_write_;
  to_write_ = to_write_ && config_.calibration.output.has_value();
  for (const std::string& news : learner_->take_news()) log_(news);
  if (writing_.valid()) writing_.wait();
  write_calibrated();
  if (writing_.valid()) writing_.wait();
  write_calibrated();
}

void Daemon::learn_from(const PoseEstimate& settled) {
  if (!learner_ || settled.state != filter::State::kTracking) return;
  const Eigen::Matrix3d& covariance = settled.planar_covariance;
  if (!(covariance(0, 0) + covariance(1, 1) < kGoodPose_m * kGoodPose_m)) return;
  learner_->on_filter_pose({.t_s = settled.t_s,
                            .x_m = settled.x_m,
                            .y_m = settled.y_m,
                            .z_m = settled.z_m,
                            .yaw_rad = settled.yaw_rad});
}

void Daemon::publish(const PoseEstimate& pose) {
  const std::pair state(pose.state, pose.reason);
  if (pose_state_ != state) {
    const std::string_view reason = filter::reason_name(pose.reason);
    log_(fmt::format("state {}{}{}", filter::state_name(pose.state), reason.empty() ? "" : ": ", reason));
  }
  pose_state_ = state;
  last_pose_s_ = now_s();
  server_->broadcast(pose_line(pose, frame_, filter::model_name(config_.model)));
}

void Daemon::record() {
  if (!recorder_) return;
  recorder_->advance(now_s());
  if (const auto failure = recorder_->take_failure()) {
    log_(*failure);
    session_.detach(*recorder_);
    recorder_.reset();
  }
}

void Daemon::publish_status() {
  if (now_s() < next_status_s_) return;
  next_status_s_ = now_s() + kStatusPeriod_s;
  report_implausible();
  report_finding();
  server_->broadcast(status_line(status()));
  if (learner_) server_->broadcast(calibration_line(learner_->live().verdict, learner_->progress()));
}

// Logs a finding once, and again only after it was gone.
void Daemon::report_finding() {
  const auto finding = localizer_ ? localizer_->finding() : std::nullopt;
  if (finding && !has_finding_)
    log_(fmt::format("{}: {}; {}", finding->cause, finding->evidence, finding->remedy));
  has_finding_ = finding.has_value();
}

// Logs at the 1st, 2nd, 4th, 8th ... sample, so that a persistent fault does not fill the log.
void Daemon::report_implausible() {
  if (!localizer_) return;
  const std::uint64_t implausible = localizer_->implausible();
  if (std::bit_width(implausible) != std::bit_width(reported_implausible_)) {
    log_(fmt::format(
        "robot: {} physically impossible samples dropped so far; check the source of its odometry, "
        "IMU, GNSS and poses",
        implausible));
  }
  reported_implausible_ = implausible;
}

std::string_view Daemon::state() const {
  if (solution_.valid()) return "CALIBRATING";
  if (!localizer_) return "CALIBRATION_DRIVE";
  if (!localizer_->started()) return filter::state_name(localizer_->state());
  if (!pose_state_ || now_s() - last_pose_s_ > kStatusPeriod_s) {
    const auto fault = session_.timestamp_fault(now_s());
    const bool comes = fault && now_s() - fault->last_s < kStatusPeriod_s;
    return comes ? "ODOMETRY_TIMES_WRONG" : "WAITING_FOR_ODOMETRY";
  }
  return filter::state_name(pose_state_->first);
}

Status Daemon::status() const {
  const SessionCounters& counters = session_.counters();
  Status status;
  status.state = state();
  status.odometry = counters.odometry;
  status.ranges = counters.ranges;
  status.frames_lost = session_.frames_lost();
  status.dropped = counters.dropped_late + counters.odometry_out_of_order + counters.sensors_out_of_order +
                   counters.robot_time_wrong + counters.robot_time_early + counters.without_odometry +
                   session_.robot_counters().dropped() + (localizer_ ? localizer_->implausible() : 0);
  if (const auto fault = session_.timestamp_fault(now_s())) {
    status.diagnosis.push_back({.cause = cause_name(fault->cause),
                                .evidence = evidence(*fault),
                                .remedy = std::string(remedy(*fault)),
                                .value = fault->value});
  }
  if (localizer_) {
    if (auto finding = localizer_->finding()) status.diagnosis.push_back(*std::move(finding));
  }
  for (std::size_t i = 0; i < session_.node_count(); ++i) {
    const link::ReportCounters& node = session_.node(i).decoder().counters();
    status.dropped +=
        node.messages_malformed + node.ranges_not_ok + node.ranges_out_of_bounds + node.ranges_bad_instant;
    status.links.push_back({session_.node(i).name(), session_.node(i).decoder().time().round_trip_s()});
  }
  return status;
}

}  // namespace groma::daemon
