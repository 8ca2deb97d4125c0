// The input path: bytes of all links in, measurements in the order of their times out. It opens no device and
// reads no clock, so that `groma demo` runs the same code as the daemon, on a simulated clock.
//
//   Session session({});
//   const auto tag = session.add_node("tag-1", 1'000'000);
//   session.attach(localizer);
//   session.robot_bytes(line, now_s);  // announced to the localizer at once
//   session.node_bytes(tag, bytes, now_s);
//   session.advance(now_s);  // measurements reach the localizer
//
// It relates three clocks: each node's counter, the host's clock (now_s: monotonic, any origin) and the
// robot's clock. All output is in robot time. A node's counter is mapped to host time, and host time to the
// t_s of the robot's odometry, each by the messages with the least delay. A single wrong timestamp costs
// only its own message: see RobotClock.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <functional>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "host/daemon/log_doubling.hpp"
#include "host/daemon/measurement_sink.hpp"
#include "host/daemon/odometry_merger.hpp"
#include "host/daemon/robot_clock.hpp"
#include "host/daemon/robot_input.hpp"
#include "host/link/report_decoder.hpp"
#include "host/model/clock_error.hpp"
#include "host/model/state_archive.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

struct SessionConfig {
  // How long measurements wait for earlier ones: a range is reported a superframe after its instant.
  double reorder_lag_s = 0.2;
  // A measurement further behind the robot's present is dropped.
  double max_delay_s = 0.5;
  // A t_s of the robot further from the expected time is dropped as wrong ...
  double max_clock_error_s = 1.0;
  // ... unless all are, for this long: then the clock was set.
  double clock_set_after_s = 1.0;
  // At most this many measurements wait; beyond that the earliest are passed on at once.
  std::size_t max_waiting = 16384;
  // A car-like vehicle, whose odometry is its steering; without it steering samples are dropped.
  std::optional<model::Steering> vehicle = std::nullopt;
  // Receives one line for each event that a user should know of; may be empty.
  std::function<void(std::string_view)> log = {};
};

struct SessionCounters {
  std::uint64_t odometry = 0;  // passed on; the next three likewise
  std::uint64_t pose_priors = 0;
  std::uint64_t ranges = 0;
  std::uint64_t sensors = 0;                // samples of other sensors
  std::uint64_t passed_late = 0;            // passed on out of order; also counted above
  std::uint64_t dropped_late = 0;           // more than max_delay_s behind
  std::uint64_t odometry_out_of_order = 0;  // not newer than the sample before, or fallen back: dropped
  std::uint64_t odometry_merged = 0;        // samples saved by merging: input less output
  std::uint64_t sensors_out_of_order = 0;   // poses and sensor samples that fell back: dropped
  std::uint64_t robot_time_wrong = 0;       // dropped
  std::uint64_t robot_time_early = 0;       // dropped
  std::uint64_t robot_clock_set = 0;        // clock steps and restarts
  std::uint64_t steering_unknown = 0;       // steering samples without SessionConfig::vehicle: dropped
  std::uint64_t without_odometry = 0;       // before the first odometry gave the robot's time: dropped
  std::uint64_t waiting_overflows = 0;      // passed on before their wait was over
};

class Session {
 public:
  // The state of one node's link.
  class Node : public link::NodeSink {
   public:
    Node(Session& session, std::string name, unsigned baud);

    [[nodiscard]] const std::string& name() const noexcept { return name_; }
    [[nodiscard]] const link::ReportDecoder& decoder() const noexcept { return decoder_; }
    // The last message of each kind from the node.
    [[nodiscard]] const std::optional<groma_Hello>& hello() const noexcept { return hello_; }
    [[nodiscard]] const std::optional<groma_NetworkStatus>& network_status() const noexcept {
      return status_;
    }
    [[nodiscard]] const std::optional<groma_Counters>& node_counters() const noexcept { return counters_; }
    // Of its last range.
    [[nodiscard]] std::optional<model::NodeId> tag_id() const noexcept { return tag_id_; }
    // Of its schedule's superframe; none: it has not answered what its configuration is.
    [[nodiscard]] std::optional<std::uint32_t> slots() const noexcept { return slots_; }

    void archive(model::StateArchive& state) { state(decoder_, hello_, status_, counters_, slots_); }

   private:
    friend class Session;
    void on_range(const model::RangeSample& range) override;
    void on_hello(const groma_Hello& hello) override;
    void on_network_status(const groma_NetworkStatus& status) override { status_ = status; }
    void on_counters(const groma_Counters& counters) override { counters_ = counters; }
    void on_log(const groma_Log& log) override;
    void on_reply(const groma_Reply& reply) override;

