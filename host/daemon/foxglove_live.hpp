// Poses, anchors, ranges and states for Foxglove and Lichtblick: the protocol foxglove.websocket.v1, alias
// foxglove.sdk.v1, with the messages that groma convert writes (host/convert/encoder.hpp).
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/convert/encoder.hpp"
#include "host/daemon/config.hpp"
#include "host/daemon/event_loop.hpp"
#include "host/daemon/measurement_sink.hpp"
#include "host/daemon/output.hpp"
#include "host/web/server.hpp"

namespace groma::daemon {

class FoxgloveLive : public Output, public MeasurementSink, public web::SocketService {
 public:
  static constexpr double kPeriod_s = 0.05;  // of poses; Lichtblick warns of topics above 60 Hz
  // Ranges that may wait for the next period; further ones are left out.
  static constexpr std::size_t kMaxRanges = 1024;

  FoxgloveLive(EventLoop& loop, const Config& config);
  ~FoxgloveLive() override;

  // Without the heap: on_tick() sends the last one.
  void on_pose(const PoseEstimate& pose, std::string_view line) override;
  void on_line(std::string_view /*line*/) override {}
  void on_calibration(const model::Calibration& calibration) override;

  // Without the heap.
  void on_odometry(const model::OdometrySample& /*sample*/) override {}
  void on_range(const model::RangeSample& range) override;
  void on_pose_prior(const model::PoseSample& /*pose*/) override {}
  void on_clock_set() override;

  void on_open(web::Socket& socket) override;
  void on_close(web::Socket& socket) override;
  bool on_text(web::Socket& socket, std::string_view text) override;

 private:
  // Per client: the subscription to each channel, by the channel's number.
  using Subscriptions = std::map<std::size_t, std::uint32_t>;

  void on_tick();
  void make_encoder();
  void send_site();
  void send(std::string_view topic, double t_s, std::string_view message);

  const Config& config_;
  std::string frame_;  // of the encoder, as are the tags
  std::vector<model::Tag> tags_;
  std::optional<model::Calibration> calibration_;
  std::unique_ptr<convert::Encoder> encoder_;
  std::optional<convert::Estimate> last_;
  bool has_new_pose_ = false;
  std::vector<model::RangeSample> ranges_;  // since the last period; its capacity is reserved
  std::map<web::Socket*, Subscriptions> clients_;
  web::Socket* only_ = nullptr;  // send() is for this client alone
  EventLoop::Timer timer_;
};

}  // namespace groma::daemon
