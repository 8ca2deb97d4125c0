// LOS or NLOS of a pair, poll by poll: a hidden Markov chain, observed by range residuals, missed replies and
// received powers.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include <Eigen/Core>

#include "host/calibration/association.hpp"
#include "host/model/power_class.hpp"

namespace groma::calibration {

// States: LOS; short NLOS, caused by something that moves; long NLOS, caused by something fixed.
enum LosState : std::uint8_t { kLos, kShortNlos, kLongNlos };
using LosVector = Eigen::Vector3d;  // one value per state

// By hand. `start` is near the stationary distribution of los_transition(), (0.61, 0.10, 0.29). The reply
// probabilities are only priors if polls are regular; the NlosSite tests hold with 0.95, 0.6 and 0.45.
struct LosChain {
  Eigen::Matrix3d transition;  // per poll, from the row's state to the column's; rows sum to one
  LosVector start{0.65, 0.05, 0.30};
  LosVector reply{0.95, 0.5, 0.5};  // probability that a poll is answered
};
// Transition matrix over `interval_s`.
[[nodiscard]] Eigen::Matrix3d los_transition(double interval_s) noexcept;

// One poll of a pair: the index of its observation, or a negative value if it has none.
using Poll = std::int32_t;
inline constexpr Poll kMissed = -1;       // no reply
inline constexpr Poll kUnknownPoll = -2;  // unknown
inline constexpr Poll kReplied = -3;      // a reply whose range is not among the observations

// The polls of each pair between its first and its last reply.
struct PollTable {
  double interval_s = 0.0;
  bool regular = false;  // polls are equally spaced, so that missed ones can be identified
  std::vector<std::vector<std::vector<Poll>>> polls = {};  // [anchor][tag]
};
[[nodiscard]] PollTable tabulate_polls(const Association& association);
// Keeps the observations `kept` (ascending indices) of one anchor and renumbers them; the others still count
// as replies.
void keep_rows(PollTable& table, std::size_t anchor, std::span<const std::size_t> kept);

// For each poll with an observation, in order, and for all polls together.
struct LosPosterior {
  std::vector<LosVector> prior;      // from all data except its own residual
  std::vector<LosVector> posterior;  // from all data
  double log_evidence = 0.0;
  LosVector answered = LosVector::Zero();  // expected number of polls in each state
  LosVector missed = LosVector::Zero();
};
// Forward-backward algorithm. `likelihoods` holds the density of the residual in each state, 1/m, for each
// poll with an observation, in order, or nothing; `hints` the likelihood ratio of its powers, NLOS over LOS,
// or nothing. Reuses the vectors of `out`.
void infer_states(const LosChain& chain, std::span<const Poll> polls, std::span<const LosVector> likelihoods,
                  std::span<const double> hints, LosPosterior& out);

// Expected numbers of LOS and of NLOS ranges in each power class.
struct PowerCounts {
  std::array<double, model::kPowerClasses> los{};
  std::array<double, model::kPowerClasses> blocked{};

  void add(model::PowerClass of, double los_share) noexcept;
  // Adds `times` times the other's.
  void add(const PowerCounts& other, double times) noexcept;
};

class PowerHints {
 public:
  // Prior before any residual; `ranges` counts a site's ranges in each class. In LOS the first path is about
  // as strong, for its length, as the strongest are; in NLOS any strength is as likely. `interval_s`: between
  // ranges of a pair; ranges close in time count less.
  PowerHints(std::span<const double, model::kPowerClasses> ranges, double interval_s) noexcept;

  // Likelihood of a power class in NLOS over that in LOS, from 1/10 to 10; 1 for kNoPowerClass.
  [[nodiscard]] double ratio(model::PowerClass of) const noexcept { return ratios_[of]; }
  // Whether the first path is too weak for a line of sight, by a site's ranges so far: such a range may come
  // around an edge, late by a little, and that changes smoothly along a drive. False if the strength is
  // unknown, and before estimate().
  [[nodiscard]] bool is_weak(model::PowerClass of) const noexcept;
  // Adds the counts to the prior, in place of all earlier counts.
  void estimate(const PowerCounts& counts) noexcept;

 private:
  [[nodiscard]] bool is_below_usual(model::PowerClass of) const noexcept;

  double share_ = 1.0;     // weight of one range
  std::size_t usual_ = 0;  // strength class of a typical LOS range
  bool weak_is_nlos_ = false;
  PowerCounts believed_;
  std::array<double, model::kPowerClasses + 1> ratios_{};
};

}  // namespace groma::calibration
