// A pose, and a STATUS line of the pose stream, for ROS 2.
#pragma once

#include <span>
#include <string_view>
#include <vector>

#include <nlohmann/json_fwd.hpp>

#include "host/daemon/localizer.hpp"
#include "host/model/calibration.hpp"
#include "host/model/pose.hpp"
#include "host/model/types.hpp"
#include "host/ros2/messages.hpp"

namespace groma::daemon {

[[nodiscard]] ros2::Localization localization_of(const PoseEstimate& pose);

// Findings, links and anchors.
[[nodiscard]] std::vector<ros2::Diagnostic> diagnostics_of(const nlohmann::ordered_json& status);

// The pairs with ranges, of a robot at this pose.
[[nodiscard]] std::vector<ros2::LinkLine> links_of(const nlohmann::ordered_json& status,
                                                   const model::Calibration& calibration,
                                                   std::span<const model::Tag> tags,
                                                   const model::QuaternionPose& robot);

}  // namespace groma::daemon
