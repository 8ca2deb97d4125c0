// A running gromad with a simulated site, for attacks: sends the site's data, receives the poses, and
// measures both against the truth.
#pragma once

#include <fmt/format.h>
#include <poll.h>
#include <sched.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include <Eigen/LU>
#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/model/calibration.hpp"
#include "test/host/daemon/gromad_process.hpp"
#include "test/host/daemon/simulated_site.hpp"
#include "test/host/daemon/temporary_folder.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::daemon::test {

using groma::test::TcpClient;

// What was measured over some time.
struct Measured {
  std::vector<double> latencies_ms{};  // from the sending of an odometry sample to its pose at the client
  double seconds = 0.0;
  double cpu_s = 0.0;
  std::size_t sent = 0;  // odometry samples
  std::size_t poses = 0;
  std::size_t tracking = 0;  // of them
  std::size_t wrong = 0;     // of these: further from the truth than five sigmas
  double worst_m = 0.0;      // error of these
  double resident_mib = 0.0;
  std::size_t descriptors = 0;
  std::uint64_t frames_lost = 0;
  std::string problem{};  // what an attack did not find as it has to be

  [[nodiscard]] double latency_ms(double quantile) const {
    if (latencies_ms.empty()) return std::nan("");
    std::vector<double> sorted = latencies_ms;
    std::sort(sorted.begin(), sorted.end());
    const auto at = static_cast<std::size_t>(quantile * static_cast<double>(sorted.size()));
    return sorted[std::min(at, sorted.size() - 1)];
  }
};

class Arena {
 public:
  using Clock = std::chrono::steady_clock;
  static constexpr double kOdometryPeriod_s = 0.005;

