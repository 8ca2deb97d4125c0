// A drive's estimate, for a user who wants to see where it is good and why it is not.
#pragma once

#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include <Eigen/Core>

#include "host/evaluation/evaluation.hpp"
#include "host/model/calibration.hpp"
#include "host/model/types.hpp"
#include "host/report/page.hpp"

namespace groma::report {

// What became of a range.
struct RangeRow {
  double t_s = 0.0;
  model::NodeId tag_id = 0;
  model::NodeId anchor_id = 0;
  double range_m = 0.0;
  double innovation_m = 0.0;                             // measured minus predicted
  double sigma_m = 0.0;                                  // of the innovation; NaN: unknown
  double weight = 0.0;                                   // 0: rejected, 1: used in full
  Eigen::Vector3d correction = Eigen::Vector3d::Zero();  // of x, y (m) and heading (rad)
  std::string_view why{};                                // a word for its weight; empty: none
};

struct StateSpan {
  double from_s = 0.0;
  double to_s = 0.0;
  std::string state;
  std::string reason;  // empty: none
};

// The views must not outlive what their spans and pointers refer to.
struct DriveView {
  std::span<const model::PlanarEstimate> rows;      // at least one; by time
  std::span<const model::PoseSample> truth{};       // by time; empty: unknown
  std::vector<StateSpan> states{};                  // by time; empty: unknown
  const model::Calibration* calibration = nullptr;  // null: unknown
  std::vector<RangeRow> ranges{};                   // by time; those that were judged
  // The ranges are compared with the final poses: residuals, which correct nothing.
  bool has_residuals = false;
};

// Adds figures, map, errors against their sigmas, states, NEES, innovations of each pair and corrections by
// anchor, as far as the view has them.
void add_drive(Page& page, const DriveView& view);

// Adds start, end and the direction of travel to a map. At least one row.
void add_course(Chart& map, std::span<const model::PlanarEstimate> rows, Ink ink);

// A moment of a drive, and the time around it.
struct MomentView {
  double at_s = 0.0;
  std::span<const model::PlanarEstimate> rows;  // within the window; at least one
  std::vector<StateSpan> states{};
  const model::Calibration* calibration = nullptr;  // not null
  std::vector<RangeRow> ranges{};                   // within the window
};

// Adds figures, a map of the pose and the anchors that answered, the pose over time, the innovation of each
// pair and the corrections by anchor.
void add_moment(Page& page, const MomentView& view);

}  // namespace groma::report
