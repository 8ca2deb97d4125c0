// The terrain-informed error-state filter (M-ESEKF of the source paper). Odometry propagates a pose on the
// surface, ranges correct it, and the calibration parameters are consider (Schmidt) states or estimated.
//
//   filter::Filter filter(surface, tags, calibration, config);
//   filter.start({.t_s = 12.0, .pose = {x, y, theta}});
//   filter.process(odometry_sample);
//   filter.process(range);
//   filter.estimate();
//
// No clock, no I/O, no log, no exceptions, no allocation after construction. Inputs come in time order; each
// call returns the outcome of its input.
#pragma once

#include <vector>

#include "host/filter/dead_reckoning.hpp"
#include "host/filter/joint_covariance.hpp"
#include "host/filter/sensors.hpp"

namespace groma::filter {

struct Start {
  double t_s = 0.0;
  model::PlanarPose pose = {};
  // By hand, used if the start has none; filter_campaign draws starts with them.
  double position_sigma_m = 0.1;
  double heading_sigma_rad = 0.05;
};

enum class OdometryOutcome {
  kUsed,
  kUsedLate,     // older than the state, newer than the sample held: applies from the state's time on
  kStored,       // before the start: held until then
  kOutOfOrder,   // not newer than the sample held: refused
  kBadValue,     // not finite: refused
  kImplausible,  // physically impossible: dropped; the previous sample is held until its time
};

enum class RangeOutcome {
  kUsed,
  kGated,
  kUnknownTag,
  kUnknownAnchor,  // or the calibration lacks this pair of tag and anchor
  kBadValue,       // not finite, or out of bounds
  kOutOfOrder,     // older than the state: refused
  kNotStarted,
  kNotActive,    // no free slot for this anchor: all active anchors answered recently
  kNotModelled,  // Model::kOdometry uses no ranges
};

struct RangeResult {
  RangeOutcome outcome = RangeOutcome::kNotStarted;
  // The following are set for ranges that were used or gated.
  double innovation_m = 0.0;            // measured minus predicted
  double innovation_variance_m2 = 0.0;  // S, without weight
  double nis = 0.0;                     // innovation^2 / S
  // S without the contribution of the pose: noise, biases, anchors. NaN with the original model, whose
  // ranges cannot test the map because it has no biases.
  double map_variance_m2 = std::numeric_limits<double>::quiet_NaN();
  double weight = 0.0;                // 0 gated, 1 full
  double regained_variance_m2 = 0.0;  // of its noise, after a silence of the pair: see gate.hpp
  double nlos = 0.0;                  // probability of NLOS, from the pair's history and this range
  double hint_ratio = 1.0;            // likelihood ratio NLOS / LOS of its received powers
  Eigen::Vector3d correction = Eigen::Vector3d::Zero();  // correction of x, y, theta
};

enum class SensorOutcome {
  kUsed,
  kGated,       // beyond the gate
  kJumped,      // a yaw rate that is implausible after the previous one
  kBadValue,    // not finite, out of bounds, or with an invalid covariance
  kOutOfOrder,  // older than the state: refused
  kNotStarted,
};

struct SensorResult {
  SensorOutcome outcome = SensorOutcome::kNotStarted;
  double nis = 0.0;  // innovation' S^-1 innovation, of samples that were used or gated
  double weight = 0.0;
};

// Number of inputs for each outcome.
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

// Each input is counted exactly once.
struct Counters {
  CountBy<OdometryOutcome, 6> odometry;
  CountBy<RangeOutcome, 9> ranges;
  std::array<CountBy<SensorOutcome, 6>, model::kSensors> sensors;  // in the order of SensorSample
  std::size_t divergences = 0;                                     // how often divergence was suspected
  std::size_t slips = 0;                                           // wheel slips detected by ranges
  std::size_t anchor_exchanges = 0;  // how often an anchor replaced another one in its slot
};

struct Estimate {
  double t_s = 0.0;
  model::PlanarPose pose;
  Eigen::Matrix3d covariance = Eigen::Matrix3d::Zero();  // of x_m, y_m, theta_rad
  // Of base_link in base_link: vx, vy (m/s) and yaw rate (rad/s), by the odometry held, corrected by the
  // estimated errors. NaN before the first odometry sample.
  Eigen::Vector3d velocity = Eigen::Vector3d::Constant(std::numeric_limits<double>::quiet_NaN());
  Eigen::Matrix3d velocity_covariance = Eigen::Matrix3d::Constant(std::numeric_limits<double>::quiet_NaN());
  double scale_error = 0.0;
  double yaw_rate_bias_radps = 0.0;
  double range_delay_s = 0.0;
  double odometry_delay_s = 0.0;
  // The ground's deviation from the surface model (height in m, dS/dx, dS/dy): its variances, and its
  // covariance with the pose, one row for each.
  Eigen::Vector3d ground_variances = Eigen::Vector3d::Zero();
  Eigen::Matrix3d ground_cross = Eigen::Matrix3d::Zero();

