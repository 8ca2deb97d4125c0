// Whether a pair sees each other, poll by poll: a hidden Markov chain whose data are the residuals of ranges
// and the polls that went without a reply.
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

// States: in sight; in a shadow, blocked for a moment by what moves; behind a wall, blocked for long.
enum SightState : std::uint8_t { kInSight, kShadow, kWall };
using SightVector = Eigen::Vector3d;  // one figure a state

struct SightChain {
  Eigen::Matrix3d transition;  // from the row's state to the column's, a poll; rows sum to one
  SightVector start{0.65, 0.05, 0.30};
  SightVector reply{0.95, 0.5, 0.5};  // probability that a poll is answered
};
// The transition over so long, between polls.
[[nodiscard]] Eigen::Matrix3d sight_transition(double interval_s) noexcept;

// One poll of a pair: its row, or a negative value where it has none.
using Poll = std::int32_t;
inline constexpr Poll kMissed = -1;   // no reply
inline constexpr Poll kNotTold = -2;  // nothing known of it
inline constexpr Poll kReplied = -3;  // a reply whose range is not among the rows

// The polls of each pair between its first and its last reply.
struct PollTable {
  double interval_s = 0.0;
  bool regular = false;  // polls come at equal steps: then it can be told which of them were missed
  std::vector<std::vector<std::vector<Poll>>> polls = {};  // [anchor][tag]
};
[[nodiscard]] PollTable tabulate_polls(const Association& association);
// Of all rows of one anchor those are left, by their indices so far, ascending, and numbered anew: the
// others' replies are still told.
void keep_rows(PollTable& table, std::size_t anchor, std::span<const std::size_t> kept);

// Of each poll that has a row, in order, and of all polls together.
struct SightPosterior {
  std::vector<SightVector> prior;      // from all but the row's own residual
  std::vector<SightVector> posterior;  // from all
  double log_evidence = 0.0;
  SightVector answered = SightVector::Zero();  // polls expected in each state
  SightVector missed = SightVector::Zero();
};
// Forward-backward. `likelihoods` holds the residual's density in each state, 1/m, of each poll that has a
// row, in order; `hints`, of the same, the likelihood of its powers where blocked over that in sight, or
// nothing. The result's vectors are reused.
void infer_sight(const SightChain& chain, std::span<const Poll> polls,
                 std::span<const SightVector> likelihoods, std::span<const double> hints,
                 SightPosterior& out);

// Of ranges in each class, expected: those in sight, and those that are not.
struct PowerCounts {
  std::array<double, model::kPowerClasses> in_sight{};
  std::array<double, model::kPowerClasses> blocked{};

  void add(model::PowerClass of, double in_sight_share) noexcept;
  // Of so many times those.
  void add(const PowerCounts& other, double times) noexcept;
};

class PowerHints {
 public:
  // As believed before any residual: `ranges` counts a site's ranges in each class. In sight the first path
  // is about as strong, for its length, as the strongest are; blocked it is anything. `interval_s`: between
  // ranges of a pair; those that are close are fewer to learn from.
  PowerHints(std::span<const double, model::kPowerClasses> ranges, double interval_s) noexcept;

  // Likelihood of a range's class for a blocked pair over that for one in sight, from 1/10 to 10; 1 of
  // kNoPowerClass.
  [[nodiscard]] double ratio(model::PowerClass of) const noexcept { return ratios_[of]; }
  // Counts upon what is believed, in the place of all that was learnt before.
  void learn(const PowerCounts& counts) noexcept;

 private:
  double share_ = 1.0;  // of a range in those that are one to learn from
  PowerCounts believed_;
  std::array<double, model::kPowerClasses + 1> ratios_{};
};

}  // namespace groma::calibration
