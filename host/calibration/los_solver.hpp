// Solves all anchors with NLOS states: classifies each range and solves the anchors, in turns.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/calibration/los_chain.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// NLOS model common to all pairs of a site.
struct LosModel {
  LosChain chain;
  RobustKernel short_nlos;  // of short NLOS residuals
  KernelShape long_nlos;    // of long NLOS residuals without their excess
  LongNlosPrior excess_prior;
  std::optional<PowerHints> powers;  // none if ranges carry no powers
};
[[nodiscard]] LosModel first_los_model(const PollTable& table, std::span<const AnchorFit> fits);

// For each observation of one anchor: whether replies and powers alone classify it as LOS.
[[nodiscard]] std::vector<bool> los_rows(const LosModel& model, std::span<const std::vector<Poll>> pairs,
                                         std::span<const Observation> rows);

struct SiteLos {
  std::vector<AnchorLos> anchors;      // empty: no NLOS states needed; the fits point here
  std::vector<LosVector> poll_shares;  // per anchor: share of its polls in each state
  LosModel model;                      // as estimated
};

// Whether nearly all ranges are as short as in a hall or a yard, where the NLOS model holds. On longer ones
// replies are lost to weak signals, hills and trees are no walls, and each half of a drive sees an anchor
// from one side only.
[[nodiscard]] bool is_within_reach(const std::vector<AnchorFit>& fits) noexcept;

// Whether ranges are NLOS for longer than a moment; for fits within reach. A fit on the wrong side of the
// tags has similar residuals: such fits are tested against their mirror hypotheses, and move where these are
// better.
[[nodiscard]] bool needs_nlos_states(const PollTable& table, std::vector<AnchorFit>& fits);

// Classifies each range and solves the fits with these states if they are needed; drops those of an earlier
// call. `table` is of the same observations.
void find_nlos(const PollTable& table, std::vector<AnchorFit>& fits, SiteLos& los_states);

// The same whether they are needed or not, starting from a model.
[[nodiscard]] SiteLos solve_los(const PollTable& table, const LosModel& start, std::vector<AnchorFit>& fits);

}  // namespace groma::calibration
