#include "host/daemon/foxglove_live.hpp"

#include <algorithm>
#include <array>
#include <span>
#include <utility>

#include <nlohmann/json.hpp>

#include "host/convert/schemas.hpp"
#include "host/daemon/ros2_status.hpp"
#include "host/filter/sensors.hpp"
#include "host/io/base64.hpp"
#include "host/io/version.hpp"
#include "host/ros2/time.hpp"

namespace groma::daemon {
namespace {

using Json = nlohmann::ordered_json;

struct Channel {
  std::string_view topic;
  std::string_view schema;
};
// The protocol numbers them from 1.
constexpr std::array<Channel, 7> kChannels{{{"/tf", "foxglove.FrameTransform"},
                                            {"/groma/pose", "foxglove.PoseInFrame"},
                                            {"/groma/estimate", "groma_msgs.Estimate"},
                                            {"/groma/uncertainty", "foxglove.SceneUpdate"},
                                            {"/groma/scene", "foxglove.SceneUpdate"},
                                            {"/groma/ranges", "groma_msgs.Ranges"},
                                            {"/groma/log", "foxglove.Log"}}};
constexpr std::size_t kSceneChannel = 4;
constexpr std::size_t kRangesChannel = 5;

// Opcodes of binary messages.
constexpr char kMessageData = 1;
constexpr char kTime = 2;

template <typename Number>
void append(std::string& out, Number number) {
  for (std::size_t i = 0; i < sizeof(number); ++i) out += static_cast<char>((number >> (8 * i)) & 0xFFU);
}

web::Socket::Message shared(std::string text) {
  return std::make_shared<const std::string>(std::move(text));
}

web::Socket::Message advertisement() {
  const std::string_view descriptors = convert::protobuf_schemas();
  const std::string schemas =
      io::base64({reinterpret_cast<const std::uint8_t*>(descriptors.data()), descriptors.size()});
  Json channels = Json::array();
  for (std::size_t i = 0; i < kChannels.size(); ++i) {
    channels.push_back({{"id", i + 1},
                        {"topic", kChannels.at(i).topic},
                        {"encoding", "protobuf"},
                        {"schemaName", kChannels.at(i).schema},
                        {"schema", schemas},
                        {"schemaEncoding", "protobuf"}});
  }
  return shared(Json{{"op", "advertise"}, {"channels", std::move(channels)}}.dump());
}

web::Socket::Message server_info() {
  return shared(Json{{"op", "serverInfo"},
                     {"name", std::string("gromad ") + std::string(io::program_version())},
                     {"capabilities", {"time"}},
                     {"metadata", Json::object()}}
                    .dump());
}

convert::Estimate estimate_of(const PoseEstimate& pose) {
  return {.at = localization_of(pose),
          .roll_rad = pose.roll_rad,
          .pitch_rad = pose.pitch_rad,
          .yaw_rad = pose.yaw_rad};
}

}  // namespace

FoxgloveLive::FoxgloveLive(EventLoop& loop, const Config& config)
    : config_(config), timer_(loop, kPeriod_s, [this] { on_tick(); }) {
  ranges_.reserve(kMaxRanges);
  make_encoder();
}

FoxgloveLive::~FoxgloveLive() = default;

void FoxgloveLive::make_encoder() {
  frame_ = calibration_ ? calibration_->frame : "map";
  tags_ = config_.tags;
  encoder_ = convert::make_foxglove_encoder(
      [this](std::string_view topic, std::string_view /*schema*/, double t_s, std::string_view message) {
        send(topic, t_s, message);
      },
      {.frame = frame_,
       .tags = tags_,
       .odometry_noise = config_.odometry,
       .gyro_sigma_radps = filter::SensorConfig(config_.sensors).gyro_sigma_radps});
}

void FoxgloveLive::on_pose(const PoseEstimate& pose, std::string_view /*line*/) {
  last_ = estimate_of(pose);
  has_new_pose_ = true;
}

void FoxgloveLive::on_calibration(const model::Calibration& calibration) {
  calibration_ = calibration;
  const bool has_same_tags = std::equal(tags_.begin(), tags_.end(), config_.tags.begin(), config_.tags.end(),
                                        [](const model::Tag& a, const model::Tag& b) {
                                          return a.id == b.id && a.lever_arm_m == b.lever_arm_m;
                                        });
  if (frame_ != calibration.frame || !has_same_tags) make_encoder();
  send_site();
}

void FoxgloveLive::on_clock_set() {
  ranges_.clear();
  last_.reset();
  has_new_pose_ = false;
  make_encoder();  // the old one waits for times of the old clock
}

void FoxgloveLive::on_range(const model::RangeSample& range) {
  const bool is_read = std::any_of(clients_.begin(), clients_.end(), [](const auto& client) {
    return client.second.count(kRangesChannel) > 0;
  });
  if (is_read && ranges_.size() < kMaxRanges && ros2::has_timestamp(range.t_s)) ranges_.push_back(range);
}

void FoxgloveLive::on_tick() {
  if (!ranges_.empty()) {
    encoder_->put(std::span<const model::RangeSample>(ranges_));
    ranges_.clear();
  }
  if (!std::exchange(has_new_pose_, false) || clients_.empty() || !ros2::has_timestamp(last_->at.t_s)) return;
  std::string time(1, kTime);
  append(time, ros2::to_ns(last_->at.t_s));
  const web::Socket::Message message = shared(std::move(time));
  for (const auto& [socket, subscriptions] : clients_) socket->send(message, web::Socket::Kind::kBinary);
  encoder_->put(*last_);
}

void FoxgloveLive::send_site() {
  const double t_s = last_ ? last_->at.t_s : 0.0;
  if (calibration_ && ros2::has_timestamp(t_s)) encoder_->put_site(t_s, *calibration_);
}

void FoxgloveLive::send(std::string_view topic, double t_s, std::string_view message) {
  const auto* const channel =
      std::find_if(kChannels.begin(), kChannels.end(), [&](const Channel& of) { return of.topic == topic; });
  const auto number = static_cast<std::size_t>(channel - kChannels.begin());
  for (const auto& [socket, subscriptions] : clients_) {
    const auto subscription = subscriptions.find(number);
    if (subscription == subscriptions.end() || (only_ != nullptr && only_ != socket)) continue;
    std::string bytes(1, kMessageData);
    append(bytes, subscription->second);
    append(bytes, ros2::to_ns(t_s));
    bytes += message;
    socket->send(shared(std::move(bytes)), web::Socket::Kind::kBinary);
  }
}

void FoxgloveLive::on_open(web::Socket& socket) {
  static const web::Socket::Message kAdvertisement = advertisement();
  clients_[&socket];
  socket.send(server_info(), web::Socket::Kind::kText);
  socket.send(kAdvertisement, web::Socket::Kind::kText);
}

void FoxgloveLive::on_close(web::Socket& socket) {
  clients_.erase(&socket);
}

bool FoxgloveLive::on_text(web::Socket& socket, std::string_view text) {
  const Json json = Json::parse(text, nullptr, false);
  if (!json.is_object()) return false;
  Subscriptions& subscriptions = clients_[&socket];
  const auto op = json.find("op");
  if (op == json.end()) return false;
  if (*op == "subscribe" && json.contains("subscriptions") && json["subscriptions"].is_array()) {
    for (const Json& each : json["subscriptions"]) {
      const auto number_at = [&each](const char* key) -> std::optional<std::uint32_t> {
        const auto value = each.is_object() ? each.find(key) : each.end();
        if (value == each.end() || !value->is_number_unsigned() || *value > UINT32_MAX) return std::nullopt;
        return value->get<std::uint32_t>();
      };
      const auto id = number_at("id");
      const auto channel = number_at("channelId");
      if (!id || !channel || *channel < 1 || *channel > kChannels.size()) return false;
      subscriptions[*channel - 1] = *id;
      if (*channel - 1 == kSceneChannel) {
        only_ = &socket;
        send_site();
        only_ = nullptr;
      }
    }
    return true;
  }
  if (*op == "unsubscribe" && json.contains("subscriptionIds") && json["subscriptionIds"].is_array()) {
    for (const Json& id : json["subscriptionIds"])
      std::erase_if(subscriptions, [&](const auto& subscription) { return id == subscription.second; });
    return true;
  }
  return false;
}

}  // namespace groma::daemon
