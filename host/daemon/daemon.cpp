#include "host/daemon/daemon.hpp"

#include <fmt/format.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include <csignal>
#include <filesystem>
#include <system_error>
#include <tuple>
#include <utility>

#include "groma.pb.h"
#include "host/daemon/reload.hpp"
#include "host/daemon/robot_can.hpp"
#include "host/link/line_listener.hpp"
#include "host/link/report_decoder.hpp"

namespace groma::daemon {
namespace {

constexpr double kTimeRequestPeriod_s = 1.0;  // to each node

link::ReconnectingLink::Opener input_opener(const std::string& path, unsigned baud) {
  return [path, open = link::link_opener(path, baud)]() -> link::OpenedLink {
    std::error_code ignored;  // link_opener() explains such errors
    if (!std::filesystem::is_regular_file(path, ignored)) return open();
    return {nullptr,
            {link::LinkFault::kUnsuitable, fmt::format("{}: a file is not a live link; name a serial port, a "
                                                       "pseudo-terminal, a node on a CAN bus or a socket",
                                                       path)}};
  };
}

// The name of the robot's link, and what opens it.
std::pair<std::string, link::ReconnectingLink::Opener> robot_input(const Config& config) {
  if (config.robot_can) return {robot_can_name(*config.robot_can), robot_can_opener(*config.robot_can)};
  const std::string listen = config.robot_listen.string();
  if (!listen.empty()) return {listen, [listen] { return link::open_line_listener(listen); }};
  const std::string path = config.robot_socket.string();
  return {path, input_opener(path, 0)};
}

LinkStatus link_status(const LinkInput& input) {
  LinkStatus status{.link = input.name(), .can = input.can_counters()};
  if (input.link() != nullptr) return status;
  const std::string& error = input.last_error().message;
  status.error = error.empty() ? "the link is lost" : std::string_view(error);
  return status;
}

// A frame that requests a node's Hello.
std::vector<std::uint8_t> hello_request() {
  groma_HostToNode message = groma_HostToNode_init_zero;
  message.request_id = 1;
  message.which_body = groma_HostToNode_get_hello_tag;
  return link::request_frame(message);
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
  if (config_.last_pose) last_pose_ = std::make_unique<LastPoseFile>(*config_.last_pose, log_);
}

Daemon::~Daemon() = default;

void Daemon::add_node(std::size_t node) {
  LinkInput::Setup setup;
  setup.name = config_.nodes.at(node).path.string();
  setup.open = input_opener(setup.name, config_.nodes.at(node).baud);
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
  std::tie(setup.name, setup.open) = robot_input(config_);
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

bool Daemon::run(int signal_fd, ServiceManager& manager) {
  tick();
  manager.ready();
  const EventLoop::Timer watchdog(loop_, 0.0, [&manager] { manager.alive(); });
  const EventLoop::Watch signals(loop_, signal_fd, [&] { take_signal(signal_fd, manager); });
  loop_.run();
  if (calibrator_->failed()) return false;
  manager.stopping();
  pipeline_.flush();
  const bool usable = calibrator_->finish();
  if (last_pose_) last_pose_->finish();
  return usable;
}

void Daemon::take_signal(int signal_fd, const ServiceManager& manager) {
  signalfd_siginfo info{};
  if (::read(signal_fd, &info, sizeof(info)) != sizeof(info)) return;
  if (info.ssi_signo != SIGHUP) return loop_.stop();
  manager.reloading();
  reload();
  manager.ready();
}

void Daemon::reload() {
  Reload next = prepare_reload(config_, pipeline_.frame());
  for (const std::string& problem : next.problems) log_(problem);
  if (!next.problems.empty()) {
    log_("nothing was reloaded");
    return;
  }
  if (pipeline_.localizer() == nullptr || !next.calibration) {
    log_("reloaded nothing: no key has changed");
    return;
  }
  config_.tags = std::move(next.config.tags);
  config_.calibration = std::move(next.config.calibration);
  config_.values = std::move(next.config.values);
  log_("reloaded " + config_.path.string() + ": " + describe(*next.calibration));
  adopt(*std::move(next.calibration));
}

void Daemon::tick() {
  for (const auto& input : inputs_) input->service();
  arrival_s_ = loop_.now_s();
  pipeline_.advance(arrival_s_);
  record();
  if (auto calibration = calibrator_->service()) adopt(*std::move(calibration));
  if (calibrator_->failed()) loop_.stop();
}

void Daemon::adopt(model::Calibration calibration) {
  std::optional<filter::Start> start;
  if (last_pose_ && pipeline_.localizer() == nullptr) {
    start = last_pose_->read(calibration, config_.surface);
  } else if (last_pose_) {
    last_pose_->use(calibration);
  }
  pipeline_.adopt(std::move(calibration), start);
}

void Daemon::publish(const PoseEstimate& pose) {
  const std::string line = pose_line(pose, pipeline_.frame(), filter::model_name(config_.model));
  for (const auto& output : outputs_) output->on_pose(pose, line);
  pose_latency_.observe((loop_.now_s() - arrival_s_) / config_.speed);
  if (last_pose_ && pose.state == filter::State::kTracking) last_pose_->take(pose, loop_.now_s());
}

void Daemon::publish_status() {
  pipeline_.log_faults();
  publish_line(status_line(status()));
  if (const AnchorLearner* learner = calibrator_->learner()) {
    publish_line(calibration_line(learner->live().verdict, learner->progress()));
  }
}

Status Daemon::status() const {
  Status status = pipeline_.status(loop_.now_s());
  if (calibrator_->solving()) status.state = "CALIBRATING";
  status.pose_latency_p50_s = pose_latency_.quantile_s(0.5);
  status.pose_latency_p99_s = pose_latency_.quantile_s(0.99);
  status.robot = link_status(*inputs_.back());
  for (std::size_t node = 0; node < config_.nodes.size(); ++node) {
    LinkStatus link = link_status(*inputs_.at(node));
    link.round_trip_s = status.links.at(node).round_trip_s;
    link.node = status.links.at(node).node;
    status.links.at(node) = link;
  }
  return status;
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