    Session& session_;
    std::string name_;
    link::ReportDecoder decoder_;
    std::optional<groma_Hello> hello_;
    std::optional<groma_NetworkStatus> status_;
    std::optional<groma_Counters> counters_;
    std::optional<model::NodeId> tag_id_;
    std::optional<std::uint32_t> slots_;
  };

  explicit Session(SessionConfig config = {});
  Session(const Session&) = delete;
  Session& operator=(const Session&) = delete;
  ~Session() = default;

  // Adds a node's link of that bit rate in bit/s (0: bytes take no time); returns its index, from 0.
  std::size_t add_node(std::string name, unsigned baud);

  // An attached sink gets every measurement. Detach it before it is destroyed. Do not attach or detach from
  // within a call to a sink.
  void attach(MeasurementSink& sink);
  void detach(MeasurementSink& sink);

  // Bytes that arrived at now_s (host time), which never decreases. `robot` is one of the robot's links, from
  // 0: lines of several do not mix.
  void node_bytes(std::size_t node, std::span<const std::uint8_t> bytes, double now_s);
  void robot_bytes(std::span<const std::uint8_t> bytes, double now_s, std::size_t robot = 0);

  // After a link was reopened.
  void node_reopened(std::size_t node);
  void robot_reopened(std::size_t robot = 0);

  // Corrects the times of ranges from now on, before their order is decided. What this makes older waits
  // longer, as all measurements then do, so that nothing is late. Beyond kMaxRangeClock_s nothing is
  // corrected, which is logged once.
  static constexpr double kMaxRangeClock_s = 2.0;
  void set_range_clock(const model::ClockError& clock) {
    range_clock_ = clock;
    range_clock_refused_ = false;
  }

  // Passes on the measurements that have waited for reorder_lag_s.
  void advance(double now_s);
  // Passes on all waiting measurements, at the end of a drive.
  void flush();

  // Whether the newest odometry sample had "odom"; and what that of this time had, if it is a recent one.
  [[nodiscard]] bool gives_odom() const noexcept { return gives_odom_; }
  [[nodiscard]] std::optional<model::OdomPose> odom_pose(double t_s) const noexcept;
  // Host time to robot time; nothing before the first odometry.
  [[nodiscard]] std::optional<double> robot_time_s(double host_s) const {
    return robot_clock_.robot_time_s(host_s);
  }
  // The fault of the robot's timestamps within the last kFaultShown_s; and for how long all odometry has been
  // dropped for such faults, 0 if the last sample was accepted.
  static constexpr double kFaultShown_s = 10.0;
  [[nodiscard]] std::optional<TimestampFault> timestamp_fault(double now_s) const;
  [[nodiscard]] double odometry_dropped_for_s(double now_s) const {
    return dropped_since_s_ ? now_s - *dropped_since_s_ : 0.0;
  }

  [[nodiscard]] std::size_t node_count() const noexcept { return nodes_.size(); }
  [[nodiscard]] const Node& node(std::size_t index) const { return nodes_.at(index); }
  [[nodiscard]] RobotInputCounters robot_counters() const noexcept;  // of all links
  [[nodiscard]] const SessionCounters& counters() const noexcept { return counters_; }
  // Reports lost in nodes and links together.
  [[nodiscard]] std::uint64_t frames_lost() const noexcept;

  // Of a session with the same nodes and configuration. Sinks are not part of it.
  void archive(model::StateArchive& state) {
    for (Node& node : nodes_) state(node);
    state(robots_, odoms_, next_odom_, gives_odom_, robot_lines_dropped_, robot_clock_, range_clock_, merger_,
          last_odometry_s_, suspended_, pose_times_, initial_times_, sensor_times_, times_suspect_,
          timestamps_dropped_, dropped_since_s_, drop_reported_, next_late_report_s_, waiting_, serial_,
          now_s_, passed_until_s_, counters_);
  }

 private:
  using Sample = std::variant<model::OdometrySample, model::PoseSample, model::RangeSample,
                              model::SensorSample, InitialPose>;
  struct Waiting {
    double t_s = 0.0;
    std::uint64_t serial = 0;
    Sample sample;
  };
  // Earliest first; at equal times odometry, then poses, then ranges by tag and anchor, then other sensors,
  // then initial poses; then in the order of arrival.
  struct Later {
    bool operator()(const Waiting& a, const Waiting& b) const noexcept;
  };

