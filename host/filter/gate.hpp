// The gate: weight of a range from its innovation and its pair's history. It is independent of the update. It
// also detects divergence, so that a wrong state does not refuse the right ranges for good.
//
// A pair is LOS (Gaussian innovation with the filter's variance S) or NLOS (plus an exponential excess). The
// pair keeps its state for a while. Any single range may be garbage. The weight is the posterior probability
// of LOS, reduced for ranges whose received powers hint at NLOS.
#pragma once

#include <array>
#include <cstddef>

#include "host/filter/config.hpp"
#include "host/filter/state.hpp"
#include "host/model/power_class.hpp"

namespace groma::filter {

// An error is the sum of zero-mean Gaussian noise and an exponential excess of mean mean_m. Returns the mean
// square of the excess given the error, m^2.
[[nodiscard]] double excess_square(double error_m, double sigma_m, double mean_m) noexcept;

// LOS/NLOS hint by the received powers of a range, estimated on site with the innovations as reference. Each
// range falls into one power class; the hint counts how often LOS and NLOS ranges have that class. The prior
// counts are the chip manufacturer's for the power beside the first path, and uniform for the first path's
// strength. A class that is wrong or carries no information here soon gets a likelihood ratio of 1.
class PowerHint {
 public:
  explicit PowerHint(const GateConfig& config) noexcept : config_(config) {}

  // Likelihood ratio NLOS / LOS of a class, from 1/hint_most to hint_most; 1 for kNoPowerClass.
  [[nodiscard]] double likelihood_ratio(model::PowerClass of) const noexcept;
  // Share of NLOS among all ranges counted.
  [[nodiscard]] double nlos_share() const noexcept;
  // Counts a range of that class at t_s, as NLOS and as LOS with those probabilities.
  void observe(model::PowerClass of, double t_s, double nlos, double los) noexcept;

 private:
  struct Counts {
    std::array<double, model::kPowerClasses> of{};
    double all = 0.0;
  };
  // Probability of a class given LOS or NLOS.
  [[nodiscard]] double share(const Counts& counts, const std::array<double, model::kHiddenClasses>& believed,
                             model::PowerClass of) const noexcept;

  GateConfig config_;
  // Counts decay exponentially: instead of scaling all counts down, the unit of one more count grows.
  Counts nlos_;
  Counts los_;
  double unit_ = 1.0;
  double t_s_ = 0.0;
};

class Gate {
 public:
  explicit Gate(const GateConfig& config);

  // Returns the weight in [0, 1] of a range of the pair (slot of the anchor, tag) at t_s with that
  // innovation, variance S and power class, and updates the pair's history. 0 rejects the range; it also
  // results from values that are not finite.
  [[nodiscard]] double weigh(int anchor, int tag, double t_s, double innovation_m, double variance_m2,
                             model::PowerClass hint = model::kNoPowerClass) noexcept;

  // Additional noise variance of the pair's last range: a pair that answers again after a silence is often
  // still NLOS, and the errors of all ranges of its anchor are then correlated.
  [[nodiscard]] double regained_variance_m2(int anchor, int tag) const noexcept {
    return pairs_[pair_at(anchor, tag)].regained_m2;
  }
  // Probability that the pair is NLOS, as of its last range.
  [[nodiscard]] double nlos(int anchor, int tag) const noexcept { return pairs_[pair_at(anchor, tag)].nlos; }

  [[nodiscard]] const PowerHint& hint() const noexcept { return hint_; }

  // Whether divergence is suspected: the state is wrong rather than the ranges (see gate.cpp). False after
  // window_s without a range.
  [[nodiscard]] bool suspects_divergence(double t_s) const noexcept;
  // How often divergence became suspected.
  [[nodiscard]] std::size_t divergences() const noexcept { return divergences_; }
  // Forgets a slot's history: another anchor is active there.
  void renew(int anchor, double t_s) noexcept;
  // Forgets the pairs' history and the sums of the divergence test.
  void reset(double t_s) noexcept;

 private:
  struct Pair {
    double t_s = 0.0;
    double nlos = 0.0;       // NLOS probability, with the power hint of the last range
    double unhinted = 0.0;   // NLOS probability by innovations alone
    double reception = 1.0;  // share of the recent polls that were answered
    double regained_m2 = 0.0;
    bool heard = false;
  };

  struct Reception {
    double missed = 0.0;  // share of the pair's recent polls without an answer, beyond the usual share
    double alike = 0.0;   // number of the anchor's ranges with correlated errors, this one included
  };

  // Sums over ranges with exponential forgetting.
  struct Tally {
    double t_s = 0.0;
    double seen = 0.0;
    double refused = 0.0;
    double refused_m = 0.0;  // sum of (1 - weight) |innovation|

    void add(double at_s, double window_s, double innovation_m, double weight) noexcept;
    [[nodiscard]] bool refuses() const noexcept;
  };

  // Updates the pair's reception.
  Reception update_reception(int anchor, Pair& pair, double t_s) noexcept;
  // Prior NLOS probability of the pair, before its range.
  [[nodiscard]] double prior_nlos(int anchor, const Pair& pair, double t_s) const noexcept;
  void observe(int anchor, double t_s, double innovation_m, double weight) noexcept;
  [[nodiscard]] bool anchors_refuse(double t_s) const noexcept;

  GateConfig config_;
  PowerHint hint_;
  std::array<Pair, kMaxPairs> pairs_{};
  double poll_interval_s_ = 0.0;  // 0.9 quantile of the gaps between a pair's ranges; 0: unknown
  double t_s_ = 0.0;
  double began_s_ = 0.0;
  bool start_fits_ = false;
  Tally all_;
  std::array<Tally, kMaxAnchors> anchors_{};
  bool suspects_divergence_ = false;
  std::size_t divergences_ = 0;
};

}  // namespace groma::filter
