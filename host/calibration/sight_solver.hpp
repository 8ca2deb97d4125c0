// All anchors once more where ranges come through something: each row's sight and the anchors in turns.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include "host/calibration/anchor_solver.hpp"
#include "host/calibration/association.hpp"
#include "host/calibration/sight_chain.hpp"
#include "host/calibration/site_solver.hpp"
#include "host/model/types.hpp"

namespace groma::calibration {

// What all pairs of a site have in common.
struct SightModel {
  SightChain chain;
  RobustKernel shadow;  // of residuals in a shadow
  KernelShape wall;     // of what is left of residuals behind a wall
  WallPrior wall_prior;
  std::optional<PowerHints> powers;  // none where ranges carry none
};
[[nodiscard]] SightModel first_sight_model(const PollTable& table, std::span<const AnchorFit> fits);

// Of each of one anchor's rows, whether replies and powers alone put it in LOS.
[[nodiscard]] std::vector<bool> rows_in_sight(const SightModel& model,
                                              std::span<const std::vector<Poll>> pairs,
                                              std::span<const Observation> rows);

struct SiteSight {
  std::vector<AnchorSight> anchors;      // empty: nothing asks for it; the fits point here
  std::vector<SightVector> poll_shares;  // of each anchor: share of its polls in each state
  SightModel model;                      // as estimated
};

// Whether nearly all ranges are those of a hall or a yard. On longer ones replies are lost for weakness,
// hills and trees are no walls, and the halves of a drive see an anchor from one side each.
[[nodiscard]] bool is_within_reach(const std::vector<AnchorFit>& fits) noexcept;

// Whether ranges come through something for longer than a moment; for fits within reach. What a fit on the
// wrong side of the tags does to residuals passes for that: fits whose residuals look so are challenged, and
// move where their other side is better.
[[nodiscard]] bool is_sight_wanted(const PollTable& table, std::vector<AnchorFit>& fits);

// Finds each row's sight and solves the fits with it. The table: of the same rows.
[[nodiscard]] SiteSight solve_sight(const PollTable& table, const SightModel& start,
                                    std::vector<AnchorFit>& fits);

}  // namespace groma::calibration
