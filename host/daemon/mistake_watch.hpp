// Looks for mistakes in what gromad receives: every now and then, as `groma replay` does with a recorded
// drive, in the last two minutes of odometry and ranges.
//
//   MistakeWatch watch({.priors = ..., .surface = ...});
//   session.attach(watch);
//   watch.use(calibration, tags);
//   watch.service(now_s);  // on each tick
//   watch.findings();
//
// The measurements are stored without the heap. The search has a thread of its own with a low priority, and
// rests for fifty times as long as it computed, so that it takes 2 % of a core at most.
#pragma once

#include <cstddef>
#include <cstdint>
#include <future>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/daemon/measurement_sink.hpp"
#include "host/diagnosis/data.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/model/anchor_parameters.hpp"
#include "host/model/calibration.hpp"
#include "host/model/surface.hpp"
#include "host/model/types.hpp"

namespace groma::daemon {

// The last N samples. Its memory is touched at once, so that it does not grow while samples arrive.
template <class Sample>
class SampleRing {
 public:
  explicit SampleRing(std::size_t capacity) : capacity_(capacity), samples_(capacity) { samples_.clear(); }

  void push(const Sample& sample) noexcept {
    if (samples_.size() < capacity_) return samples_.push_back(sample);
    samples_[next_] = sample;
    next_ = (next_ + 1) % capacity_;
  }
  void clear() noexcept {
    samples_.clear();
    next_ = 0;
  }
  // In the order of arrival, those since a time.
  [[nodiscard]] std::vector<Sample> since(double t_s) const {
    std::vector<Sample> out;
    out.reserve(samples_.size());
    for (std::size_t i = 0; i < samples_.size(); ++i) {
      const Sample& sample = samples_[(next_ + i) % samples_.size()];
      if (sample.t_s >= t_s) out.push_back(sample);
    }
    return out;
  }

 private:
  std::size_t capacity_;
  std::size_t next_ = 0;  // the oldest, once it is full
  std::vector<Sample> samples_;
};

class MistakeWatch : public MeasurementSink {
 public:
  // By hand, of robot time: what is searched, and the least of it; a search needs windows over a minute.
  static constexpr double kKept_s = 120.0;
  static constexpr double kLeast_s = 70.0;
  // Between searches, of the loop's time.
  static constexpr double kPeriod_s = 60.0;
  static constexpr double kRest = 50.0;  // in durations of a search
  // A robot that moved by less shows nothing. By hand.
  static constexpr double kLeastMotion_m = 5.0;

  struct Setup {
    model::RangePriors priors;
    model::Surface surface;
    bool learns = false;       // anchors that the calibration lacks are no mistake
    int search_niceness = 10;  // localization has priority
  };

  explicit MistakeWatch(Setup setup);
  // Waits for a search.
  ~MistakeWatch() override = default;
  MistakeWatch(const MistakeWatch&) = delete;
  MistakeWatch& operator=(const MistakeWatch&) = delete;

  // From now on. What another calibration showed is forgotten.
  void use(model::Calibration calibration, std::vector<model::Tag> tags);

  void on_odometry(const model::OdometrySample& sample) override;
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& /*pose*/) override {}
  void on_clock_set() override;
  void on_clock_step(double /*step_s*/, bool /*found_late*/) override { on_clock_set(); }

  // Collects what is done and starts what is due; never waits. now_s never decreases.
  void service(double now_s);

  // Those of the last search that the one before had too, most likely first.
  [[nodiscard]] const std::vector<diagnosis::Finding>& findings() const noexcept { return findings_; }
  // A line for each cause that is new since the last call.
  [[nodiscard]] std::vector<std::string> take_news();

 private:
  struct Search {
    std::vector<diagnosis::Finding> findings;
    double took_s = 0.0;  // of a processor
  };

  [[nodiscard]] bool is_due(double now_s) const noexcept;
  [[nodiscard]] diagnosis::Data data() const;
  void take(Search search);
  void forget();

  Setup setup_;
  std::optional<model::Calibration> calibration_;
  std::vector<model::Tag> tags_;
  SampleRing<model::OdometrySample> odometry_;
  SampleRing<model::RangeSample> ranges_;
  // The mean velocity since mean_.t_s, and how long it was measured for.
  model::OdometrySample mean_;
  double mean_over_s_ = 0.0;
  std::optional<model::OdometrySample> held_;
  double begin_s_;        // robot time of the first sample
  double newest_s_;       // likewise
  double moved_m_ = 0.0;  // since the last search
  std::uint64_t ranges_seen_ = 0;
  std::uint64_t ranges_this_second_ = 0;
  double second_s_;
  double share_kept_ = 1.0;

  std::future<Search> search_;
  bool is_void_ = false;  // the search began before the data or the calibration changed
  double next_search_s_ = 0.0;
  std::vector<diagnosis::Finding> before_;  // of the search before the last
  std::vector<diagnosis::Finding> findings_;
  std::vector<std::string_view> news_;  // causes that were logged, and are not gone
};

}  // namespace groma::daemon
