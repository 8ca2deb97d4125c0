#include "host/daemon/daemon.hpp"

#include <fmt/format.h>
#include <sys/signalfd.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <filesystem>
#include <system_error>
#include <utility>

#include "groma.pb.h"
#include "host/daemon/capture.hpp"
#include "host/daemon/robot_can.hpp"
#include "host/io/error.hpp"
#include "host/io/log_ring.hpp"
#include "host/link/line_listener.hpp"
#include "host/link/report_decoder.hpp"
#include "host/web/page_files.hpp"

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

// The name of each of the robot's links, and what opens it.
std::vector<std::pair<std::string, link::ReconnectingLink::Opener>> robot_inputs(const Config& config) {
  std::vector<std::pair<std::string, link::ReconnectingLink::Opener>> inputs;
  if (const std::string path = config.robot_socket.string(); !path.empty())
    inputs.emplace_back(path, input_opener(path, 0));
  for (const std::filesystem::path& listen : config.robot_listen)
    inputs.emplace_back(listen.string(), [path = listen.string()] { return link::open_line_listener(path); });
  if (config.robot_can)
    inputs.emplace_back(robot_can_name(*config.robot_can), robot_can_opener(*config.robot_can));
  return inputs;
}

LinkStatus link_status(const LinkInput& input) {
  LinkStatus status{.link = input.name(), .can = input.can_counters()};
  if (input.link() != nullptr) return status;
  const std::string& error = input.last_error().message;
  status.error = error.empty() ? "the link is lost" : std::string_view(error);
  return status;
}

// Frames that request a node's Hello and its configuration.
std::vector<std::uint8_t> introduction_requests() {
  groma_HostToNode message = groma_HostToNode_init_zero;
  message.request_id = 1;
  message.which_body = groma_HostToNode_get_hello_tag;
  std::vector<std::uint8_t> out = link::request_frame(message);
  message.request_id = 2;
  message.which_body = groma_HostToNode_read_config_tag;
  const std::vector<std::uint8_t> second = link::request_frame(message);
  out.insert(out.end(), second.begin(), second.end());
  return out;
}

}  // namespace

Daemon::Daemon(Config config, std::optional<model::Calibration> calibration, Log log,
               const EventLoop::Clock& clock)
    : config_(std::move(config)),
      log_([this, log = std::move(log)](std::string_view text) {
        log(text);
        if (live_page_ != nullptr) live_page_->on_log(text);
      }),
      loop_([clock, speed = config_.speed] { return speed * clock(); }),
      pipeline_(
          config_, log_, [this](const PoseEstimate& pose) { publish(pose); },
          [this](const PoseEstimate& pose) { calibrator_->on_settled(pose); }),
      mistakes_({.priors = config_.range, .surface = config_.surface, .learns = config_.calibration.learn}),
      known_(std::move(calibration)) {
  pipeline_.session().attach(mistakes_);
  for (std::size_t node = 0; node < config_.nodes.size(); ++node) add_node(node);
  add_robots();
  if (config_.last_pose) last_pose_ = std::make_unique<LastPoseFile>(*config_.last_pose, log_);
}

Daemon::~Daemon() {
  live_page_ = nullptr;
}

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
    static_cast<void>(inputs_.at(node)->link()->write(introduction_requests()));
  };
  setup.log = log_;
  inputs_.push_back(std::make_unique<LinkInput>(loop_, std::move(setup)));
}

void Daemon::add_robots() {
  std::size_t robot = 0;
  auto links = robot_inputs(config_);
  if (config_.ros2) {
    links.emplace_back(Ros2::link_name(*config_.ros2), [this]() -> link::OpenedLink {
      return {ros2_->make_link(), {}};
    });
  }
  for (auto& [name, open] : links) {
    LinkInput::Setup setup;
    setup.name = std::move(name);
    setup.open = std::move(open);
    setup.on_bytes = [this, robot](std::span<const std::uint8_t> bytes, double now_s) {
      arrival_s_ = now_s;
      pipeline_.robot_bytes(bytes, now_s, robot);
    };
    setup.on_opened = [this, robot](bool again) {
      if (again) pipeline_.robot_reopened(robot);
    };
    setup.log = log_;
    inputs_.push_back(std::make_unique<LinkInput>(loop_, std::move(setup)));
    ++robot;
  }
}

