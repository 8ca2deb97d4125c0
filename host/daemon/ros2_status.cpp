#include "host/daemon/ros2_status.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstdint>
#include <string>
#include <utility>

#include <Eigen/Geometry>
#include <nlohmann/json.hpp>

namespace groma::daemon {
namespace {

using Json = nlohmann::ordered_json;
using ros2::Diagnostic;

enum Level : std::uint8_t { kOk = 0, kError = 2 };

std::string text_of(const Json& value) {
  return value.is_string() ? value.get<std::string>() : value.dump();
}

Diagnostic diagnosis_of(const Json& findings) {
  Diagnostic out{kOk, "groma: diagnosis", "no mistake is known", {}};
  for (const Json& finding : findings) {
    const std::string cause = text_of(finding.at("cause"));
    if (out.level == kOk) out.message = cause;
    out.level = kError;
    out.values.emplace_back(
        cause, fmt::format("{}; {}", text_of(finding.at("evidence")), text_of(finding.at("remedy"))));
  }
  return out;
}

Diagnostic link_of(const Json& link) {
  Diagnostic out{kOk, fmt::format("groma: link {}", text_of(link.at("link"))), "open", {}};
  if (!link.at("open").get<bool>()) {
    out.level = kError;
    out.message = link.contains("error") ? text_of(link.at("error")) : "is not open";
  }
  for (const char* key : {"ranges", "frames", "frames_dropped"}) {
    if (link.contains(key)) out.values.emplace_back(key, text_of(link.at(key)));
  }
  const auto node = link.find("node");
  if (node == link.end() || !node->is_object()) return out;
  for (const auto& [key, value] : node->items()) out.values.emplace_back("node " + key, text_of(value));
  if (out.level == kOk && node->contains("radio_error")) {
    out.level = kError;
    out.message = text_of(node->at("radio_error"));
  }
  return out;
}

}  // namespace

ros2::Localization localization_of(const PoseEstimate& pose) {
  return {.t_s = pose.t_s,
          .pose = {{pose.x_m, pose.y_m, pose.z_m}, pose.quaternion},
          .covariance = pose.covariance,
          .velocity = pose.velocity,
          .velocity_covariance = pose.velocity_covariance,
          .odom = pose.odom,
          .state = pose.state,
          .reason = pose.reason};
}

std::vector<Diagnostic> diagnostics_of(const Json& status) {
  std::vector<Diagnostic> out{diagnosis_of(status.at("diagnosis"))};
  for (const Json& link : status.at("links")) out.push_back(link_of(link));
  if (const auto robots = status.find("robots"); robots != status.end()) {
    for (const Json& link : *robots) out.push_back(link_of(link));
  } else if (status.at("robot").is_object()) {
    out.push_back(link_of(status.at("robot")));
  }
  Diagnostic anchors{kOk, "groma: anchors", "", {}};
  std::size_t usable = 0;
  for (const Json& anchor : status.at("anchors")) {
    anchors.values.emplace_back(fmt::format("anchor {}", text_of(anchor.at("id"))),
                                text_of(anchor.at("verdict")));
    usable += anchor.at("verdict") == "ok" ? 1 : 0;
  }
  anchors.message = fmt::format("{} of {} ok", usable, anchors.values.size());
  out.push_back(std::move(anchors));
  return out;
}

std::vector<ros2::LinkLine> links_of(const Json& status, const model::Calibration& calibration,
                                     std::span<const model::Tag> tags, const model::QuaternionPose& robot) {
  std::vector<ros2::LinkLine> out;
  const Eigen::Quaterniond turned(robot.quaternion);
  for (const Json& pair : status.at("pairs")) {
    const auto tag = std::find_if(tags.begin(), tags.end(), [&](const model::Tag& of) {
      return of.id == pair.at("tag").get<model::NodeId>();
    });
    const auto anchor = std::find_if(
        calibration.anchors.begin(), calibration.anchors.end(), [&](const model::AnchorCalibration& of) {
          return of.id == pair.at("anchor").get<model::NodeId>() && model::has_position(of);
        });
    if (tag == tags.end() || anchor == calibration.anchors.end()) continue;
    const auto used = pair.at("used").get<double>();
    const auto gated = pair.at("gated").get<double>();
    out.push_back({robot.position_m + turned * tag->lever_arm_m, anchor->position_m,
                   used + gated > 0.0 ? used / (used + gated) : 0.0});
  }
  return out;
}

}  // namespace groma::daemon
