#include "host/report/site.hpp"

#include <fmt/format.h>

#include <map>

#include "host/io/calibration_file.hpp"
#include "host/report/calibration_report.hpp"

namespace groma::report {

namespace {

using Eigen::Vector2d;

std::string hint_of(const model::AnchorCalibration& anchor) {
  const Eigen::Vector3d sigma_m = anchor.covariance.topLeftCorner<3, 3>().diagonal().cwiseSqrt();
  return fmt::format("anchor {}: {}\nx {:.3f} ± {:.3f} m\ny {:.3f} ± {:.3f} m\nz {:.3f} ± {:.3f} m",
                     anchor.id, io::word(anchor.verdict), anchor.position_m.x(), sigma_m.x(),
                     anchor.position_m.y(), sigma_m.y(), anchor.position_m.z(), sigma_m.z());
}

}  // namespace

std::string anchor_part(model::NodeId id) {
  return fmt::format("anchor-{}", id);
}

Ink anchor_ink(model::AnchorVerdict verdict) {
  switch (tone(verdict)) {
    case Tone::kWarning:
      return Ink::kWarning;
    case Tone::kBad:
      return Ink::kBad;
    default:
      return Ink::kAnchor;
  }
}

void add_walls(Chart& map, const Walls& walls) {
  if (!walls.opaque.empty()) map.add_strokes("wall", Ink::kWall, walls.opaque);
  if (!walls.others.empty()) map.add_strokes("rack, partition, machine", Ink::kOther, walls.others);
}

void add_anchors(Chart& map, const model::Calibration& calibration, bool has_parts) {
  struct Group {
    const char* name;
    std::vector<Mark> marks{};
    std::vector<Ellipse> ellipses{};
  };
  std::map<Ink, Group> groups{{Ink::kAnchor, {"anchor"}},
                              {Ink::kWarning, {"anchor with a warning"}},
                              {Ink::kBad, {"anchor not usable"}}};
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!model::has_position(anchor)) continue;
    Group& group = groups.at(anchor_ink(anchor.verdict));
    const Vector2d at = anchor.position_m.head<2>();
    group.marks.push_back({.at = at,
                           .label = fmt::format("{}", anchor.id),
                           .hint = hint_of(anchor),
                           .link = has_parts ? anchor_part(anchor.id) : ""});
    group.ellipses.push_back({at, anchor.covariance.topLeftCorner<2, 2>()});
  }
  for (auto& [ink, group] : groups) {
    if (group.marks.empty()) continue;
    map.add_marks(group.name, ink, std::move(group.marks));
    map.add_ellipses("its 95 % ellipse", ink, std::move(group.ellipses));
  }
}

}  // namespace groma::report
