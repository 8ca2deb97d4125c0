#include "host/diagnosis/diagnose.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <set>
#include <utility>

#include "host/calibration/verdict.hpp"
#include "host/diagnosis/motion_check.hpp"
#include "host/diagnosis/odometry_check.hpp"
#include "host/diagnosis/plain_checks.hpp"
#include "host/diagnosis/range_check.hpp"

namespace groma::diagnosis {
namespace {

void append(std::vector<Finding> more, std::vector<Finding>& findings) {
  for (Finding& finding : more) {
    const bool is_named = std::any_of(findings.begin(), findings.end(), [&](const Finding& other) {
      return other.cause == finding.cause && other.of == finding.of;
    });
    if (!is_named) findings.push_back(std::move(finding));
  }
}

bool times_overlap(const std::vector<Finding>& findings) {
  return std::none_of(findings.begin(), findings.end(),
                      [](const Finding& finding) { return finding.cause == "time-overlap"; });
}

// Where ranges and odometry agree on the poses' clock, the poses' clock is wrong, once.
void join_clocks(std::vector<Finding>& of_odometry, const std::vector<Finding>& of_ranges) {
  for (const Finding& ranges : of_ranges) {
    if (!ranges.clock) continue;
    std::erase_if(of_odometry, [&](const Finding& odometry) {
      return odometry.cause == ranges.cause &&
             std::abs(odometry.value.front() + ranges.value.front()) <
                 4.0 * std::hypot(odometry.sigma.front(), ranges.sigma.front());
    });
  }
}

// By hand: a tenth, so that poses of a part of the drive do not make the rest look too long.
bool lasts_as_long(const std::vector<model::PoseSample>& poses,
                   const std::vector<model::OdometrySample>& odometry) {
  if (poses.empty() || odometry.empty()) return false;
  return poses.back().t_s - poses.front().t_s > 0.1 * (odometry.back().t_s - odometry.front().t_s);
}

template <class Anchors>
std::set<model::NodeId> ids_of(const Anchors& anchors) {
  std::set<model::NodeId> out;
  for (const auto& anchor : anchors) out.insert(anchor.id);
  return out;
}

}  // namespace

Data data_of(const io::Dataset& dataset) {
  Data out{.poses = dataset.pose_prior,
           .odometry = dataset.odometry,
           .ranges = dataset.ranges,
           .dropped_ranges = dataset.dropped_ranges,
           .tags = dataset.tags,
           .anchors = dataset.surveyed_anchors,
           .priors = dataset.range_priors,
           .surface = dataset.surface};
  // Larger values are no speeds in any unit.
  constexpr double kLargest = 1e6;
  std::erase_if(out.odometry, [](const model::OdometrySample& sample) {
    return !(std::abs(sample.vx_mps) < kLargest && std::abs(sample.vy_mps) < kLargest &&
             std::abs(sample.omega_radps) < kLargest);
  });
  return out;
}

std::vector<Finding> diagnose(Data data) {
  std::vector<Finding> findings = find_wrong_times(data);
  append(find_wrong_angles(data), findings);
  if (times_overlap(findings)) {
    append(find_wrong_lengths(data), findings);
    OdometryComparison odometry = compare_with_odometry(data);
    std::vector<Finding> ranges = compare_with_poses(data, odometry.explains);
    join_clocks(odometry.findings, ranges);
    append(std::move(odometry.findings), findings);
    append(std::move(ranges), findings);
    append(compare_with_survey(data), findings);
  }
  append(find_long_lever_arms(data), findings);
  append(find_wrong_height(data), findings);
  append(find_unknown_nodes(data, ids_of(data.anchors), "anchors.csv"), findings);
  return findings;
}

std::vector<Finding> diagnose(Data data, const model::Calibration& calibration) {
  // The start may be all that there is of poses.
  if (!lasts_as_long(data.poses, data.odometry)) data.poses.clear();
  std::vector<Finding> findings = find_wrong_times(data);
  data.poses.clear();
  if (times_overlap(findings)) {
    append(find_wrong_lengths(data), findings);
    append(compare_with_calibration(data, calibration), findings);
  }
  append(find_long_lever_arms(data), findings);
  append(find_unknown_nodes(data, ids_of(calibration.anchors), "the calibration"), findings);
  return findings;
}

const Finding* find_contradiction(const std::vector<Finding>& findings) {
  const auto found = std::find_if(findings.begin(), findings.end(), [](const Finding& finding) {
    return !finding.is_of_odometry_alone && finding.cause != "unknown-tag" &&
           finding.cause != "unknown-anchor" && finding.cause != "poses-contradict-odometry";
  });
  return found != findings.end() ? &*found : nullptr;
}

void mark_contradicted(const Finding& contradiction, model::Calibration& calibration) {
  for (model::AnchorCalibration& anchor : calibration.anchors) {
    if (anchor.verdict == model::AnchorVerdict::kNoData) continue;
    anchor.verdict = model::AnchorVerdict::kWeak;
    anchor.advice = fmt::format("its data contradicts itself ({}): correct that first", contradiction.cause);
  }
  calibration.verdict = calibration::judge_site(calibration.anchors);
}

}  // namespace groma::diagnosis
