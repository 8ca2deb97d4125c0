#include "host/daemon/pose_message.hpp"

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
namespace {

using Json = nlohmann::ordered_json;

// Invalid UTF-8 (the user chooses the frame's name) must not throw and end the stream.
std::string line(const Json& object) {
  return object.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
}

}  // namespace

std::string version_line() {
  return line(
      {{"class", "VERSION"}, {"program", "gromad"}, {"version", io::program_version()}, {"protocol", 1}});
}

std::string pose_line(const PoseEstimate& pose, std::string_view frame, std::string_view model) {
  const std::string_view reason = filter::reason_name(pose.reason);
  Json covariance = Json::array();
  // nlohmann writes non-finite numbers as null.
  for (Eigen::Index row = 0; row < 6; ++row) {
    for (Eigen::Index column = 0; column < 6; ++column) covariance.push_back(pose.covariance(row, column));
  }
  Json object = {{"class", "POSE"},
                 {"t_s", pose.t_s},
                 {"frame", frame},
                 {"model", model},
                 {"state", filter::state_name(pose.state)},
                 {"reason", reason.empty() ? Json(nullptr) : Json(reason)},
                 {"x_m", pose.x_m},
                 {"y_m", pose.y_m},
                 {"z_m", pose.z_m},
                 {"roll_rad", pose.roll_rad},
                 {"pitch_rad", pose.pitch_rad},
                 {"yaw_rad", pose.yaw_rad},
                 {"covariance", std::move(covariance)}};
  if (!pose.floor.empty()) object["floor"] = pose.floor;
  return line(object);
}

std::string calibration_line(model::Verdict verdict, std::span<const AnchorProgress> anchors) {
  Json list = Json::array();
  for (const AnchorProgress& anchor : anchors) {
    list.push_back(Json{{"id", anchor.id},
                        {"state", state_word(anchor.state)},
                        {"coverage", anchor.coverage},
                        {"verdict", io::word(anchor.verdict)},
                        {"advice", anchor.advice},
                        {"ranges_used", anchor.ranges_used},
                        {"sigma_m", anchor.sigma_m ? Json(*anchor.sigma_m) : Json(nullptr)}});
  }
  return line({{"class", "CALIBRATION"}, {"verdict", io::word(verdict)}, {"anchors", std::move(list)}});
}

std::string status_line(const Status& status) {
  Json links = Json::array();
  for (const LinkDelay& link : status.links) {
    links.push_back(Json{{"link", link.link},
                         {"round_trip_s", link.round_trip_s ? Json(*link.round_trip_s) : Json(nullptr)}});
  }
  return line({{"class", "STATUS"},
               {"state", status.state},
               {"odometry", status.odometry},
               {"ranges", status.ranges},
               {"frames_lost", status.frames_lost},
               {"dropped", status.dropped},
               {"links", std::move(links)},
               {"diagnosis", diagnosis::to_json(status.diagnosis)}});
}

}  // namespace groma::daemon