  // real_time: gromad's loop and the measurement get real-time priority if this user may give it, so that
  // other programs of this computer add no delay.
  explicit Arena(bool real_time) : site_(folder_.path(), 1.0) {
    site_.odometry_period_s = kOdometryPeriod_s;
    site_.on_lines = [this](double t_s, std::string lines) {
      ++measured_.sent;
      note_sent(t_s, t_s);
      return on_lines ? on_lines(t_s, std::move(lines)) : lines;
    };
    write_calibration();
    gromad_ = std::make_unique<Gromad>(
        std::vector<std::string>{"--config", folder_.write("gromad.yaml", config()).string()});
    const auto deadline = Clock::now() + kPatience;
    while (!client_ && gromad_->running() && Clock::now() < deadline) {
      site_.step();
      if (const auto port = pose_stream_port(*gromad_)) {
        port_ = *port;
        client_.emplace(port_);
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    }
    if (!client_) throw std::runtime_error("gromad: " + gromad_->log());
    is_real_time_ = real_time && raise(gromad_->pid(), 10) && raise(0, 20);
  }

  [[nodiscard]] bool is_real_time() const { return is_real_time_; }
  [[nodiscard]] std::uint16_t port() const { return port_; }
  [[nodiscard]] std::uint16_t web_port() {
    const auto port = port_in_log(*gromad_, "web server");
    if (!port) throw std::runtime_error("gromad has no web server: " + gromad_->log());
    return *port;
  }
  [[nodiscard]] SimulatedSite& site() { return site_; }
  [[nodiscard]] Gromad& gromad() { return *gromad_; }
  [[nodiscard]] const groma::test::TemporaryFolder& folder() const { return folder_; }
  [[nodiscard]] std::size_t poses() const { return measured_.poses; }
  // A line was sent with t_s, for this time of the robot.
  void note_sent(double t_s, double true_s) {
    last_sent_ = key(t_s);
    sent_[last_sent_] = {Clock::now(), true_s};
  }

  // Sends and receives for that time.
  void pump(double seconds) {
    const auto end =
        Clock::now() + std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(seconds));
    while (Clock::now() < end) {
      site_.step();
      if (on_step) on_step();
      pollfd entry{client_->fd(), POLLIN, 0};
      const timespec wait{0, 500'000};
      ::ppoll(&entry, 1, &wait, nullptr);
      receive();
    }
  }

  // Measures during `act`. to_the_last: and until the pose of the last sample has come, or 2 s.
  template <typename Act>
  Measured measure(Act act, bool to_the_last = false) {
    measured_ = {};
    sent_.clear();
    const double cpu_s = processor_s();
    const auto begin = Clock::now();
    try {
      act();
    } catch (const std::runtime_error& error) {
      measured_.problem = error.what();
    }
    const auto end = Clock::now() + std::chrono::seconds(2);
    while (to_the_last && last_pose_ < last_sent_ && Clock::now() < end) receive();
    measured_.seconds = std::chrono::duration<double>(Clock::now() - begin).count();
    measured_.cpu_s = processor_s() - cpu_s;
    measured_.frames_lost = frames_lost_;
    note_resources();
    on_lines = {};
    on_step = {};
    site_.on_frame = {};
    site_.odometry_period_s = kOdometryPeriod_s;
    return std::move(measured_);
  }
  // To be called while an attack has its effect.
  void note_resources() {
    measured_.resident_mib = std::max(measured_.resident_mib, resident_mib());
    measured_.descriptors = std::max(measured_.descriptors, descriptors());
  }

  // Seconds until all poses of half a second are TRACKING and right; none after 30 s.
  std::optional<double> recover() {
    const auto begin = Clock::now();
    const auto waited_s = [&] { return std::chrono::duration<double>(Clock::now() - begin).count(); };
    while (waited_s() < 30.0 && gromad_->running()) {
      const Measured now = measure([this] { pump(0.5); });
      if (now.tracking > 0 && now.tracking == now.poses && now.poses + 10 > now.sent && now.worst_m < 0.3)
        return waited_s();
    }
    return std::nullopt;
  }

  // Changes of an attack, until measure() ends.
  std::function<std::string(double t_s, std::string lines)> on_lines;
  std::function<void()> on_step;

 private:
  struct Sent {
    Clock::time_point at;
    double true_s = 0.0;
  };

  // Threads that it starts have the usual priority.
  static bool raise(pid_t pid, int priority) {
    sched_param parameter{};
    parameter.sched_priority = priority;
    return ::sched_setscheduler(pid, SCHED_FIFO | SCHED_RESET_ON_FORK, &parameter) == 0;
  }

  static std::int64_t key(double t_s) { return std::llround(t_s * 1e6); }

  void write_calibration() const {
    const std::vector<model::Tag> tags{{1, {0.0, 0.0, SimulatedSite::kTagHeight_m}}};
    model::RangePriors priors;
    priors.beta_m = {0.0, 0.05};
    model::Calibration calibration = model::surveyed_calibration(site_.anchors, tags, priors, 0.02);
    calibration.verdict = model::Verdict::kUsable;
    folder_.write("calibration.yaml", io::format_calibration(calibration));
  }

  static std::string config() {
    return fmt::format(R"(schema: 1
nodes: [{{path: tag-1}}, {{path: tag-2}}]
robot_socket: robot.sock
tags: [{{id: 1, lever_arm_m: [0, 0, {}]}}]
odometry: {{sigma_vx_mps: 0.05, sigma_vy_mps: 0.05, sigma_omega_radps: 0.02}}
range: {{sigma_m: 0.05, beta_m: [0, 0.05], gamma: [1.0, 0.002]}}
surface: {{type: plane, z_m: 0, normal: [0, 0, 1]}}
calibration: {{file: calibration.yaml}}
pose_stream: {{port: 0}}
web: {{port: 0}}
log: drive.glog
)",
                       SimulatedSite::kTagHeight_m);
  }

