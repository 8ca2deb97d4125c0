// The daemon: real links, a real clock, a session and what it feeds. One thread and one poll(2); only solving
// a calibration and what goes to the disk run beside it, so that links do not overflow meanwhile.
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

  // `calibration` is that of the file the configuration names, or none where a drive is to give it.
  Daemon(Config config, std::optional<model::Calibration> calibration, Log log);
  ~Daemon();
  Daemon(const Daemon&) = delete;
  Daemon& operator=(const Daemon&) = delete;

  // Opens all links and the pose stream; the error of the first that cannot be opened. From then on a link
  // that is lost is opened again at growing intervals. Throws as LogRecorder, where a log is asked for.
  [[nodiscard]] link::LinkError open();

  // Serves until stop_fd is readable. False: the drive gave no usable calibration. May throw as
  // io::write_file() does, when the calibration is to be kept.
  [[nodiscard]] bool run(int stop_fd);

 private:
  struct Input {
    std::string name;
    link::ReconnectingLink link;
    bool is_robot = false;
    std::size_t node = 0;    // index in the session, unless it is the robot
    std::string told_error;  // that was logged last
  };

  [[nodiscard]] double now_s() const;
  void wait(int stop_fd, bool& stop);
  void service(Input& input);
  void read(Input& input);
  void tell_news(Input& input);
  void opened(Input& input);
  // False: there is no usable calibration.
  [[nodiscard]] bool calibrate();
  void localize(model::Calibration calibration);
  // Takes in what was learnt while driving.
  void learn();
  void use_learnt();
  void keep_learnt();
  void finish_learning();
  void learn_from(const PoseEstimate& settled);
  void publish(const PoseEstimate& pose);
  void ask_for_time();
  void record();
  void tell_status();
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
  bool to_keep_ = false;              // what was learnt is not in its file yet
  std::future<std::string> keeping_;  // the error, or nothing
  std::unique_ptr<Localizer> localizer_;
  std::string frame_ = "map";
  std::optional<std::pair<filter::State, filter::Reason>> pose_state_;
  std::uint64_t reported_implausible_ = 0;  // samples
  bool has_finding_ = false;
  double last_pose_s_ = 0.0;  // of this computer
  double next_time_request_s_ = 0.0;
  double next_status_s_ = 0.0;  // of this computer
};

}  // namespace groma::daemon
