#include "host/convert/convert.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <map>
#include <span>
#include <string_view>
#include <tuple>
#include <type_traits>
#include <variant>
#include <vector>

#include "host/convert/encoder.hpp"
#include "host/filter/sensors.hpp"
#include "host/io/version.hpp"
#include "host/mcap/writer.hpp"
#include "host/model/odom_frame.hpp"
#include "host/model/pose.hpp"
#include "host/ros2/time.hpp"

namespace groma::convert {

namespace {

// The duration of one message of ranges.
constexpr std::uint64_t kRangesTime_ns = 50'000'000;

// A sample, or the ranges [begin, end), of the recording.
struct Event {
  enum class Source { kRanges, kSensor, kPrior, kOdometry, kEstimate, kSent };
  double t_s = 0.0;
  Source source = Source::kRanges;
  std::size_t begin = 0;
  std::size_t end = 0;
};

std::vector<model::SensorSample> sensor_samples(const model::SensorTables& tables) {
  std::vector<model::SensorSample> all;
  std::apply([&](const auto&... table) { (all.insert(all.end(), table.begin(), table.end()), ...); }, tables);
  return all;
}

// The events of a recording by time; those of one time in the order of Event::Source.
class Timeline {
 public:
  Timeline(const Recording& recording, std::span<const model::SensorSample> sensors)
      : from_s_(recording.from_s), to_s_(recording.to_s) {
    const io::Dataset& dataset = *recording.dataset;
    add_ranges(dataset.ranges);
    add(Event::Source::kSensor, sensors, [](const auto& sample) { return model::time_of(sample); });
    const auto time_of = [](const auto& sample) { return sample.t_s; };
    add(Event::Source::kPrior, std::span(dataset.pose_prior), time_of);
    add(Event::Source::kOdometry, std::span(dataset.odometry), time_of);
    if (recording.result != nullptr)
      add(Event::Source::kEstimate, std::span(recording.result->rows), time_of);
    add(Event::Source::kSent, std::span(recording.sent), [](const Estimate& sent) { return sent.at.t_s; });
    std::stable_sort(events_.begin(), events_.end(),
                     [](const Event& a, const Event& b) { return a.t_s < b.t_s; });
  }

  [[nodiscard]] const std::vector<Event>& events() const noexcept { return events_; }
  [[nodiscard]] std::size_t without_timestamp() const noexcept { return without_timestamp_; }

 private:
  bool takes(double t_s) {
    if (t_s < from_s_ || t_s > to_s_) return false;
    if (ros2::has_timestamp(t_s)) return true;
    ++without_timestamp_;
    return false;
  }

  template <typename Samples, typename TimeOf>
  void add(Event::Source source, const Samples& samples, const TimeOf& time_of) {
    for (std::size_t i = 0; i < samples.size(); ++i) {
      if (takes(time_of(samples[i]))) events_.push_back({time_of(samples[i]), source, i, i + 1});
    }
  }

  // By time, so that those without a timestamp are the first and last ones.
  void add_ranges(std::span<const model::RangeSample> ranges) {
    std::uint64_t end_ns = 0;  // of the open message
    for (std::size_t i = 0; i < ranges.size(); ++i) {
      const double t_s = ranges[i].t_s;
      if (!takes(t_s)) continue;
      if (events_.empty() || ros2::to_ns(t_s) >= end_ns) {
        events_.push_back({t_s, Event::Source::kRanges, i, i});
        end_ns = ros2::to_ns(t_s) + kRangesTime_ns;
      }
      events_.back().t_s = t_s;
      events_.back().end = i + 1;
    }
  }

