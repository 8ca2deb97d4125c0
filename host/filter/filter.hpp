// The terrain-informed error-state filter (M-ESEKF of the source paper): odometry moves a pose on the
// surface, ranges correct it, and the uncertainty of the site's calibration is carried along.
//
//   filter::Filter filter(surface, tags, calibration, config);
//   filter.start({.t_s = 12.0, .pose = {x, y, theta}});
//   filter.process(odometry_row);
//   filter.process(range);
//   filter.estimate();
//
// No clock, no I/O, no log, no exceptions, no allocation after construction. Inputs come in time order;
// what came of each is returned.
#pragma once

#include <vector>

#include "host/filter/dead_reckoning.hpp"
#include "host/filter/joint_covariance.hpp"
#include "host/filter/sensors.hpp"

namespace groma::filter {

struct Start {
  double t_s = 0.0;
  model::PlanarPose pose = {};
  double position_sigma_m = 0.1;
  double heading_sigma_rad = 0.05;
};

enum class OdometryOutcome {
  kUsed,
  kUsedLate,     // older than the state, newer than the row held: holds from the state's time on
  kStored,       // before the start: held for it
  kOutOfOrder,   // not newer than the row held: refused
  kBadValue,     // not finite: refused
  kImplausible,  // no robot can do it: dropped, the row before holds on to its time
};

enum class RangeOutcome {
  kUsed,
  kGated,
  kUnknownTag,
  kUnknownAnchor,  // or a pair of tag and anchor that the calibration lacks
  kBadValue,       // not finite, or out of bounds
  kOutOfOrder,     // older than the state: refused
  kNotStarted,
  kNotActive,    // of an anchor that finds no place: all that are active answered of late
  kNotModelled,  // the model uses no ranges
};

struct RangeResult {
  RangeOutcome outcome = RangeOutcome::kNotStarted;
  // Of ranges used or gated:
  double innovation_m = 0.0;            // measured less predicted
  double innovation_variance_m2 = 0.0;  // S, before any weight
  double nis = 0.0;                     // innovation^2 / S
  // Of S, what is not by the pose: noise, biases, anchors. NaN with the original model: without biases,
  // ranges say nothing of the map.
  double map_variance_m2 = std::numeric_limits<double>::quiet_NaN();
  double weight = 0.0;      // 0 gated, 1 full
  double blocked = 0.0;     // probability that the pair is, from its past and this range
  double hint_ratio = 1.0;  // likelihood of its powers if blocked, over that if in sight
  Eigen::Vector3d pull = Eigen::Vector3d::Zero();  // what x, y, theta were moved by
};

enum class SensorOutcome {
  kUsed,
  kGated,       // too far from what is known
  kJumped,      // a yaw rate that cannot follow the one before it
  kBadValue,    // not finite, beyond what can be, or with a covariance that can be none
  kOutOfOrder,  // older than the state: refused
  kNotStarted,
};

struct SensorResult {
  SensorOutcome outcome = SensorOutcome::kNotStarted;
  double nis = 0.0;  // innovation' S^-1 innovation, of samples used or gated
  double weight = 0.0;
};

// How many inputs had each outcome.
template <class Outcome, std::size_t kOutcomes>
class CountBy {
 public:
  std::size_t& operator[](Outcome of) noexcept { return counts_[static_cast<std::size_t>(of)]; }
  const std::size_t& operator[](Outcome of) const noexcept { return counts_[static_cast<std::size_t>(of)]; }
  CountBy& operator+=(const CountBy& other) noexcept {
    for (std::size_t i = 0; i < kOutcomes; ++i) counts_[i] += other.counts_[i];
    return *this;
  }