link::LinkError Daemon::open() {
  if (link::LinkError error = open_servers(); error.fault != link::LinkFault::kNone) return error;
  for (const auto& input : inputs_) {
    if (link::LinkError error = input->open(); error.fault != link::LinkFault::kNone) return error;
  }
  start_recording();
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
  if (config_.ros2) {
    Ros2::Opened ros2 = Ros2::open(*config_.ros2, config_.tags);
    if (!ros2.ros2) return ros2.error;
    ros2_ = ros2.ros2.get();
    outputs_.push_back(std::move(ros2.ros2));
    log_(
        fmt::format("ROS 2 in domain {}, topics in /{}; DDS listens on all interfaces, and has no password "
                    "but DDS Security",
                    config_.ros2->domain_id, config_.ros2->name_space));
  }
  return config_.web ? open_web(*config_.web) : link::LinkError{};
}

link::LinkError Daemon::open_web(const WebSettings& settings) {
  WebSecrets secrets = read_secrets(settings);
  web_server_ = std::make_unique<web::Server>(loop_.context(), std::move(secrets.access), secrets.tls);
  TcpListener::Opened opened =
      TcpListener::open(loop_, settings.endpoint, "web",
                        [this](io::Descriptor client) { web_server_->add(std::move(client)); });
  if (!opened.listener) return std::move(opened.error);
  web_listener_ = std::move(opened.listener);

  auto page = std::make_unique<LivePage>(loop_, config_, version_line(),
                                         [this] { return pipeline_.session().robot_time_s(loop_.now_s()); });
  auto foxglove = std::make_unique<FoxgloveLive>(loop_, config_);
  web_server_->serve("/live", {.service = page.get(), .subprotocols = {"groma.live.v1"}});
  web_server_->serve("/foxglove", {.service = foxglove.get(),
                                   .subprotocols = {"foxglove.sdk.v1", "foxglove.websocket.v1"},
                                   .needs_subprotocol = true});
  web_server_->serve("/metrics", {"text/plain; version=0.0.4; charset=utf-8", [this] { return metrics(); }});
  for (const web::PageFile& file : web::page_files()) {
    web_server_->serve(std::string(file.path),
                       {std::string(file.content_type), [&file] { return file.bytes; }, "gzip"});
  }
  if (web::page_files().empty())
    web_server_->serve("/", {"text/html; charset=utf-8", [] { return web::kNoPage; }});
  pipeline_.session().attach(*foxglove);
  live_page_ = page.get();
  outputs_.push_back(std::move(page));
  outputs_.push_back(std::move(foxglove));
  const std::string& address = settings.endpoint.address;
  log_(fmt::format("web server on {} port {}", address, web_listener_->port()));
  log_(fmt::format("{}: {}://{}", web::page_files().empty() ? "no live page, but counters" : "live page",
                   settings.tls ? "https" : "http", authority(address, web_listener_->port())));
  return {};
}

bool Daemon::run(int signal_fd, ServiceManager& manager) {
  tick();
  manager.ready();
  const EventLoop::Timer watchdog(loop_, 0.0, [&manager] { manager.alive(); });
  const EventLoop::Timer reloads(loop_, 0.0, [this, &manager] { finish_reload(manager); });
  const EventLoop::Watch signals(loop_, signal_fd, [&] { take_signal(signal_fd, manager); });
  loop_.run();
  if (calibrator_->failed()) return false;
  manager.stopping();
  pipeline_.flush();
  if (last_pose_) last_pose_->finish();
  return calibrator_->finish();
}

void Daemon::take_signal(int signal_fd, const ServiceManager& manager) {
  signalfd_siginfo info{};
  if (::read(signal_fd, &info, sizeof(info)) != sizeof(info)) return;
  if (info.ssi_signo != SIGHUP) return loop_.stop();
  manager.reloading();
  start_reload();
}

void Daemon::start_reload() {
  // The files may have changed since they were read.
  reload_again_ = reloading_.valid();
  if (reload_again_) return;
  reloading_ = std::async(std::launch::async,
                          [this, frame = pipeline_.frame()] { return prepare_reload(config_, frame); });
}

void Daemon::finish_reload(const ServiceManager& manager) {
  if (!reloading_.valid() || reloading_.wait_for(std::chrono::seconds(0)) != std::future_status::ready)
    return;
  reload(reloading_.get());
  if (reload_again_) return start_reload();
  manager.ready();
}

