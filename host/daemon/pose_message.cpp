#include "host/daemon/pose_message.hpp"

#include <array>
#include <cmath>
#include <limits>

#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/version.hpp"
#include "host/link/report_decoder.hpp"

namespace groma::daemon {
namespace {

using Json = nlohmann::ordered_json;

// Invalid UTF-8 (the user chooses the frame's name) must not throw and end the stream.
std::string line(const Json& object) {
  return object.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
}

// 6 x 6, row by row. nlohmann writes non-finite numbers as null.
Json terms(const Eigen::Matrix<double, 6, 6>& covariance) {
  Json out = Json::array();
  for (Eigen::Index row = 0; row < 6; ++row) {
    for (Eigen::Index column = 0; column < 6; ++column) out.push_back(covariance(row, column));
  }
  return out;
}

// Odometry does not measure vz, the roll rate and the pitch rate: they are unknown.
Json twist(const PoseEstimate& pose) {
  constexpr std::array<Eigen::Index, 3> kPlanar{0, 1, 5};
  Eigen::Matrix<double, 6, 6> covariance =
      Eigen::Matrix<double, 6, 6>::Constant(std::numeric_limits<double>::quiet_NaN());
  covariance(kPlanar, kPlanar) = pose.velocity_covariance;
  return {{"vx_mps", pose.velocity.x()},
          {"vy_mps", pose.velocity.y()},
          {"omega_radps", pose.velocity.z()},
          {"covariance", terms(covariance)}};
}

Json state_of(const LinkStatus& link) {
  Json out{{"link", link.link},
           {"open", !link.error.has_value()},
           {"error", link.error ? Json(*link.error) : Json(nullptr)}};
  if (!link.can) return out;
  out["can"] = Json{{"frames", link.can->frames},
                    {"frames_overrun", link.can->frames_overrun},
                    {"controller_overruns", link.can->controller_overruns},
                    {"error_frames", link.can->error_frames},
                    {"error_passive", link.can->error_passive},
                    {"bus_off", link.can->bus_off},
                    {"restarts", link.can->restarts}};
  return out;
}

Json json_of(const std::optional<double>& value) {
  return value ? Json(*value) : Json(nullptr);
}

std::string_view role_word(const groma_Hello& hello) {
  switch (link::number_in(hello.role)) {
    case groma_Role_ROLE_ANCHOR:
      return "anchor";
    case groma_Role_ROLE_TAG:
      return "tag";
    default:
      return "unconfigured";
  }
}

std::string_view sync_word(const groma_NetworkStatus& network) {
  switch (link::number_in(network.state)) {
    case groma_SyncState_SYNC_LOCKED:
      return "locked";
    case groma_SyncState_SYNC_COASTING:
      return "coasting";
    default:
      return "searching";
  }
}

Json node_of(const NodeStatus& status) {
  Json out{
      {"id", nullptr}, {"role", nullptr}, {"network_id", nullptr}, {"version", nullptr}, {"sync", nullptr}};
  if (status.tag_id) out["id"] = *status.tag_id;
  if (status.network != nullptr) out["sync"] = sync_word(*status.network);
  if (status.hello == nullptr) return out;
  out["id"] = status.hello->id;
  out["role"] = role_word(*status.hello);
  out["network_id"] = status.hello->network_id;
  out["version"] = status.hello->version;
  if (status.hello->radio_error[0] != '\0') out["radio_error"] = status.hello->radio_error;
  return out;
}

Json link_of(const LinkStatus& link) {
  Json out = state_of(link);
  out["round_trip_s"] = json_of(link.round_trip_s);
  out["frames"] = link.node.frames;
  out["frames_dropped"] = link.node.frames_dropped;
  out["bytes_discarded"] = link.node.bytes_discarded;
  out["ranges"] = link.node.ranges;
  out["node"] = node_of(link.node);
  return out;
}

Json pair_of(const PairStatus& pair) {
  return {
      {"tag", pair.tag_id},
      {"anchor", pair.anchor_id},
      {"ranges", pair.ranges},
      {"used", pair.used},
      {"gated", pair.gated},
      {"range_m", pair.range_m},
      {"innovation_m", std::isnan(pair.innovation_m2) ? Json(nullptr) : Json(std::sqrt(pair.innovation_m2))}};
}

}  // namespace

std::string version_line() {
  return line(
      {{"class", "VERSION"}, {"program", "gromad"}, {"version", io::program_version()}, {"protocol", 1}});
}

std::string pose_line(const PoseEstimate& pose, std::string_view frame, std::string_view model) {
  const std::string_view reason = filter::reason_name(pose.reason);
  Json object = {
      {"class", "POSE"},
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
      {"covariance", terms(pose.covariance)},
      {"quaternion", {pose.quaternion.x(), pose.quaternion.y(), pose.quaternion.z(), pose.quaternion.w()}},
      {"child_frame", "base_link"},
      {"twist", twist(pose)}};
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
  for (const LinkStatus& link : status.links) links.push_back(link_of(link));
  Json anchors = Json::array();
  for (const AnchorStatus& anchor : status.anchors) {
    anchors.push_back(Json{{"id", anchor.id}, {"verdict", io::word(anchor.verdict)}});
  }
  Json pairs = Json::array();
  for (const PairStatus& pair : status.pairs) pairs.push_back(pair_of(pair));
  return line({{"class", "STATUS"},
               {"state", status.state},
               {"odometry", status.odometry},
               {"ranges", status.ranges},
               {"frames_lost", status.frames_lost},
               {"dropped", status.dropped},
               {"links", std::move(links)},
               {"robot", state_of(status.robot)},
               {"diagnosis", diagnosis::to_json(status.diagnosis)},
               {"t_s", json_of(status.t_s)},
               {"driven_m", status.driven_m},
               {"turned_rad", status.turned_rad},
               {"pose_latency_s",
                {{"p50", json_of(status.pose_latency_p50_s)}, {"p99", json_of(status.pose_latency_p99_s)}}},
               {"anchors", std::move(anchors)},
               {"pairs", std::move(pairs)}});
}

}  // namespace groma::daemon