 private:
  std::array<std::size_t, kOutcomes> counts_{};
};

// Each input of the filter is counted once.
struct Counters {
  CountBy<OdometryOutcome, 6> odometry;
  CountBy<RangeOutcome, 9> ranges;
  std::array<CountBy<SensorOutcome, 6>, model::kSensors> sensors;  // in the order of SensorSample
  std::size_t doubts = 0;                                          // times that divergence was suspected
  std::size_t slips = 0;             // times that ranges showed odometry to be wrong
  std::size_t anchor_exchanges = 0;  // times an anchor took the place of another one
};

struct Estimate {
  double t_s = 0.0;
  model::PlanarPose pose;
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // of x_m, y_m, theta_rad
  double scale_error = 0.0;
  double yaw_rate_bias_radps = 0.0;
  double range_delay_s = 0.0;
  double odometry_delay_s = 0.0;
  // What the ground may differ by from the surface (height, dS/dx, dS/dy): variances, and covariance with the
  // pose, by row.
  Eigen::Vector3d ground_variances = Eigen::Vector3d::Zero();
  Eigen::Matrix3d ground_cross = Eigen::Matrix3d::Zero();

  // Of x_m, y_m, theta_rad and the ground, for model::on_surface.
  [[nodiscard]] Eigen::Matrix<double, 6, 6> covariance_with_ground() const noexcept;
};

class Filter {
 public:
  // All that inputs change; copying it over another one of the same filter allocates nothing.
  struct Snapshot : MotionState {
    Parameters parameters;
    Gate gate;
    SlipWatch slip_watch;
    RangeTuning tuning;
    SensorGate sensors;
    JointCovariance covariance;
    bool started = false;
    std::array<double, kMaxAnchors> last_answer_s{};  // of each slot
    std::uint64_t exchanges = 0;
    Counters counters{};
  };
  // So many exchanges of anchors can be undone.
  static constexpr std::size_t kMaxExchanges = 64;

  // Tags beyond kMaxTags are left out, and so are anchors without a finite position and covariance; anchors()
  // is how many are in.
  Filter(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
         const Config& config);

  // Begins, or begins anew, at a known pose; what was learnt of the parameters stays.
  void start(const Start& start) noexcept;
  // Begins where another filter is that has started, of the same robot, surface and configuration by another
  // calibration: with its core, the covariance of that, and the rows; unrelated to the parameters.
  void resume(const Filter& other) noexcept;
  // Back to before the first start: the time and the rows are forgotten, what was learnt of the parameters
  // stays.
  void stop() noexcept;
  [[nodiscard]] bool started() const noexcept { return now_.started; }

  OdometryOutcome process(const model::OdometrySample& row) noexcept;
  RangeResult process(const model::RangeSample& range) noexcept;
  // With any model.
  SensorResult process(const model::SensorSample& sample) noexcept;
  // Moves the state to t_s by the row held. False, and nothing done, when t_s is not a later time.
  bool advance_to(double t_s) noexcept;

  // At the time of the last input.
  [[nodiscard]] Estimate estimate() const noexcept;
  // The state as it is now, carried on by one input after the other as process() would, to the last bit (what
  // the ground adds: to rounding); the filter stays as it is. Inputs that it would refuse are passed over.
  // For a filter that has started.
  struct Prediction {
    MotionState motion;
    CoreCovariance covariance;
    bool by_odometry_alone = false;  // refused ranges do not count: see DeadReckoning
  };
  [[nodiscard]] Prediction prediction() const noexcept;
  void carry(Prediction& prediction, const MotionInput& input) const noexcept;
  [[nodiscard]] Estimate estimate(const Prediction& prediction) const noexcept {
    return estimate_of(prediction.motion, prediction.covariance);
  }
  // Beyond what the surface tells of: what it tells there is a guess.
  [[nodiscard]] bool is_off_surface() const noexcept {
    return !surface_.covers(now_.core(kX), now_.core(kY), now_.chart);
  }
  [[nodiscard]] const Counters& counters() const noexcept { return now_.counters; }
  [[nodiscard]] std::size_t anchors() const noexcept { return slots_.size(); }

  // What restore() brings back: all inputs since are as if they had never been. Of this filter, and from its
  // past; of anchors that are not active it holds nothing but how many exchanges there were. can_restore():
  // no more than kMaxExchanges since.
  [[nodiscard]] const Snapshot& snapshot() const noexcept { return now_; }
  [[nodiscard]] bool can_restore(const Snapshot& snapshot) const noexcept {
    return now_.exchanges - snapshot.exchanges <= kMaxExchanges;
  }
  void restore(const Snapshot& snapshot) noexcept;