void Daemon::reload(Reload next) {
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
  config_.files = std::move(next.config.files);
  for (const auto& recorder : recorders_) recorder->describe(config_.description());
  log_("reloaded " + config_.path.string() + ": " + describe(*next.calibration));
  adopt(*std::move(next.calibration));
}

void Daemon::tick() {
  for (const auto& input : inputs_) input->service();
  arrival_s_ = loop_.now_s();
  pipeline_.advance(arrival_s_);
  record();
  if (auto calibration = calibrator_->service(arrival_s_)) adopt(*std::move(calibration));
  mistakes_.service(arrival_s_);
  if (calibrator_->failed()) loop_.stop();
}

void Daemon::adopt(model::Calibration calibration) {
  std::optional<filter::Start> start;
  if (last_pose_ && pipeline_.localizer() == nullptr) {
    start = last_pose_->read(calibration, config_.surface);
  } else if (last_pose_) {
    last_pose_->use(calibration);
  }
  mistakes_.use(calibration, config_.tags);
  for (const auto& output : outputs_) output->on_calibration(calibration);
  pipeline_.adopt(std::move(calibration), start);
}

void Daemon::publish(const PoseEstimate& pose) {
  const std::string_view line = pose_writer_.line(pose, pipeline_.frame(), filter::model_name(config_.model));
  for (const auto& output : outputs_) output->on_pose(pose, line);
  for (const auto& recorder : recorders_) recorder->on_pose(line);
  pose_latency_.observe((loop_.now_s() - arrival_s_) / config_.speed);
  if (last_pose_ && pose.state == filter::State::kTracking) last_pose_->take(pose, loop_.now_s());
}

void Daemon::publish_status() {
  pipeline_.log_faults();
  for (const std::string& line : mistakes_.take_news()) log_(line);
  pose_server_->log_events(log_);
  publish_line(status_line(status()));
  if (const AnchorLearner* learner = calibrator_->learner()) {
    publish_line(calibration_line(learner->live().verdict, learner->progress()));
  }
}

Status Daemon::status() const {
  Status status = pipeline_.status(loop_.now_s());
  if (calibrator_->solving()) status.state = "CALIBRATING";
  for (const diagnosis::Finding& finding : mistakes_.findings()) {
    const bool is_known =
        std::any_of(status.diagnosis.begin(), status.diagnosis.end(),
                    [&](const diagnosis::Finding& other) { return other.cause == finding.cause; });
    if (!is_known) status.diagnosis.push_back(finding);
  }
  status.pose_latency_p50_s = pose_latency_.quantile_s(0.5);
  status.pose_latency_p99_s = pose_latency_.quantile_s(0.99);
  for (std::size_t i = config_.nodes.size(); i < inputs_.size(); ++i)
    status.robots.push_back(link_status(*inputs_[i]));
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

void Daemon::start_recording() {
  if (config_.log)
    record_to({.name = *config_.log, .open = [path = *config_.log] { return open_log(path); }});
  if (config_.ring) record_in_ring(*config_.ring);
  pipeline_.record_by([this](const Pipeline::Event& event) {
    for (const auto& recorder : recorders_) recorder->take(event);
  });
}

// Localization goes on without it.
void Daemon::record_in_ring(const RingSettings& settings) {
  try {
    const auto ring = std::make_shared<io::LogRing>(settings.folder, settings.size_mib << 20U);
    record_to({.name = settings.folder,
               .open = [ring] { return ring->open_next(); },
               .file_bytes = ring->file_bytes()});
  } catch (const io::Error& error) {
    log_(fmt::format("{}; the last drive is not kept", error.what()));
  }
}

void Daemon::record_to(LogRecorder::Setup setup) {
  setup.description = config_.description();
  setup.snapshot = [this](std::string& bytes) { take_snapshot(config_, pipeline_, bytes); };
  const std::string name = setup.name.string();
  auto recorder = std::make_unique<LogRecorder>(std::move(setup));
  if (const auto failure = recorder->take_failure()) {
    log_(*failure);
    return;
  }
  recorders_.push_back(std::move(recorder));
  pipeline_.session().attach(*recorders_.back());
  log_(fmt::format("recording into {}", name));
}

void Daemon::record() {
  std::erase_if(recorders_, [this](const auto& recorder) {
    recorder->advance(loop_.now_s());
    const auto failure = recorder->take_failure();
    if (!failure) return false;
    log_(*failure);
    pipeline_.session().detach(*recorder);
    return true;
  });
}

}  // namespace groma::daemon
