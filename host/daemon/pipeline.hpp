// What gromad computes: bytes of the links in, poses out. It opens no device, reads no clock and starts no
// thread: the same calls give the same poses. A calibration, whatever thread has solved it, enters by adopt()
// alone. Each call is one event; a recording of them is replayed by take().
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

#include "host/daemon/config.hpp"
#include "host/daemon/input_watch.hpp"
#include "host/daemon/localizer.hpp"
#include "host/daemon/log_doubling.hpp"
#include "host/daemon/odom_watch.hpp"
#include "host/daemon/pose_message.hpp"
#include "host/daemon/session.hpp"
#include "host/io/log_event.hpp"
#include "host/model/calibration.hpp"
#include "host/model/state_archive.hpp"

namespace groma::daemon {

class Pipeline {
 public:
  // Localizes by this calibration and these tags from now on: the first one starts, another one continues
  // from the present pose. start: a pose that the first one's search begins with.
  struct Adoption {
    model::Calibration calibration;
    std::vector<model::Tag> tags;
    std::optional<filter::Start> start;

    void archive(model::StateArchive& state) { state(calibration, tags, start); }
  };
  using Event = std::variant<io::LinkBytes, io::LinkReopened, io::LoopTick, io::LoopFlush, Adoption>;
  using OnEvent = std::function<void(const Event&)>;
  // Receives one line for each event that a user should know of.
  using Log = std::function<void(std::string_view)>;
  // The period of log_faults(), and the time without a pose after which state() says so.
  static constexpr double kStatusPeriod_s = 1.0;

  // Node i is that of config.nodes[i]. on_pose and on_settled: as of Localizer. `config` has to outlive this.
  Pipeline(const Config& config, Log log, Localizer::OnPose on_pose, Localizer::OnPose on_settled);
  Pipeline(const Pipeline&) = delete;
  Pipeline& operator=(const Pipeline&) = delete;

  // Takes one event; the functions below do nothing else. A link that is not configured is ignored.
  void take(Event event);
  // Receives each event before it is taken.
  void record_by(OnEvent on_event) { on_event_ = std::move(on_event); }

  // Bytes that arrived at now_s (host time), which never decreases in any of the calls. Poses come before the
  // calls return, and without the heap. `robot` is one of the robot's links, from 0.
  void node_bytes(std::size_t node, std::span<const std::uint8_t> bytes, double now_s) {
    take(io::LinkBytes{node + 1, bytes, now_s});
  }
  void robot_bytes(std::span<const std::uint8_t> bytes, double now_s, std::size_t robot = 0) {
    take(io::LinkBytes{robot_link(robot), bytes, now_s});
  }
  // After a link was opened again.
  void node_reopened(std::size_t node) { take(io::LinkReopened{node + 1}); }
  void robot_reopened(std::size_t robot = 0) { take(io::LinkReopened{robot_link(robot)}); }
  // Passes on the measurements that have waited for long enough; to be called each few ms.
  void advance(double now_s) { take(io::LoopTick{now_s}); }
  // Passes on all of them, at the end.
  void flush() { take(io::LoopFlush{}); }
  // With the tags of `config`.
  void adopt(model::Calibration calibration, const std::optional<filter::Start>& start = std::nullopt) {
    take(Adoption{std::move(calibration), config_.tags, start});
  }

  // All that later poses depend on, of a pipeline with the same configuration.
  void archive(model::StateArchive& state);

  // For other receivers of its measurements.
  [[nodiscard]] Session& session() noexcept { return session_; }
  [[nodiscard]] const Session& session() const noexcept { return session_; }
  // Null before the first calibration.
  [[nodiscard]] const Localizer* localizer() const noexcept { return localizer_ ? &*localizer_ : nullptr; }
  [[nodiscard]] const std::string& frame() const noexcept { return frame_; }
  [[nodiscard]] std::uint64_t calibrations_adopted() const noexcept { return adopted_; }

  // The states of poses, and while there is none CALIBRATION_DRIVE, WAITING_FOR_ODOMETRY or
  // ODOMETRY_TIMES_WRONG.
  [[nodiscard]] std::string_view state(double now_s) const;
  [[nodiscard]] Status status(double now_s) const;
  // Logs findings, implausible samples and links with the same tag that are new.
  void log_faults();

 private:
  // Numbers of links, as in io::LinkBytes.
  [[nodiscard]] std::size_t robot_link(std::size_t robot) const noexcept {
    return robot == 0 ? 0 : session_.node_count() + robot;
  }
  [[nodiscard]] bool is_node(std::size_t link) const noexcept {
    return link > 0 && link <= session_.node_count();
  }
  [[nodiscard]] std::size_t robot_of(std::size_t link) const noexcept {
    return link == 0 ? 0 : link - session_.node_count();
  }

  void process(const io::LinkBytes& bytes);
  void process(const io::LinkReopened& reopened);
  void process(const io::LoopTick& tick);
  void process(const io::LoopFlush& /*flush*/) { session_.flush(); }
  void process(Adoption& adoption);
  void make_localizer(std::vector<model::Tag> tags, model::Calibration calibration);
  void take_pose(const PoseEstimate& pose);
  void log_duplicate_tag();

  const Config& config_;
  Log log_;
  Localizer::OnPose on_pose_;
  Localizer::OnPose on_settled_;
  OnEvent on_event_;
  Session session_;
  InputWatch watch_;
  OdomWatch odom_;
  std::vector<AnchorStatus> anchors_;  // of the calibration in use
  std::optional<Localizer> localizer_;
  std::string frame_ = "map";
  std::uint64_t adopted_ = 0;
  double now_s_ = 0.0;
  std::optional<std::pair<filter::State, filter::Reason>> pose_state_;  // of the last pose
  double last_pose_s_ = 0.0;                                            // host time
  LogDoubling logged_implausible_;                                      // samples
  bool has_finding_ = false;
  std::vector<std::uint64_t> node_reports_;  // as of the last log_faults()
  // Two nodes that report one tag, and in how many periods in a row.
  std::optional<std::pair<std::size_t, std::size_t>> duplicate_;
  int duplicate_periods_ = 0;
};

}  // namespace groma::daemon
