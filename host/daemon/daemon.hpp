// The daemon: the event loop, with links and robot as inputs, the pipeline, and the outputs that it gives
// poses to. From byte to pose all is on the loop's thread; only the calibration solver and disk writes have
// threads of their own, so that nothing overflows meanwhile.
#pragma once

#include <cstdint>
#include <functional>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/daemon/config.hpp"
#include "host/daemon/event_loop.hpp"
#include "host/daemon/foxglove_live.hpp"
#include "host/daemon/last_pose.hpp"
#include "host/daemon/link_input.hpp"
#include "host/daemon/live_page.hpp"
#include "host/daemon/log_recorder.hpp"
#include "host/daemon/metrics_text.hpp"
#include "host/daemon/mistake_watch.hpp"
#include "host/daemon/output.hpp"
#include "host/daemon/pipeline.hpp"
#include "host/daemon/pose_message.hpp"
#include "host/daemon/pose_server.hpp"
#include "host/daemon/reload.hpp"
#include "host/daemon/ros2.hpp"
#include "host/daemon/service_manager.hpp"
#include "host/daemon/site_calibrator.hpp"
#include "host/web/server.hpp"

namespace groma::daemon {

class Daemon {
 public:
  using Log = std::function<void(std::string_view)>;

  // `calibration` is read from the file that the configuration names; none: a drive provides it. All times
  // are those of `clock` multiplied by the configuration's `speed`.
  Daemon(Config config, std::optional<model::Calibration> calibration, Log log,
         const EventLoop::Clock& clock = EventLoop::monotonic_s);
  ~Daemon();
  Daemon(const Daemon&) = delete;
  Daemon& operator=(const Daemon&) = delete;

  // Opens the pose stream, the web server and all links, and begins to calibrate or localize; returns the
  // error of the first that cannot be opened. A link that is missing or in use, and later a lost one, is
  // opened as soon as possible. Throws as LogRecorder does if a log is configured.
  [[nodiscard]] link::LinkError open();

  // Serves until signal_fd, a signalfd(2), delivers a signal other than SIGHUP, which reloads, in a thread of
  // its own as far as files are read. Then uses and
  // writes what was measured so far. False: the drive gave no usable calibration. Throws as io::write_file()
  // does if the calibration cannot be written at the end.
  [[nodiscard]] bool run(int signal_fd, ServiceManager& manager);
  // Serves what is ready and due, without waiting: for a caller with a clock of its own.
  void poll() { loop_.poll(); }

  [[nodiscard]] std::uint16_t pose_port() const noexcept { return pose_server_->port(); }
  // With `web` in the configuration.
  [[nodiscard]] std::uint16_t web_port() const noexcept { return web_listener_->port(); }

 private:
  void add_node(std::size_t node);
  void add_robots();
  [[nodiscard]] link::LinkError open_servers();
  [[nodiscard]] link::LinkError open_web(const WebSettings& settings);
  void tick();
  void take_signal(int signal_fd, const ServiceManager& manager);
  // Starts to read the configuration again.
  void start_reload();
  // Once it is read: changes what can be changed, or nothing if there is an error.
  void finish_reload(const ServiceManager& manager);
  void reload(Reload next);
  void adopt(model::Calibration calibration);
  void publish(const PoseEstimate& pose);
  void publish_status();
  [[nodiscard]] Status status() const;
  void publish_line(std::string_view line);
  void request_times();
  void start_recording();
  void record_in_ring(const RingSettings& settings);
  void record_to(LogRecorder::Setup setup);
  void record();
  // The text of /metrics.
  [[nodiscard]] std::string_view metrics();
  void add_links(MetricsText& text) const;
  void add_outputs(MetricsText& text) const;

  Config config_;
  LivePage* live_page_ = nullptr;  // one of outputs_; it shows the log
  Log log_;
  EventLoop loop_;
  Pipeline pipeline_;
  MistakeWatch mistakes_;
  std::vector<std::unique_ptr<Output>> outputs_;
  PoseServer* pose_server_ = nullptr;               // one of them
  Ros2* ros2_ = nullptr;                            // likewise
  std::vector<std::unique_ptr<LinkInput>> inputs_;  // the nodes in their order, then the robot's
  std::unique_ptr<web::Server> web_server_;
  std::unique_ptr<TcpListener> web_listener_;
  std::vector<std::unique_ptr<LogRecorder>> recorders_;
  std::optional<model::Calibration> known_;   // of the file, until open()
  std::optional<SiteCalibrator> calibrator_;  // from open() on
  std::unique_ptr<LastPoseFile> last_pose_;
  PoseWriter pose_writer_;
  std::future<Reload> reloading_;  // reads config_
  bool reload_again_ = false;
  double arrival_s_ = 0.0;  // of what the pipeline is taking
  LatencyHistogram pose_latency_;
  std::string metrics_;
  double metrics_until_s_ = 0.0;
  std::vector<std::unique_ptr<EventLoop::Timer>> timers_;
};

}  // namespace groma::daemon
