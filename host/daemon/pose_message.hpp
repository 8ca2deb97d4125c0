// The lines of the pose stream: one JSON object each, ended by a line feed.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "groma.pb.h"
#include "host/daemon/anchor_learner.hpp"
#include "host/daemon/input_watch.hpp"
#include "host/daemon/localizer.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/link/can_counters.hpp"

namespace groma::daemon {

// What a node's link has carried since the start, and what the node reported of itself.
struct NodeStatus {
  std::uint64_t frames = 0;  // intact ones
  std::uint64_t frames_dropped = 0;
  std::uint64_t bytes_discarded = 0;  // that belong to no frame
  std::uint64_t ranges = 0;
  std::optional<model::NodeId> tag_id{};         // of its last range
  std::optional<std::uint32_t> slots{};          // of its schedule's superframe
  const groma_Hello* hello = nullptr;            // null: none yet
  const groma_NetworkStatus* network = nullptr;  // likewise
};

struct AnchorStatus {
  model::NodeId id = 0;
  model::AnchorVerdict verdict{};
};

// A link. A node's also has its minimum round-trip delay: half of that is subtracted from each range's time
// and bounds its error. None: no request was answered yet.
struct LinkStatus {
  std::string_view link;
  std::optional<double> round_trip_s{};
  std::optional<std::string_view> error{};  // why it is not open; none: it is
  std::optional<link::CanCounters> can{};   // of a link over CAN
  NodeStatus node{};                        // of a node's link
};

// The content of a STATUS line, about once a second.
struct Status {
  std::string_view state;  // see state_word() and Daemon
  std::uint64_t odometry = 0;
  std::uint64_t ranges = 0;
  std::uint64_t frames_lost = 0;
  std::uint64_t dropped = 0;         // measurements and lines, for any cause
  std::vector<LinkStatus> links{};   // of the nodes
  std::vector<LinkStatus> robots{};  // the robot's links
  std::vector<diagnosis::Finding> diagnosis{};
  std::optional<double> t_s{};  // the robot's time now
  double driven_m = 0.0;        // by odometry, since the start; the next likewise
  double turned_rad = 0.0;
  std::optional<double> pose_latency_p50_s{};  // since the start
  std::optional<double> pose_latency_p99_s{};
  std::vector<AnchorStatus> anchors{};  // of the calibration in use
  std::vector<PairStatus> pairs{};      // that have ranges
};

// {"class":"VERSION","program":"gromad","version":...,"protocol":1}
[[nodiscard]] std::string version_line();

// {"class":"REFUSED","reason":...}, the last line to a client for which there is no place.
[[nodiscard]] std::string refused_line();

// {"class":"POSE","t_s","frame","model","state","reason","x_m","y_m","z_m","roll_rad","pitch_rad","yaw_rad",
// "covariance","quaternion","child_frame","twist"}: the covariance is 6 x 6, row by row, of x, y, z, roll,
// pitch, yaw; that of the twist of vx, vy, vz and the rates about x, y, z. null is unknown. "floor" follows
// if the surface has several.
class PoseWriter {
 public:
  PoseWriter() { line_.reserve(kReserved); }

  // Valid until the next call. Needs no heap while frame, model and floor stay the same.
  [[nodiscard]] std::string_view line(const PoseEstimate& pose, std::string_view frame,
                                      std::string_view model);

 private:
  // More than a line has with short names: 83 numbers of at most 24 characters, and the keys.
  static constexpr std::size_t kReserved = 4096;

  // A text as JSON, escaped when it changes.
  class Quoted {
   public:
    [[nodiscard]] std::string_view operator()(std::string_view text);

   private:
    std::string text_;
    std::string json_ = "\"\"";
  };

  void key(std::string_view name);
  void put(std::string_view name, double number);
  void put(std::string_view name, std::string_view json);
  template <typename Terms>
  void put_terms(std::string_view name, const Terms& terms);

  std::string line_;
  Quoted frame_;
  Quoted model_;
  Quoted floor_;
};
// The same line, on the heap.
[[nodiscard]] std::string pose_line(const PoseEstimate& pose, std::string_view frame, std::string_view model);

// {"class":"CALIBRATION","verdict","anchors":[{"id","state","coverage","verdict","advice","ranges_used",
// "sigma_m"}]}: the progress of calibration while driving.
[[nodiscard]] std::string calibration_line(model::Verdict verdict, std::span<const AnchorProgress> anchors);

// {"class":"STATUS","state",...}. "robot" is the first of the robot's links; if there are several, "robots"
// has all.
[[nodiscard]] std::string status_line(const Status& status);

}  // namespace groma::daemon
