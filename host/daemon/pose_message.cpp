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

// Of vx, vy, vz and the rates about x, y, z. Odometry does not measure vz, the roll rate and the pitch rate:
// they are unknown.
Eigen::Matrix<double, 6, 6> twist_covariance(const PoseEstimate& pose) {
  constexpr std::array<Eigen::Index, 3> kPlanar{0, 1, 5};
  Eigen::Matrix<double, 6, 6> covariance =
      Eigen::Matrix<double, 6, 6>::Constant(std::numeric_limits<double>::quiet_NaN());
  covariance(kPlanar, kPlanar) = pose.velocity_covariance;
  return covariance;
}

// As nlohmann writes numbers, but without the heap.
void append_number(std::string& out, double number) {
  if (!std::isfinite(number)) {
    out += "null";
    return;
  }
  std::array<char, 64> digits{};
  const char* const end = nlohmann::detail::to_chars(digits.data(), digits.data() + digits.size(), number);
  out.append(digits.data(), static_cast<std::size_t>(end - digits.data()));
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

// The network time is the superframe's number times its duration, plus less than one.
Json superframe_s(const groma_NetworkStatus& network) {
  constexpr std::uint32_t kEnough = 100;  // superframes
  if (network.superframe < kEnough || network.network_time_dtu == 0) return nullptr;
  constexpr double kTick_s = 1.0 / (128.0 * 499.2e6);
  return kTick_s * static_cast<double>(network.network_time_dtu) / (network.superframe + 0.5);
}

Json network_of(const NodeStatus& status) {
  if (status.network == nullptr) return nullptr;
  const groma_NetworkStatus& network = *status.network;
  return {{"master", network.master_id},
          {"slot", network.has_slot ? Json(network.slot) : Json(nullptr)},
          {"slots", json_of(status.slots)},
          {"superframe_s", superframe_s(network)},
          {"candidates", network.candidates},
          {"answering", network.answering},
          {"hop", network.hop},
          {"beacons_missed", network.beacons_missed}};
}

Json node_of(const NodeStatus& status) {
  Json out{{"id", nullptr},      {"role", nullptr}, {"network_id", nullptr},
           {"version", nullptr}, {"sync", nullptr}, {"network", network_of(status)}};
  if (status.tag_id) out["id"] = *status.tag_id;
  if (status.network != nullptr) out["sync"] = link::sync_word(status.network->state);
  if (status.hello == nullptr) return out;
  out["id"] = status.hello->id;
  out["role"] = link::role_word(status.hello->role);
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

std::string refused_line() {
  return line({{"class", "REFUSED"}, {"reason", "as many other clients as are permitted read the stream"}});
}

std::string_view PoseWriter::Quoted::operator()(std::string_view text) {
  if (text == text_) return json_;
  text_ = text;
  json_ = Json(text).dump(-1, ' ', false, Json::error_handler_t::replace);
  return json_;
}

void PoseWriter::key(std::string_view name) {
  line_ += line_.back() == '{' ? "\"" : ",\"";
  line_ += name;
  line_ += "\":";
}

void PoseWriter::put(std::string_view name, double number) {
  key(name);
  append_number(line_, number);
}

void PoseWriter::put(std::string_view name, std::string_view json) {
  key(name);
  line_ += json;
}

// Row by row.
template <typename Terms>
void PoseWriter::put_terms(std::string_view name, const Terms& terms) {
  key(name);
  for (Eigen::Index row = 0; row < terms.rows(); ++row) {
    for (Eigen::Index column = 0; column < terms.cols(); ++column) {
      line_ += row + column == 0 ? '[' : ',';
      append_number(line_, terms(row, column));
    }
  }
  line_ += ']';
}

std::string_view PoseWriter::line(const PoseEstimate& pose, std::string_view frame, std::string_view model) {
  // These words need no escapes.
  const auto put_word = [this](std::string_view name, std::string_view word) {
    key(name);
    line_ += '"';
    line_ += word;
    line_ += '"';
  };
  line_ = "{";
  put_word("class", "POSE");
  put("t_s", pose.t_s);
  put("frame", frame_(frame));
  put("model", model_(model));
  put_word("state", filter::state_name(pose.state));
  if (const std::string_view reason = filter::reason_name(pose.reason); !reason.empty()) {
    put_word("reason", reason);
  } else {
    put("reason", "null");
  }
  put("x_m", pose.x_m);
  put("y_m", pose.y_m);
  put("z_m", pose.z_m);
  put("roll_rad", pose.roll_rad);
  put("pitch_rad", pose.pitch_rad);
  put("yaw_rad", pose.yaw_rad);
  put_terms("covariance", pose.covariance);
  put_terms("quaternion", pose.quaternion);
  put_word("child_frame", "base_link");
  put("twist", "{");
  put("vx_mps", pose.velocity.x());
  put("vy_mps", pose.velocity.y());
  put("omega_radps", pose.velocity.z());
  put_terms("covariance", twist_covariance(pose));
  line_ += '}';
  if (!pose.floor.empty()) put("floor", floor_(pose.floor));
  line_ += "}\n";
  return line_;
}

std::string pose_line(const PoseEstimate& pose, std::string_view frame, std::string_view model) {
  return std::string(PoseWriter().line(pose, frame, model));
}

std::string calibration_line(model::Verdict verdict, std::span<const AnchorProgress> anchors) {
  Json list = Json::array();
  for (const AnchorProgress& anchor : anchors) {
    list.push_back(
        Json{{"id", anchor.id},
             {"state", state_word(anchor.state)},
             {"coverage", anchor.coverage},
             {"verdict", io::word(anchor.verdict)},
             {"advice", anchor.advice},
             {"drive_to_m",
              anchor.drive_to_m ? Json{anchor.drive_to_m->x(), anchor.drive_to_m->y()} : Json(nullptr)},
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
  Json robots = Json::array();
  for (const LinkStatus& link : status.robots) robots.push_back(state_of(link));
  Json object{{"class", "STATUS"},
              {"state", status.state},
              {"odometry", status.odometry},
              {"ranges", status.ranges},
              {"frames_lost", status.frames_lost},
              {"dropped", status.dropped},
              {"links", std::move(links)},
              {"robot", robots.empty() ? Json(nullptr) : robots.front()},
              {"diagnosis", diagnosis::to_json(status.diagnosis)},
              {"t_s", json_of(status.t_s)},
              {"driven_m", status.driven_m},
              {"turned_rad", status.turned_rad},
              {"pose_latency_s",
               {{"p50", json_of(status.pose_latency_p50_s)}, {"p99", json_of(status.pose_latency_p99_s)}}},
              {"anchors", std::move(anchors)},
              {"pairs", std::move(pairs)}};
  if (robots.size() > 1) object["robots"] = std::move(robots);
  return line(object);
}

}  // namespace groma::daemon