  // For tests and diagnosis.
  [[nodiscard]] const CoreVector& core() const noexcept { return now_.core; }
  [[nodiscard]] const JointCovariance& covariance() const noexcept { return now_.covariance; }
  [[nodiscard]] const Parameters& parameters() const noexcept { return now_.parameters; }
  [[nodiscard]] const Site& site() const noexcept { return site_; }
  // Of an anchor of the site, -1 where it is not active.
  [[nodiscard]] int slot_of(int anchor) const noexcept { return slots_[static_cast<std::size_t>(anchor)]; }

 private:
  // here: the calibration as it holds on this drive.
  Filter(model::Surface surface, std::span<const model::Tag> tags, const Config& config,
         const model::Calibration& here);
  // On that floor, and nothing is known of ranges and other sensors yet.
  void begin_on(int chart) noexcept;
  OdometryOutcome take(const model::OdometrySample& row) noexcept;
  // The range's pair; kUsed where it can be taken: the state is then of its time, the anchor active.
  RangeOutcome admit(const model::RangeSample& range, PairPlace& pair) noexcept;
  RangeResult correct(const model::RangeSample& range, const PairPlace& pair) noexcept;
  // Arithmetic of the update.
  [[nodiscard]] RangeMeasurement predict(const PairPlace& pair) const noexcept;
  void project(const RangeMeasurement& predicted, const PairPlace& pair, Projected& out) noexcept;
  [[nodiscard]] RangeResult innovation(double range_m, const RangeMeasurement& predicted,
                                       double variance_m2) const noexcept;
  void update(const RangeMeasurement& predicted, const PairPlace& pair, Projected& projected,
              RangeResult& result) noexcept;
  // Policy: the range's weight; what it shows of the odometry, before it is used, and of its noise, after it.
  void weigh(const model::RangeSample& range, const PairPlace& pair, RangeResult& result) noexcept;
  void watch_slip(const PairPlace& pair, const RangeMeasurement& predicted,
                  const RangeResult& result) noexcept;
  void tune(const PairPlace& pair, const RangeResult& result) noexcept;
  template <class Sample>
  SensorResult take(const Sample& sample) noexcept;
  SensorResult use(const model::YawRateSample& sample) noexcept;
  template <class Sample>
  SensorResult use(const Sample& sample) noexcept;
  template <int kSize>
  SensorResult correct(std::size_t sensor, const CoreMeasurement<kSize>& measurement) noexcept;
  void add(const CoreVector& change) noexcept;
  [[nodiscard]] PresentPose present() const noexcept {
    return present_pose(surface_, now_.core, now_.row, delays_, now_.chart);
  }
  [[nodiscard]] DeadReckoning<JointCovariance> motion() noexcept {
    return {surface_, config_, slow_time_s_, &now_.gate, now_, now_.covariance};
  }
  template <class Covariance>
  [[nodiscard]] Estimate estimate_of(const MotionState& now, const Covariance& covariance) const noexcept;
  // The slot whose anchor was silent longest, -1 where none was silent for long enough.
  [[nodiscard]] int free_slot(double t_s) const noexcept;
  void exchange(int slot, int anchor) noexcept;
  void find_slots() noexcept;

  // One exchange, as far as it is needed to undo it and to bring the anchor back.
  struct Exchange {
    int left = 0;  // which anchor
    AnchorMemory before;
    CoreMatrix absence;  // of the time from the exchange before to this one
  };
  [[nodiscard]] Exchange& at(std::uint64_t exchange) noexcept {
    return exchanges_[static_cast<std::size_t>(exchange % kMaxExchanges)];
  }

  model::Surface surface_;
  Site site_;
  Config config_;
  LinkDelays delays_;
  double slow_time_s_ = 0.0;  // 0: there is no slow error
  Snapshot now_;
  std::vector<int> slots_;              // of each anchor of the site, -1 where it is not active
  std::vector<AnchorMemory> memories_;  // of each anchor of the site; empty where all are active
  std::vector<Exchange> exchanges_;     // a ring; empty where all are active
};

}  // namespace groma::filter
