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
#include "host/filter/state.hpp"
#include "host/model/power_class.hpp"

namespace groma::filter {

// Of a Gaussian plus an exponential excess of that mean, the mean square of the excess, given such an error,
// m^2.
[[nodiscard]] double excess_square(double error_m, double sigma_m, double mean_m) noexcept;

// The kinds of error that the gate separates, 1/m. The first two: of a range that is not garbage; blocked
// ones are too long, or by short_share too short.
struct RangeDensities {
  double in_sight = 0.0;
  double blocked = 0.0;
  double far = 0.0;            // the part of blocked with the larger excess of a pair that misses polls
  double garbage = 0.0;        // with its share,
  double garbage_share = 0.0;  // which is this
};
// missed: the share of its polls that the pair missed of late.
[[nodiscard]] RangeDensities range_densities(double error_m, double sigma_m, const GateConfig& config,
                                             double missed = 0.0) noexcept;

// What the powers of a range tell of its pair's sight: learnt on the site itself, by what innovations say. A
// range falls into one class, and how often either state gives the class is counted. The counts begin with
// what the chip's maker tells of the first and with nothing of the second: a hint that is wrong here, or
// tells nothing, soon has a likelihood ratio of 1.
class SightHint {
 public:
  explicit SightHint(const GateConfig& config) noexcept : config_(config) {}

  // Of a blocked pair over one in sight, from 1/hint_most to hint_most; 1 of kNoPowerClass.
  [[nodiscard]] double likelihood_ratio(model::PowerClass of) const noexcept;
  // Of all ranges that were learnt from.
  [[nodiscard]] double blocked_share() const noexcept;
  // Takes note of a range of that class at t_s, held for blocked and for in sight by those shares.
  void learn(model::PowerClass of, double t_s, double blocked, double in_sight) noexcept;

 private:
  struct Counts {
    std::array<double, model::kPowerClasses> of{};
    double all = 0.0;
  };
  // Of a class in a state.
  [[nodiscard]] double share(const Counts& counts, const std::array<double, model::kHiddenClasses>& believed,
                             model::PowerClass of) const noexcept;

  GateConfig config_;
  // Counts fade: in place of all that were, what one more is worth grows with time.
  Counts blocked_;
  Counts in_sight_;
  double unit_ = 1.0;
  double t_s_ = 0.0;
};

class Gate {
 public:
  explicit Gate(const GateConfig& config);

  // Weight in [0, 1] of an innovation of that variance by a pair of slots at t_s, of a range of that class,
  // and takes note of it. 0 turns the range away; so does what is not a number.
  [[nodiscard]] double weigh(int anchor, int tag, double t_s, double innovation_m, double variance_m2,
                             model::PowerClass hint = model::kNoPowerClass) noexcept;

  // Variance to be added to the noise of the pair's last range: a pair that was silent is often still blocked
  // when it is heard again, and all its anchor's ranges of that while are off together.
  [[nodiscard]] double regained_variance_m2(int anchor, int tag) const noexcept {
    return pairs_[pair_at(anchor, tag)].regained_m2;
  }
  // Probability that the pair is blocked, as of its last range.
  [[nodiscard]] double blocked(int anchor, int tag) const noexcept {
    return pairs_[pair_at(anchor, tag)].blocked;
  }

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

    void add(double at_s, double window_s, double innovation_m, double weight) noexcept;
    [[nodiscard]] bool refuses() const noexcept;
  };

  // What a range is, by the probability that its pair was blocked before it.
  struct Posterior {
    double in_sight = 0.0;
    double blocked = 0.0;       // what is left is garbage
    double far = 0.0;           // of blocked: by as much as after a silence
    double pair_blocked = 0.0;  // after it
  };
  [[nodiscard]] Posterior judge(const RangeDensities& density, double prior) const noexcept;

  // Takes note that the pair was heard.
  Reception listen(int anchor, Pair& pair, double t_s) noexcept;
  // Probability that the pair is blocked, before its range is seen.
  [[nodiscard]] double expect_blocked(int anchor, const Pair& pair, double t_s) const noexcept;
  void observe(int anchor, double t_s, double innovation_m, double weight) noexcept;
  [[nodiscard]] bool anchors_refuse(double t_s) const noexcept;

  GateConfig config_;
  SightHint hint_;
  std::array<Pair, kMaxPairs> pairs_{};
  double poll_interval_s_ = 0.0;  // median of the gaps between a pair's ranges; 0: not known yet
  double t_s_ = 0.0;
  Tally all_;
  std::array<Tally, kMaxAnchors> anchors_{};
  bool doubts_ = false;
  std::size_t doubts_begun_ = 0;
};

}  // namespace groma::filter