  double from_s_;
  double to_s_;
  std::vector<Event> events_;
  std::size_t without_timestamp_ = 0;
};

InputPose placed(const model::PoseSample& sample, InputPose::Kind kind, const model::Surface& surface) {
  const model::PlanarPose planar = filter::place_on(surface, sample);
  const model::RigidPose at = model::pose_on_surface(surface, planar).pose;
  return {kind, sample.t_s, {at.position_m, model::quaternion_of(at.rotation)}, sample.covariance};
}

Estimate estimate_of(const filter::ReplayResult& result, std::size_t row,
                     const model::OdometrySample& odometry, const model::OdometryNoise& noise) {
  const model::PlanarEstimate& planar = result.rows[row];
  const model::SpatialEstimate& spatial = result.spatial[row];
  return {.at = {.t_s = planar.t_s,
                 .pose = {{planar.x_m, planar.y_m, spatial.z_m}, spatial.quaternion},
                 .covariance = spatial.covariance,
                 .velocity = velocity_of(odometry),
                 .velocity_covariance = covariance_of(noise),
                 .odom = std::nullopt,
                 .state = result.states[row].state,
                 .reason = result.states[row].reason},
          .roll_rad = spatial.roll_rad,
          .pitch_rad = spatial.pitch_rad,
          .yaw_rad = planar.yaw_rad};
}

void put(const model::SensorSample& sample, const model::Surface& surface, Encoder& encoder) {
  std::visit(
      [&]<class Sample>(const Sample& of) {
        if constexpr (std::is_same_v<Sample, model::PoseSample>) {
          encoder.put(placed(of, InputPose::Kind::kAbsolute, surface));
        } else {
          encoder.put(of);
        }
      },
      sample);
}

void put_all(const Recording& recording, std::span<const model::SensorSample> sensors,
             std::span<const Event> events, Encoder& encoder) {
  const io::Dataset& dataset = *recording.dataset;
  const auto put_site = [&](const model::Calibration& calibration) {
    if (!events.empty()) encoder.put_site(events.front().t_s, calibration);
  };
  if (recording.calibration != nullptr) put_site(*recording.calibration);
  for (const model::Calibration& calibration : recording.used) put_site(calibration);
  model::OdometrySample odometry;
  model::OdomFrame odom;
  for (const Event& event : events) {
    const std::size_t i = event.begin;
    switch (event.source) {
      case Event::Source::kRanges:
        encoder.put(std::span(dataset.ranges).subspan(i, event.end - i));
        break;
      case Event::Source::kSensor:
        put(sensors[i], dataset.surface, encoder);
        break;
      case Event::Source::kPrior:
        encoder.put(placed(dataset.pose_prior[i], InputPose::Kind::kPrior, dataset.surface));
        break;
      case Event::Source::kOdometry:
        odometry = dataset.odometry[i];
        odom.take(odometry);
        encoder.put(odometry);
        break;
      case Event::Source::kEstimate: {
        Estimate estimate = estimate_of(*recording.result, i, odometry, dataset.odometry_noise);
        estimate.at.odom = odom.pose();
        encoder.put(estimate);
        break;
      }
      case Event::Source::kSent:
        encoder.put(recording.sent[i]);
        break;
    }
  }
}

}  // namespace

Converted to_mcap(const Recording& recording, Format format) {
  const io::Dataset& dataset = *recording.dataset;
  const bool is_ros2 = format == Format::kRos2;
  mcap::Writer writer(is_ros2 ? "ros2" : "", fmt::format("groma {}", io::program_version()));
  constexpr std::string_view kMapFrame = "map";
  const model::Calibration* const calibration =
      recording.used.empty() ? recording.calibration : &recording.used.front();
  const Site site{.frame = calibration != nullptr ? calibration->frame : std::string(kMapFrame),
                  .tags = dataset.tags,
                  .odometry_noise = dataset.odometry_noise,
                  .gyro_sigma_radps = filter::SensorConfig(dataset.sensors).gyro_sigma_radps};
  std::map<std::string_view, std::uint16_t> channels;  // by topic; the first message of one adds its channel
  const Write write = [&](std::string_view topic, std::string_view schema, double t_s,
                          std::string_view message) {
    auto channel = channels.find(topic);
    if (channel == channels.end()) {
      const auto add_channel = is_ros2 ? add_ros2_channel : add_foxglove_channel;
      channel = channels.emplace(topic, add_channel(writer, topic, schema)).first;
    }
    writer.write(channel->second, ros2::to_ns(t_s), message);
  };
  const auto encoder = is_ros2 ? make_ros2_encoder(write, site) : make_foxglove_encoder(write, site);
  const std::vector<model::SensorSample> sensors = sensor_samples(dataset.sensor_samples);
  const Timeline timeline(recording, sensors);
  put_all(recording, sensors, timeline.events(), *encoder);
  Converted converted;
  converted.messages = writer.messages();
  converted.topics = writer.channels();
  converted.without_timestamp = timeline.without_timestamp();
  converted.bytes = writer.finish();
  return converted;
}

}  // namespace groma::convert