  void receive() {
    text_ += client_->receive();
    const Clock::time_point now = Clock::now();
    std::size_t begin = 0;
    for (std::size_t end = 0; (end = text_.find('\n', begin)) != std::string::npos; begin = end + 1) {
      const auto object = nlohmann::json::parse(text_.substr(begin, end - begin));
      if (object.at("class") == "POSE") take(object, now);
      if (object.at("class") == "STATUS") frames_lost_ = object.at("frames_lost");
    }
    text_.erase(0, begin);
    if (client_->ended()) throw std::runtime_error("the pose stream has ended: " + gromad_->log());
  }

  void take(const nlohmann::json& pose, Clock::time_point now) {
    ++measured_.poses;
    last_pose_ = key(pose.at("t_s"));
    const auto found = sent_.find(last_pose_);
    if (found == sent_.end()) return;
    measured_.latencies_ms.push_back(
        std::chrono::duration<double, std::milli>(now - found->second.at).count());
    if (pose.at("state") != "TRACKING") return;
    ++measured_.tracking;
    const auto truth = SimulatedSite::truth(found->second.true_s);
    const Eigen::Vector2d error{pose.at("x_m").get<double>() - truth.x_m,
                                pose.at("y_m").get<double>() - truth.y_m};
    const auto& terms = pose.at("covariance");
    Eigen::Matrix2d covariance;
    covariance << terms[0].get<double>(), terms[1].get<double>(), terms[6].get<double>(),
        terms[7].get<double>();
    // Chi-squared with 2 degrees of freedom, at 5 sigmas of a Gaussian.
    constexpr double kFiveSigmas = 28.7;
    if (!(error.dot(covariance.inverse() * error) < kFiveSigmas)) ++measured_.wrong;
    measured_.worst_m = std::max(measured_.worst_m, error.norm());
  }

  [[nodiscard]] std::string proc(const char* file) const {
    return fmt::format("/proc/{}/{}", gromad_->pid(), file);
  }
  [[nodiscard]] double processor_s() const {
    std::ifstream file(proc("stat"));
    std::string word;
    double ticks = 0.0;
    for (int i = 1; i <= 15 && file >> word; ++i) {
      if (i >= 14) ticks += std::stod(word);
    }
    return ticks / static_cast<double>(::sysconf(_SC_CLK_TCK));
  }
  [[nodiscard]] double resident_mib() const {
    std::ifstream file(proc("statm"));
    double pages = 0.0;
    file >> pages >> pages;
    return pages * static_cast<double>(::sysconf(_SC_PAGESIZE)) / 1'048'576.0;
  }
  [[nodiscard]] std::size_t descriptors() const {
    std::error_code ignored;
    return static_cast<std::size_t>(std::distance(std::filesystem::directory_iterator(proc("fd"), ignored),
                                                  std::filesystem::directory_iterator()));
  }

  groma::test::TemporaryFolder folder_;
  SimulatedSite site_;
  std::unique_ptr<Gromad> gromad_;
  bool is_real_time_ = false;
  std::uint16_t port_ = 0;
  std::optional<TcpClient> client_;
  std::string text_;
  std::map<std::int64_t, Sent> sent_;
  std::int64_t last_sent_ = 0;
  std::int64_t last_pose_ = 0;
  std::uint64_t frames_lost_ = 0;
  Measured measured_;
};

// Calls an action again and again in a thread of the lowest priority, as an attacker on another computer
// takes none of the robot's processor.
class Attacker {
 public:
  explicit Attacker(std::function<void()> action)
      : thread_([this, act = std::move(action)] {
          constexpr int kLowest = 19;
          ::setpriority(PRIO_PROCESS, static_cast<id_t>(::syscall(SYS_gettid)), kLowest);
          while (!stop_) act();
        }) {}
  Attacker(const Attacker&) = delete;
  Attacker& operator=(const Attacker&) = delete;
  ~Attacker() {
    stop_ = true;
    thread_.join();
  }

 private:
  std::atomic<bool> stop_ = false;
  std::thread thread_;
};

}  // namespace groma::daemon::test
