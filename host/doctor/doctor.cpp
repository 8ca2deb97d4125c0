#include "host/doctor/doctor.hpp"

#include <algorithm>
#include <iterator>
#include <utility>

#include <nlohmann/json.hpp>

namespace groma::doctor {
namespace {

// Those of the calibration in use, if there is one.
void use_anchors_of(const nlohmann::json& status, std::set<model::NodeId>& anchors) {
  const nlohmann::json list = status.value("anchors", nlohmann::json::array());
  if (!list.empty()) anchors.clear();
  for (const nlohmann::json& anchor : list) anchors.insert(anchor.at("id").get<model::NodeId>());
}

}  // namespace

Examination examine(const std::filesystem::path& config, double listen_s) {
  Examination out;
  const auto add = [&](std::vector<Check> checks) {
    std::move(checks.begin(), checks.end(), std::back_inserter(out.checks));
  };
  const daemon::ConfigReading reading = daemon::parse_config(config);
  add(check_configuration(reading));
  if (!reading.problems.empty()) {
    out.observation.error = "the configuration has errors";
    return out;
  }
  Subject subject{.config = reading.config};
  add({check_calibration(reading.config, subject.anchors)});
  add(check_files(reading.config));
  add(check_can_buses(reading.config));
  out.observation = observe(address_of(reading.config.pose_stream), listen_s);
  if (out.observation.error.empty()) subject.live = &out.observation;
  if (subject.live != nullptr) use_anchors_of(subject.live->statuses.back(), subject.anchors);
  add(check_servers(reading.config, out.observation));
  add(check_links(subject));
  add({check_odometry(subject)});
  add({check_computer_clock()});
  if (subject.live != nullptr) {
    add({check_robot_clock(subject)});
    add(check_pairs(subject));
    add(check_localization(subject));
  }
  return out;
}

}  // namespace groma::doctor
