// What weight a range deserves, from its innovation and from what its pair did before; apart from the
// update, and unable to lock itself out.
//
// A pair is in sight (innovation Gaussian with the filter's own variance) or goes wrong (an exponential
// excess on top: blocked ranges are too long, those of a wrong calibration may be too short), and stays so
// for a while; any single range may be garbage. The weight is the posterior probability of being in sight,
// less what is taken from innovations beyond the knee, and from ranges whose powers tell of an obstacle.
#pragma once

#include <array>
#include <cstddef>

#include "host/filter/config.hpp"
#include "host/filter/range_density.hpp"
#include "host/filter/sight_hint.hpp"
#include "host/filter/state.hpp"

namespace groma::filter {

class Gate {
 public:
  explicit Gate(const GateConfig& config);

  // Weight in [0, 1] of an innovation of that variance by a pair of slots at t_s, of a range of that class,
  // and takes note of it. 0 turns the range away; so does what is not a number.
  [[nodiscard]] double weigh(int anchor, int tag, double t_s, double innovation_m, double variance_m2,
                             model::PowerClass hint = model::kNoPowerClass) noexcept;

  // Variance to be added to the noise of the pair's last range: a pair that was silent is often still blocked
  // when it is heard again, and all its anchor's ranges of that while are off together.
  [[nodiscard]] double regained_variance_m2(int anchor, int tag) const noexcept;
  // Probability that the pair is blocked, as of its last range.
  [[nodiscard]] double blocked(int anchor, int tag) const noexcept;

  // What powers tell here.
  [[nodiscard]] const SightHint& hint() const noexcept { return hint_; }

  // Not the ranges, the state is wrong: see GateConfig. Where no ranges come there is no doubt either.
  [[nodiscard]] bool doubts(double t_s) const noexcept;
  // Times that a doubt began.
  [[nodiscard]] std::size_t doubts_begun() const noexcept { return doubts_begun_; }
  // Another anchor comes into a slot.
  void renew(int anchor, double t_s) noexcept;
  // Forgets everything but the count and what powers tell.
  void reset(double t_s) noexcept;

 private:
  struct Pair {
    double t_s = 0.0;
    double blocked = 0.0;    // with the hint of its last range
    double unhinted = 0.0;   // by innovations alone
    double reception = 1.0;  // share of its polls of late that were answered
    double regained_m2 = 0.0;
    bool heard = false;
  };

  struct Reception {
    double missed = 0.0;  // share of the pair's polls of late, beyond what is usual
    double alike = 0.0;   // ranges of the anchor that are off together with one, itself included
  };

  // Sums over ranges that fade with time.
  struct Tally {
    double t_s = 0.0;
    double seen = 0.0;
    double refused = 0.0;
    double refused_m = 0.0;  // refused times the innovation's size

    void fade(double until_s, double window_s) noexcept;
    void add(double innovation_m, double weight) noexcept;
    [[nodiscard]] bool refuses(double share) const noexcept;
  };

  // What a range is, by the probability that its pair was blocked before it.
  struct Posterior {
    double in_sight = 0.0;
    double blocked = 0.0;       // what is left is garbage
    double far = 0.0;           // of blocked: by as much as after a silence
    double pair_blocked = 0.0;  // after it
  };
  [[nodiscard]] Posterior judge(const RangeDensities& density, double prior) const noexcept;

  Pair& pair(int anchor, int tag) noexcept;
  // Takes note that the pair was heard.
  Reception listen(int anchor, Pair& pair, double t_s) noexcept;
  // Probability that the pair is blocked, before its range is seen.
  [[nodiscard]] double expect_blocked(int anchor, const Pair& pair, double t_s) const noexcept;
  void observe(int anchor, double t_s, double innovation_m, double weight) noexcept;
  [[nodiscard]] bool anchors_refuse(double t_s) const noexcept;

  GateConfig config_;
  SightHint hint_;
  std::array<Pair, static_cast<std::size_t>(kMaxAnchors) * kMaxTags> pairs_{};
  double poll_interval_s_ = 0.0;  // median of the gaps between a pair's ranges; 0: not known yet
  double t_s_ = 0.0;
  Tally all_;
  std::array<Tally, kMaxAnchors> anchors_{};
  bool doubts_ = false;
  std::size_t doubts_begun_ = 0;
};

}  // namespace groma::filter