  // Covariance of x_m, y_m, theta_rad and the ground's deviation, for model::on_surface.
  [[nodiscard]] Eigen::Matrix<double, 6, 6> covariance_with_ground() const noexcept;
};

class Filter {
 public:
  // Everything that inputs change. Assigning it to another snapshot of the same filter allocates nothing.
  struct Snapshot : MotionState {
    Parameters parameters;
    Gate gate;
    SlipWatch slip_watch;
    RangeTuning tuning;
    SensorGate sensors;
    JointCovariance covariance;
    bool started = false;
    std::array<double, kMaxAnchors> last_answer_s{};  // time of the last range in each slot
    Counters counters{};

    void archive(model::StateArchive& state) {
      state(static_cast<MotionState&>(*this), parameters, gate, slip_watch, tuning, sensors, covariance,
            started, last_answer_s, counters);
    }
  };
  // Number of anchor exchanges that restore() can undo. A size; after as many, an absent anchor's covariance
  // with the core counts as zero.
  static constexpr std::size_t kMaxExchanges = 64;

  // Tags beyond kMaxTags are left out, and so are anchors without a finite position and covariance; anchors()
  // is the number of anchors used.
  Filter(model::Surface surface, std::span<const model::Tag> tags, const model::Calibration& calibration,
         const Config& config);

  // Initializes or re-initializes the core at a known pose; the parameters' estimates stay.
  void start(const Start& start) noexcept;
  // Takes over the core state, its covariance and the odometry of another started filter with the same robot,
  // surface and configuration but another calibration. The core is then uncorrelated with the parameters.
  void resume(const Filter& other) noexcept;
  // Back to before the first start: forgets the time and the odometry; the parameters' estimates stay.
  void stop() noexcept;
  [[nodiscard]] bool started() const noexcept { return now_.started; }

  OdometryOutcome process(const model::OdometrySample& sample) noexcept;
  RangeResult process(const model::RangeSample& range) noexcept;
  // Works with every model.
  SensorResult process(const model::SensorSample& sample) noexcept;
  // Propagates the state to t_s with the odometry held. Returns false and does nothing if t_s is not later.
  bool advance_to(double t_s) noexcept;

  // At the time of the last input.
  [[nodiscard]] Estimate estimate() const noexcept;
  // A copy of the state that carry() propagates by odometry and yaw rates as process() would, bit for bit
  // (the ground's contribution: up to rounding). The filter does not change. Inputs that process() would
  // refuse are skipped. Requires a started filter.
  struct Prediction {
    MotionState motion;
    CoreCovariance covariance;
    bool by_odometry_alone = false;  // ignores suspected divergence: see DeadReckoning
  };
  [[nodiscard]] Prediction prediction() const noexcept;
  void carry(Prediction& prediction, const MotionInput& input) const noexcept;
  [[nodiscard]] Estimate estimate(const Prediction& prediction) const noexcept;
  // The pose is outside the surface model's domain, where heights are extrapolated.
  [[nodiscard]] bool is_off_surface() const noexcept {
    return !surface_.covers(now_.core(kX), now_.core(kY), now_.chart);
  }
  [[nodiscard]] const Counters& counters() const noexcept { return now_.counters; }
  [[nodiscard]] std::size_t anchors() const noexcept {
    return static_cast<std::size_t>(site_.anchor_count());
  }