  // Times of one kind of message other than odometry.
  struct SensorTimes {
    std::optional<double> last_s;    // robot time
    std::optional<double> offset_s;  // of the last message that fell back
  };

  // A sample whose time does not fit the robot's clock, until the next ones show whether the clock was set.
  struct Suspended {
    std::variant<model::OdometrySample, model::PoseSample, model::SensorSample, InitialPose> sample;
    Timestamp timestamp = Timestamp::kWrong;
    double arrived_s = 0.0;  // host time
  };
  static constexpr std::size_t kMaxSuspended = 64;

  [[nodiscard]] RobotInput& robot_input(std::size_t robot);
  void take(const model::OdometrySample& odometry, double now_s);
  void take(const model::SteeringSample& sample, double now_s);
  void take(const model::PoseSample& pose, double now_s);
  void take(const model::SensorSample& sample, double now_s);
  void take(const InitialPose& initial, double now_s);
  void take(model::RangeSample range);
  // kGood, kWrong, kEarly or kFallenBack: how the time of a pose or sensor sample fits. Requires a known
  // robot time.
  [[nodiscard]] Timestamp judge(SensorTimes& times, double t_s, double now_s);
  template <typename Sample>
  void take_timed(SensorTimes& times, double t_s, const Sample& sample, double now_s);
  void use(const model::OdometrySample& odometry, double now_s);
  void suspend(const Suspended& sample);
  void drop(const Suspended& sample);
  // The clock was set: the suspended samples are of the new clock.
  void use_suspended(double now_s);
  // It was not: they are wrong. Only those of odometry, or all.
  void drop_suspended(bool only_odometry);
  // How late the clock of ranges is at a time of the robot, s; 0 beyond kMaxRangeClock_s.
  [[nodiscard]] double ranges_late_s(double t_s) const noexcept;
  // How much longer than configured measurements wait, for ranges that are late.
  [[nodiscard]] double wait_for_ranges_s(double robot_now_s) const noexcept {
    return std::max(0.0, ranges_late_s(robot_now_s));
  }
  // Queues a sample by its time, or passes it on at once if later ones were passed on already. Requires a
  // known robot time.
  void enqueue(double t_s, const Sample& sample);
  void push_waiting(double t_s, const Sample& sample);
  // Passes on the earliest waiting sample.
  void deliver_first();
  void deliver(double t_s, const Sample& sample);
  void announce(const Sample& sample);
  void pass_merged(std::span<const model::OdometrySample> samples);
  // Logs once that odometry is merged, and again only after it was slower.
  void report_fast_odometry(double now_s);
  void drop_odometry(std::uint64_t& counter, double now_s);
  // Discards the waiting samples and times of the old clock; after a step they are converted to the new one.
  void clock_was_set(double now_s);
  void clock_stepped();
  void forget_times();
  void report_suspect_times();
  void say(std::string_view text) const;

  SessionConfig config_;
  std::deque<Node> nodes_;
  std::deque<RobotInput> robots_;
  std::array<model::OdomPose, 32> odoms_{};  // the last ones; merged samples have the time of an earlier one
  std::size_t next_odom_ = 0;
  bool gives_odom_ = false;
  LogDoubling robot_lines_dropped_;
  RobotClock robot_clock_;
  model::ClockError range_clock_;
  bool range_clock_refused_ = false;
  OdometryMerger merger_;
  std::optional<double> last_odometry_s_;
  std::vector<Suspended> suspended_;  // in the order of arrival; its capacity is reserved
  // Odometry within the present period of report_fast_odometry().
  struct Rate {
    double since_s = 0.0;      // host time
    std::uint64_t taken = 0;   // samples
    std::uint64_t passed = 0;  // after merging
  };
  Rate rate_;
  bool fast_reported_ = false;
  SensorTimes pose_times_;
  SensorTimes initial_times_;
  std::array<SensorTimes, std::variant_size_v<model::SensorSample>> sensor_times_{};
  bool times_suspect_ = false;             // as reported to the sinks
  std::uint64_t timestamps_dropped_ = 0;   // of odometry
  std::optional<double> dropped_since_s_;  // host time; all odometry has been dropped since
  bool drop_reported_ = false;
  double next_late_report_s_ = -std::numeric_limits<double>::infinity();  // host time
  std::vector<Waiting> waiting_;  // a heap, the earliest in front; its capacity is reserved
  std::uint64_t serial_ = 0;
  double now_s_ = 0.0;
  std::optional<double> passed_until_s_;  // robot time
  std::vector<MeasurementSink*> sinks_;
  SessionCounters counters_;
};

}  // namespace groma::daemon
