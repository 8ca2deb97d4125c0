#include "host/daemon/daemon.hpp"

#include <fmt/format.h>
#include <pb_encode.h>

#include <array>
#include <filesystem>
#include <system_error>
#include <utility>

#include "groma.pb.h"
#include "host/link/report_decoder.hpp"
#include "proto/frame_codec.hpp"

namespace groma::daemon {
namespace {

constexpr double kTimeRequestPeriod_s = 1.0;  // to each node

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

}  // namespace

Daemon::Daemon(Config config, std::optional<model::Calibration> calibration, Log log,
               const EventLoop::Clock& clock)
    : config_(std::move(config)),
      log_(std::move(log)),
      loop_([clock, speed = config_.speed] { return speed * clock(); }),
      pipeline_(
          config_, log_, [this](const PoseEstimate& pose) { publish(pose); },
          [this](const PoseEstimate& pose) { calibrator_->on_settled(pose); }),
      known_(std::move(calibration)) {
  for (std::size_t node = 0; node < config_.nodes.size(); ++node) add_node(node);
  add_robot();
}

Daemon::~Daemon() = default;

void Daemon::add_node(std::size_t node) {
  LinkInput::Setup setup;
  setup.name = config_.nodes.at(node).path.string();
  setup.open = [path = setup.name, baud = config_.nodes.at(node).baud] { return open_input(path, baud); };
  setup.on_bytes = [this, node](std::span<const std::uint8_t> bytes, double now_s) {
    arrival_s_ = now_s;
    pipeline_.node_bytes(node, bytes, now_s);
  };
  setup.on_opened = [this, node](bool again) {
    if (again) pipeline_.node_reopened(node);
    // Do not wait for the answer.
    static_cast<void>(inputs_.at(node)->link()->write(hello_request()));
  };
  setup.log = log_;
  inputs_.push_back(std::make_unique<LinkInput>(loop_, std::move(setup)));
}

void Daemon::add_robot() {
  LinkInput::Setup setup;
  setup.name = config_.robot_socket.string();
  setup.open = [path = setup.name] { return open_input(path, 0); };
  setup.on_bytes = [this](std::span<const std::uint8_t> bytes, double now_s) {
    arrival_s_ = now_s;
    pipeline_.robot_bytes(bytes, now_s);
  };
  setup.on_opened = [this](bool again) {
    if (again) pipeline_.robot_reopened();
  };
  setup.log = log_;
  inputs_.push_back(std::make_unique<LinkInput>(loop_, std::move(setup)));
}

link::LinkError Daemon::open() {
  if (link::LinkError error = open_servers(); error.fault != link::LinkFault::kNone) return error;
  for (const auto& input : inputs_) {
    if (link::LinkError error = input->open(); error.fault != link::LinkFault::kNone) return error;
  }
  if (config_.log) {
    recorder_ = std::make_unique<LogRecorder>(*config_.log, config_.description());
    pipeline_.session().attach(*recorder_);
    log_(fmt::format("recording into {}", config_.log->string()));
  }
  calibrator_.emplace(config_, std::exchange(known_, std::nullopt), pipeline_.session(), log_);
  const auto call = [this](double period_s, void (Daemon::*action)()) {
    timers_.push_back(
        std::make_unique<EventLoop::Timer>(loop_, period_s, [this, action] { (this->*action)(); }));
  };
  call(0.0, &Daemon::tick);
  call(kTimeRequestPeriod_s, &Daemon::request_times);
  call(Pipeline::kStatusPeriod_s, &Daemon::publish_status);
  return {};
}

link::LinkError Daemon::open_servers() {
  PoseServer::Opened stream = PoseServer::open(loop_, config_.pose_stream, version_line());
  if (!stream.server) return stream.error;
  pose_server_ = stream.server.get();
  outputs_.push_back(std::move(stream.server));
  log_(fmt::format("pose stream on {} port {}", config_.pose_stream.address, pose_server_->port()));
  if (!config_.web) return {};
  WebServer::Opened web = WebServer::open(loop_, *config_.web);
  if (!web.server) return web.error;
  web_server_ = std::move(web.server);
  web_server_->serve("/metrics", "text/plain; version=0.0.4; charset=utf-8", [this] { return metrics(); });
  log_(fmt::format("web server on {} port {}", config_.web->address, web_server_->port()));
  return {};
}

bool Daemon::run(int stop_fd) {
  const EventLoop::Watch stop(loop_, stop_fd, [this] { loop_.stop(); });
  loop_.run();
  if (calibrator_->failed()) return false;
  calibrator_->finish();
  return true;
}

void Daemon::tick() {
  for (const auto& input : inputs_) input->service();
  arrival_s_ = loop_.now_s();
  pipeline_.advance(arrival_s_);
  record();
  if (auto calibration = calibrator_->service()) pipeline_.adopt(*std::move(calibration));
  if (calibrator_->failed()) loop_.stop();
}

void Daemon::publish(const PoseEstimate& pose) {
  const std::string line = pose_line(pose, pipeline_.frame(), filter::model_name(config_.model));
  for (const auto& output : outputs_) output->on_pose(pose, line);
  pose_latency_.observe((loop_.now_s() - arrival_s_) / config_.speed);
}

void Daemon::publish_status() {
  const double now_s = loop_.now_s();
  pipeline_.log_faults();
  Status status = pipeline_.status(now_s);
  if (calibrator_->solving()) status.state = "CALIBRATING";
  publish_line(status_line(status));
  if (const AnchorLearner* learner = calibrator_->learner()) {
    publish_line(calibration_line(learner->live().verdict, learner->progress()));
  }
}

void Daemon::publish_line(std::string_view line) {
  for (const auto& output : outputs_) output->on_line(line);
}

// The answers give the delay of each node's link. A request that fails is repeated in the next period.
void Daemon::request_times() {
  for (std::size_t node = 0; node < config_.nodes.size(); ++node) {
    link::ByteLink* const link = inputs_.at(node)->link();
    if (link != nullptr) static_cast<void>(link->write(link::time_request(loop_.now_s())));
  }
}

void Daemon::record() {
  if (!recorder_) return;
  recorder_->advance(loop_.now_s());
  if (const auto failure = recorder_->take_failure()) {
    log_(*failure);
    pipeline_.session().detach(*recorder_);
    recorder_.reset();
  }
}

}  // namespace groma::daemon