  // restore() undoes all inputs since a snapshot of this filter. The snapshot holds no state of inactive
  // anchors, only the number of exchanges; can_restore() is false after more than kMaxExchanges since then.
  [[nodiscard]] const Snapshot& snapshot() const noexcept { return now_; }
  [[nodiscard]] bool can_restore(const Snapshot& snapshot) const noexcept {
    return now_.counters.anchor_exchanges - snapshot.counters.anchor_exchanges <= kMaxExchanges;
  }
  void restore(const Snapshot& snapshot) noexcept;

  // Of a filter with the same calibration and configuration.
  void archive(model::StateArchive& state) { state(now_, memories_, exchanges_); }

  // For tests and diagnostics.
  [[nodiscard]] const CoreVector& core() const noexcept { return now_.core; }
  [[nodiscard]] const JointCovariance& covariance() const noexcept { return now_.covariance; }
  [[nodiscard]] const Parameters& parameters() const noexcept { return now_.parameters; }
  [[nodiscard]] const Site& site() const noexcept { return site_; }

 private:
  // here: the calibration, adapted to another drive than its own.
  Filter(model::Surface surface, std::span<const model::Tag> tags, const Config& config,
         const model::Calibration& here);
  // Starts on that chart, with empty gates and without memory of earlier ranges and other sensors.
  void begin_on_chart(int chart) noexcept;
  OdometryOutcome take(const model::OdometrySample& sample) noexcept;
  // Finds the range's pair. kUsed if the range is valid: then the state is at its time and its anchor active.
  RangeOutcome admit(const model::RangeSample& range, PairPlace& pair) noexcept;
  RangeResult correct(const model::RangeSample& range, const PairPlace& pair) noexcept;
  // Arithmetic of the update. predict(): z_n of (12), or of (4) with the original model, and its Jacobians.
  [[nodiscard]] RangeMeasurement predict(const PairPlace& pair) const noexcept;
  // P Hᵀ and H P Hᵀ, with the parameters' contribution as the model has it.
  void project(const RangeMeasurement& predicted, const PairPlace& pair, Projected& out) noexcept;
  // The residual of (17), S = H P Hᵀ + R with variance_m2 = H P Hᵀ, and NIS.
  [[nodiscard]] RangeResult innovation(double range_m, const RangeMeasurement& predicted,
                                       double variance_m2) const noexcept;
  // Kalman update of the core, consider (Schmidt) update of the parameters.
  void update(const RangeMeasurement& predicted, Projected& projected, RangeResult& result) noexcept;
  // Policy: weight of the range; slip detection before the update; noise tuning after it.
  void weigh(const model::RangeSample& range, const PairPlace& pair, RangeResult& result) noexcept;
  void watch_slip(const PairPlace& pair, const RangeMeasurement& predicted,
                  const RangeResult& result) noexcept;
  void tune(const PairPlace& pair, const RangeResult& result) noexcept;
  template <class Sample>
  SensorResult take(const Sample& sample) noexcept;
  template <int kSize>
  SensorResult correct(std::size_t sensor, const CoreMeasurement<kSize>& measurement) noexcept;
  void add(const CoreVector& change) noexcept;
  [[nodiscard]] DeadReckoning<JointCovariance> motion() noexcept {
    return {surface_, config_, range_bias_length_m_, &now_.gate, now_, now_.covariance};
  }
  // The slot whose anchor was silent longest; -1 if none was silent for silent_s.
  [[nodiscard]] int free_slot(double t_s) const noexcept;
  void exchange(int slot, int anchor) noexcept;

  // What is needed to undo one exchange and to re-activate the anchor that was removed.
  struct Exchange {
    int left = 0;  // index of the anchor that was removed
    AnchorMemory before;
    CoreMatrix absence;  // JointCovariance::take_absence() from the previous exchange to this one
  };
  [[nodiscard]] Exchange& at(std::size_t exchange) noexcept { return exchanges_[exchange % kMaxExchanges]; }

  model::Surface surface_;
  Site site_;
  Config config_;
  LinkDelays delays_;
  double range_bias_length_m_ = 0.0;  // 0: no slow range bias
  Snapshot now_;
  std::vector<AnchorMemory> memories_;  // of each anchor of the site; empty if all are active
  std::vector<Exchange> exchanges_;     // ring buffer; empty if all are active
};

}  // namespace groma::filter
