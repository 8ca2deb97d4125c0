// The daemon: links, the real clock, a session and its sinks. One thread with one poll(2); only the
// calibration solver and disk writes have threads of their own, so that links do not overflow meanwhile.
#pragma once

#include <functional>
#include <future>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/calibration/calibrate.hpp"
#include "host/daemon/anchor_learner.hpp"
#include "host/daemon/calibration_drive.hpp"
#include "host/daemon/config.hpp"
#include "host/daemon/localizer.hpp"
#include "host/daemon/log_recorder.hpp"
#include "host/daemon/pose_message.hpp"
#include "host/daemon/pose_server.hpp"
#include "host/daemon/session.hpp"
#include "host/link/reconnecting_link.hpp"

namespace groma::daemon {

class Daemon {
 public:
  using Log = std::function<void(std::string_view)>;

  // `calibration` is read from the file that the configuration names; none: a drive provides it.
  Daemon(Config config, std::optional<model::Calibration> calibration, Log log);
  ~Daemon();
  Daemon(const Daemon&) = delete;
  Daemon& operator=(const Daemon&) = delete;

  // Opens the pose stream and all links; returns the error of the first that cannot be opened. Later a lost
  // link is reopened at growing intervals. Throws as LogRecorder does if a log is configured.
  [[nodiscard]] link::LinkError open();

  // Serves until stop_fd is readable. False: the drive gave no usable calibration. Throws as io::write_file()
  // does if the calibration cannot be written.
  [[nodiscard]] bool run(int stop_fd);

 private:
  struct Input {
    std::string name;
    link::ReconnectingLink link;
    bool is_robot = false;
    std::size_t node = 0;      // index in the session, except for the robot
    std::string logged_error;  // the error logged last
  };

  [[nodiscard]] double now_s() const;
  void wait(int stop_fd, bool& stop);
  void service(Input& input);
  void read(Input& input);
  void log_news(Input& input);
  void opened(Input& input);
  // False: the drive gave no usable calibration.
  [[nodiscard]] bool calibrate();
  void localize(model::Calibration calibration);
  // Runs calibration while driving: adopts, logs and writes its results.
  void learn();
  void use_calibrated();
  void write_calibrated();
  void finish_learning();
  void learn_from(const PoseEstimate& settled);
  void publish(const PoseEstimate& pose);
  void request_times();
  void record();
  void publish_status();
  void report_implausible();
  void report_finding();
  [[nodiscard]] std::string_view state() const;
  [[nodiscard]] Status status() const;

  Config config_;
  Log log_;
  std::optional<model::Calibration> calibration_;
  Session session_;
  std::vector<Input> inputs_;
  std::unique_ptr<PoseServer> server_;
  std::unique_ptr<LogRecorder> recorder_;
  std::unique_ptr<CalibrationDrive> drive_;
  std::future<calibration::Result> solution_;
  std::unique_ptr<AnchorLearner> learner_;
  bool to_write_ = false;             // the current calibration is not in its file yet
  std::future<std::string> writing_;  // the error; empty: written
  std::unique_ptr<Localizer> localizer_;
  std::string frame_ = "map";
  std::optional<std::pair<filter::State, filter::Reason>> pose_state_;
  std::uint64_t reported_implausible_ = 0;  // samples
  bool has_finding_ = false;
  double last_pose_s_ = 0.0;          // host time
  double next_time_request_s_ = 0.0;  // host time
  double next_status_s_ = 0.0;        // host time
};

}  // namespace groma::daemon
