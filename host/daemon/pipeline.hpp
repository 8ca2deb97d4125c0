// What gromad computes: bytes of the links in, poses out. It opens no device, reads no clock and starts no
// thread: the same calls give the same poses. A calibration, whatever thread has solved it, enters by adopt()
// alone.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "host/daemon/config.hpp"
#include "host/daemon/input_watch.hpp"
#include "host/daemon/localizer.hpp"
#include "host/daemon/pose_message.hpp"
#include "host/daemon/session.hpp"
#include "host/model/calibration.hpp"

namespace groma::daemon {

class Pipeline {
 public:
  // Receives one line for each event that a user should know of.
  using Log = std::function<void(std::string_view)>;
  // The period of log_faults(), and the time without a pose after which state() says so.
  static constexpr double kStatusPeriod_s = 1.0;

  // Node i is that of config.nodes[i]. on_pose and on_settled: as of Localizer. `config` has to outlive this.
  Pipeline(const Config& config, Log log, Localizer::OnPose on_pose, Localizer::OnPose on_settled);
  Pipeline(const Pipeline&) = delete;
  Pipeline& operator=(const Pipeline&) = delete;

  // Bytes that arrived at now_s (host time), which never decreases in any of the calls. Poses come before the
  // calls return, and without the heap.
  void node_bytes(std::size_t node, std::span<const std::uint8_t> bytes, double now_s);
  void robot_bytes(std::span<const std::uint8_t> bytes, double now_s);
  // After a link was opened again.
  void node_reopened(std::size_t node) { session_.node_reopened(node); }
  void robot_reopened() { session_.robot_reopened(); }
  // Passes on the measurements that have waited for long enough; to be called each few ms.
  void advance(double now_s);
  // Passes on all of them, at the end.
  void flush() { session_.flush(); }

  // Localizes by this calibration, and the tags of `config`, from now on: the first one starts, another one
  // continues from the present pose. start: a pose that the first one's search begins with.
  void adopt(model::Calibration calibration, const std::optional<filter::Start>& start = std::nullopt);

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
  // Logs findings and implausible samples that are new.
  void log_faults();

 private:
  void take_pose(const PoseEstimate& pose);

  const Config& config_;
  Log log_;
  Localizer::OnPose on_pose_;
  Localizer::OnPose on_settled_;
  Session session_;
  InputWatch watch_;
  std::vector<AnchorStatus> anchors_;  // of the calibration in use
  std::optional<Localizer> localizer_;
  std::string frame_ = "map";
  std::uint64_t adopted_ = 0;
  double now_s_ = 0.0;
  std::optional<std::pair<filter::State, filter::Reason>> pose_state_;  // of the last pose
  double last_pose_s_ = 0.0;                                            // host time
  std::uint64_t logged_implausible_ = 0;                                // samples
  bool has_finding_ = false;
};

}  // namespace groma::daemon
