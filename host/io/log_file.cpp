#include "host/io/log_file.hpp"

#include <pb_decode.h>
#include <pb_encode.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <tuple>
#include <utility>
#include <variant>

#include "host/io/version.hpp"
#include "host/model/pose.hpp"
#include "log.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::io {

namespace {

static_assert(groma_LogRecord_size <= wire::kMaxPayload, "a record has to fit into a frame");

constexpr std::int16_t kNoPower = std::numeric_limits<std::int16_t>::min();
constexpr std::int32_t kNoOffset = std::numeric_limits<std::int32_t>::min();

template <typename Integer>
Integer in_steps(float known, double steps, Integer unknown) {
  if (!std::isfinite(known)) return unknown;
  const auto value = static_cast<double>(known);
  const double least = static_cast<double>(unknown) + 1.0;
  return static_cast<Integer>(std::lround(
      std::clamp(value * steps, least, static_cast<double>(std::numeric_limits<Integer>::max()))));
}

float of_steps(std::int32_t value, std::int32_t unknown, float steps) {
  return value == unknown ? model::kUnknown : static_cast<float>(value) / steps;
}

std::uint8_t flags_of(const model::RangeSample& range) {
  return static_cast<std::uint8_t>(static_cast<unsigned>(range.line_of_sight) | range.corrections);
}

constexpr std::uint8_t kLineOfSightMask = 3;

void add(groma_LogRanges& out, const model::RangeSample& range, std::int64_t network_time_before_dtu) {
  out.t_s[out.t_s_count++] = range.t_s;
  out.tag_id[out.tag_id_count++] = range.tag_id;
  out.anchor_id[out.anchor_id_count++] = range.anchor_id;
  out.range_m[out.range_m_count++] = static_cast<float>(range.range_m);
  out.first_path_power_cdbm[out.first_path_power_cdbm_count++] =
      in_steps(range.first_path_power_dbm, 100.0, kNoPower);
  out.receive_power_cdbm[out.receive_power_cdbm_count++] = in_steps(range.receive_power_dbm, 100.0, kNoPower);
  out.clock_offset_ppb[out.clock_offset_ppb_count++] = in_steps(range.clock_offset_ppm, 1000.0, kNoOffset);
  out.noise[out.noise_count++] =
      std::isfinite(range.noise)
          ? static_cast<std::uint16_t>(std::clamp(std::lround(range.noise), 0L, 65535L))
          : std::uint16_t{0};
  out.flags[out.flags_count++] = flags_of(range);
  out.network_time_dtu[out.network_time_dtu_count++] = range.network_time_dtu - network_time_before_dtu;
}

void add(groma_LogPoses& out, const model::PoseSample& pose) {
  out.t_s[out.t_s_count++] = pose.t_s;
  out.x_m[out.x_m_count++] = pose.x_m;
  out.y_m[out.y_m_count++] = pose.y_m;
  out.z_m[out.z_m_count++] = pose.z_m;
  out.yaw_rad[out.yaw_rad_count++] = pose.yaw_rad;
  out.roll_rad[out.roll_rad_count++] = pose.roll_rad;
  out.pitch_rad[out.pitch_rad_count++] = pose.pitch_rad;
  model::PoseCovariance unknown{};
  unknown.fill(std::numeric_limits<double>::quiet_NaN());
  for (const double term : pose.covariance.value_or(unknown))
    out.covariance[out.covariance_count++] = static_cast<float>(term);
}

void add(groma_LogOdometry& out, const model::OdometrySample& sample) {
  out.t_s[out.t_s_count++] = sample.t_s;
  out.vx_mps[out.vx_mps_count++] = sample.vx_mps;
  out.vy_mps[out.vy_mps_count++] = sample.vy_mps;
  out.omega_radps[out.omega_radps_count++] = sample.omega_radps;
}

void add(groma_LogYawRates& out, const model::YawRateSample& sample) {
  out.t_s[out.t_s_count++] = sample.t_s;
  out.omega_radps[out.omega_radps_count++] = sample.omega_radps;
}

void add(groma_LogPositions& out, const model::PositionSample& sample) {
  out.t_s[out.t_s_count++] = sample.t_s;
  out.x_m[out.x_m_count++] = sample.x_m;
  out.y_m[out.y_m_count++] = sample.y_m;
  for (const double term : sample.covariance_m2)
    out.covariance[out.covariance_count++] = static_cast<float>(term);
}

void add(groma_LogTimes& out, const model::ZeroVelocitySample& sample) {
  out.t_s[out.t_s_count++] = sample.t_s;
}

// Omits a column in which all values are unknown.
template <typename Value>
void drop_if_all(pb_size_t& count, const Value* values, Value unknown) {
  if (std::all_of(values, values + count, [&](Value value) { return value == unknown; })) count = 0;
}

// Most records have no optional columns.
template <typename Columns>
void drop_unknown_columns(Columns& /*columns*/) {}

void drop_unknown_columns(groma_LogRanges& ranges) {
  drop_if_all(ranges.first_path_power_cdbm_count, ranges.first_path_power_cdbm, kNoPower);
  drop_if_all(ranges.receive_power_cdbm_count, ranges.receive_power_cdbm, kNoPower);
  drop_if_all(ranges.clock_offset_ppb_count, ranges.clock_offset_ppb, kNoOffset);
  drop_if_all(ranges.noise_count, ranges.noise, std::uint16_t{0});
  drop_if_all(ranges.flags_count, ranges.flags, std::uint8_t{0});
  drop_if_all(ranges.network_time_dtu_count, ranges.network_time_dtu, std::int64_t{0});
}

void drop_unknown_columns(groma_LogPoses& poses) {
  const auto unknown = [](double value) { return !std::isfinite(value); };
  if (std::all_of(poses.roll_rad, poses.roll_rad + poses.roll_rad_count, unknown)) poses.roll_rad_count = 0;
  if (std::all_of(poses.pitch_rad, poses.pitch_rad + poses.pitch_rad_count, unknown)) {
    poses.pitch_rad_count = 0;
  }
  if (std::none_of(poses.covariance, poses.covariance + poses.covariance_count,
                   [](float term) { return std::isfinite(term); })) {
    poses.covariance_count = 0;
  }
}

constexpr pb_size_t kTerms{model::PoseCovariance{}.size()};

// The covariance of one pose: true if it is unknown (all NaN) or valid.
bool take_covariance(const float* terms, std::optional<model::PoseCovariance>& out) {
  model::PoseCovariance wide{};
  std::copy(terms, terms + kTerms, wide.begin());
  if (std::all_of(wide.begin(), wide.end(), [](double term) { return std::isnan(term); })) return true;
  out = wide;
  return model::is_covariance(wide);
}

bool all_finite(const double* values, pb_size_t count) {
  return std::all_of(values, values + count, [](double value) { return std::isfinite(value); });
}

// Returns false, and takes nothing, if the columns differ in length or hold values that no measurement has.
bool take(const groma_LogRanges& in, std::vector<model::RangeSample>& out) {
  const pb_size_t n = in.t_s_count;
  const auto whole = [n](pb_size_t count) { return count == n; };
  const auto whole_or_absent = [n](pb_size_t count) { return count == n || count == 0; };
  if (!whole(in.tag_id_count) || !whole(in.anchor_id_count) || !whole(in.range_m_count) ||
      !whole_or_absent(in.first_path_power_cdbm_count) || !whole_or_absent(in.receive_power_cdbm_count) ||
      !whole_or_absent(in.clock_offset_ppb_count) || !whole_or_absent(in.noise_count) ||
      !whole_or_absent(in.flags_count) || !whole_or_absent(in.network_time_dtu_count) ||
      !all_finite(in.t_s, n) ||
      !std::all_of(in.range_m, in.range_m + n, [](float range_m) { return std::isfinite(range_m); })) {
    return false;
  }
  std::int64_t network_time_dtu = 0;
  for (pb_size_t i = 0; i < n; ++i) {
    model::RangeSample& range = out.emplace_back();
    range.t_s = in.t_s[i];
    range.tag_id = in.tag_id[i];
    range.anchor_id = in.anchor_id[i];
    range.range_m = static_cast<double>(in.range_m[i]);
    if (in.first_path_power_cdbm_count > 0) {
      range.first_path_power_dbm = of_steps(in.first_path_power_cdbm[i], kNoPower, 100.0F);
    }
    if (in.receive_power_cdbm_count > 0) {
      range.receive_power_dbm = of_steps(in.receive_power_cdbm[i], kNoPower, 100.0F);
    }
    if (in.clock_offset_ppb_count > 0) {
      range.clock_offset_ppm = of_steps(in.clock_offset_ppb[i], kNoOffset, 1000.0F);
    }
    if (in.noise_count > 0 && in.noise[i] != 0) range.noise = static_cast<float>(in.noise[i]);
    if (in.flags_count > 0) {
      range.line_of_sight = static_cast<model::LineOfSight>(in.flags[i] & kLineOfSightMask);
      range.corrections = static_cast<std::uint8_t>(in.flags[i] & ~kLineOfSightMask);
    }
    if (in.network_time_dtu_count > 0) {
      network_time_dtu += in.network_time_dtu[i];
      range.network_time_dtu = network_time_dtu;
    }
  }
  return true;
}

bool take(const groma_LogOdometry& in, std::vector<model::OdometrySample>& out) {
  const pb_size_t n = in.t_s_count;
  if (in.vx_mps_count != n || in.vy_mps_count != n || in.omega_radps_count != n || !all_finite(in.t_s, n) ||
      !all_finite(in.vx_mps, n) || !all_finite(in.vy_mps, n) || !all_finite(in.omega_radps, n)) {
    return false;
  }
  for (pb_size_t i = 0; i < n; ++i) {
    out.push_back({in.t_s[i], in.vx_mps[i], in.vy_mps[i], in.omega_radps[i]});
  }
  return true;
}

bool take(const groma_LogPoses& in, std::vector<model::PoseSample>& out) {
  const pb_size_t n = in.t_s_count;
  if (in.x_m_count != n || in.y_m_count != n || in.z_m_count != n || in.yaw_rad_count != n ||
      (in.roll_rad_count != n && in.roll_rad_count != 0) ||
      (in.pitch_rad_count != n && in.pitch_rad_count != 0) ||
      (in.covariance_count != kTerms * n && in.covariance_count != 0) || !all_finite(in.t_s, n) ||
      !all_finite(in.x_m, n) || !all_finite(in.y_m, n) || !all_finite(in.z_m, n) ||
      !all_finite(in.yaw_rad, n)) {
    return false;
  }
  std::vector<std::optional<model::PoseCovariance>> covariances(n);
  for (pb_size_t i = 0; i < n && in.covariance_count > 0; ++i) {
    if (!take_covariance(in.covariance + kTerms * std::size_t{i}, covariances[i])) return false;
  }
  for (pb_size_t i = 0; i < n; ++i) {
    model::PoseSample& pose = out.emplace_back();
    pose.t_s = in.t_s[i];
    pose.x_m = in.x_m[i];
    pose.y_m = in.y_m[i];
    pose.z_m = in.z_m[i];
    pose.yaw_rad = in.yaw_rad[i];
    if (in.roll_rad_count > 0) pose.roll_rad = in.roll_rad[i];
    if (in.pitch_rad_count > 0) pose.pitch_rad = in.pitch_rad[i];
    pose.covariance = covariances[i];
  }
  return true;
}

bool take(const groma_LogYawRates& in, std::vector<model::YawRateSample>& out) {
  const pb_size_t n = in.t_s_count;
  if (in.omega_radps_count != n || !all_finite(in.t_s, n) || !all_finite(in.omega_radps, n)) return false;
  for (pb_size_t i = 0; i < n; ++i) out.push_back({in.t_s[i], in.omega_radps[i]});
  return true;
}

constexpr pb_size_t kPositionTerms{std::tuple_size_v<decltype(model::PositionSample::covariance_m2)>};

bool take(const groma_LogPositions& in, std::vector<model::PositionSample>& out) {
  const pb_size_t n = in.t_s_count;
  if (in.x_m_count != n || in.y_m_count != n || in.covariance_count != kPositionTerms * n ||
      !all_finite(in.t_s, n) || !all_finite(in.x_m, n) || !all_finite(in.y_m, n)) {
    return false;
  }
  std::vector<model::PositionSample> read;
  read.reserve(n);
  for (pb_size_t i = 0; i < n; ++i) {
    model::PositionSample& position = read.emplace_back();
    position = {in.t_s[i], in.x_m[i], in.y_m[i], {}};
    const float* terms = in.covariance + kPositionTerms * std::size_t{i};
    std::copy(terms, terms + kPositionTerms, position.covariance_m2.begin());
    if (!model::is_covariance(position.covariance_m2)) return false;
  }
  out.insert(out.end(), read.begin(), read.end());
  return true;
}

bool take(const groma_LogTimes& in, std::vector<model::ZeroVelocitySample>& out) {
  const pb_size_t n = in.t_s_count;
  if (!all_finite(in.t_s, n)) return false;
  for (pb_size_t i = 0; i < n; ++i) out.push_back({in.t_s[i]});
  return true;
}

void take(const groma_LogFile& in, std::vector<DescriptionFile>& out) {
  if (out.empty() || out.back().name != in.name) out.push_back({in.name, {}});
  out.back().text.append(reinterpret_cast<const char*>(in.content.bytes), in.content.size);
}

// Those of log_event.hpp.
bool is_event(pb_size_t tag) {
  return tag >= groma_LogRecord_state_tag && tag <= groma_LogRecord_digest_tag;
}

// False if the record is invalid.
bool take(const groma_LogRecord& record, bool with_samples, std::vector<LogSection>& sections) {
  if (record.which_body == groma_LogRecord_start_tag) {
    LogSection& section = sections.emplace_back();
    section.program_version = record.body.start.program_version;
    section.unix_time_ns = record.body.start.unix_time_ns;
    return true;
  }
  if (sections.empty()) return is_event(record.which_body);
  LogSection& section = sections.back();
  switch (record.which_body) {
    case groma_LogRecord_file_tag:
      take(record.body.file, section.description);
      return true;
    case groma_LogRecord_ranges_tag:
      return !with_samples || take(record.body.ranges, section.samples.ranges);
    case groma_LogRecord_odometry_tag:
      return !with_samples || take(record.body.odometry, section.samples.odometry);
    case groma_LogRecord_poses_tag:
      return !with_samples || take(record.body.poses, section.samples.poses);
    case groma_LogRecord_yaw_rates_tag:
      return !with_samples ||
             take(record.body.yaw_rates, model::samples_of<model::YawRateSample>(section.samples.sensors));
    case groma_LogRecord_positions_tag:
      return !with_samples ||
             take(record.body.positions, model::samples_of<model::PositionSample>(section.samples.sensors));
    case groma_LogRecord_absolute_poses_tag:
      return !with_samples ||
             take(record.body.absolute_poses, model::samples_of<model::PoseSample>(section.samples.sensors));
    case groma_LogRecord_zero_velocities_tag:
      return !with_samples || take(record.body.zero_velocities,
                                   model::samples_of<model::ZeroVelocitySample>(section.samples.sensors));
    default:
      return is_event(record.which_body);
  }
}

}  // namespace

// The records being filled, and buffers to encode one.
struct LogEncoder::Records {
  using Body = decltype(groma_LogRecord::body);
  // One record of columns; it is cleared after it is appended.
  template <typename Columns>
  struct Filling {
    Filling(pb_size_t tag, Columns Body::*of_body) : which(tag), member(of_body) { clear(); }
    void clear() {
      record = groma_LogRecord_init_zero;
      record.which_body = which;
    }
    Columns& columns() { return record.body.*member; }

    groma_LogRecord record = groma_LogRecord_init_zero;
    pb_size_t which;
    Columns Body::*member;
  };

  Filling<groma_LogRanges> ranges{groma_LogRecord_ranges_tag, &Body::ranges};
  Filling<groma_LogOdometry> odometry{groma_LogRecord_odometry_tag, &Body::odometry};
  Filling<groma_LogPoses> poses{groma_LogRecord_poses_tag, &Body::poses};
  // In the order of model::SensorSample.
  std::tuple<Filling<groma_LogYawRates>, Filling<groma_LogPositions>, Filling<groma_LogPoses>,
             Filling<groma_LogTimes>>
      sensors{{groma_LogRecord_yaw_rates_tag, &Body::yaw_rates},
              {groma_LogRecord_positions_tag, &Body::positions},
              {groma_LogRecord_absolute_poses_tag, &Body::absolute_poses},
              {groma_LogRecord_zero_velocities_tag, &Body::zero_velocities}};
  std::int64_t network_time_dtu = 0;  // of the record's last range
  std::array<std::uint8_t, groma_LogRecord_size> payload{};
  std::array<std::uint8_t, wire::max_encoded_size(groma_LogRecord_size)> frame{};

  template <typename Columns, typename Sample>
  void put(Filling<Columns>& filling, const Sample& sample, std::string& out) {
    add(filling.columns(), sample);
    finish_if_full(filling, out);
  }
  template <typename Columns>
  void finish(Filling<Columns>& filling, std::string& out) {
    if (filling.columns().t_s_count == 0) return;
    drop_unknown_columns(filling.columns());
    append(filling.record, out);
    filling.clear();
  }
  template <typename Columns>
  void finish_if_full(Filling<Columns>& filling, std::string& out) {
    if (filling.columns().t_s_count == std::size(filling.columns().t_s)) finish(filling, out);
  }
  void append(const groma_LogRecord& record, std::string& out) {
    pb_ostream_t stream = pb_ostream_from_buffer(payload.data(), payload.size());
    if (!pb_encode(&stream, groma_LogRecord_fields, &record)) return;  // cannot happen: the buffer fits
    const std::size_t size = wire::encode_frame(std::span(payload).first(stream.bytes_written), frame);
    out.append(reinterpret_cast<const char*>(frame.data()), size);
  }
};

LogEncoder::LogEncoder() : records_(std::make_unique<Records>()) {}
LogEncoder::~LogEncoder() = default;

void LogEncoder::begin_section(std::span<const DescriptionFile> description, std::uint64_t unix_time_ns,
                               bool continues) {
  flush();
  put(SectionStart{program_version(), unix_time_ns, continues});
  groma_LogRecord record = groma_LogRecord_init_zero;
  for (const DescriptionFile& file : description) {
    for (std::size_t begin = 0; begin < file.text.size(); begin += sizeof(record.body.file.content.bytes)) {
      record = groma_LogRecord_init_zero;
      record.which_body = groma_LogRecord_file_tag;
      file.name.copy(record.body.file.name, sizeof(record.body.file.name) - 1);
      const std::size_t size = std::min(sizeof(record.body.file.content.bytes), file.text.size() - begin);
      std::memcpy(record.body.file.content.bytes, file.text.data() + begin, size);
      record.body.file.content.size = static_cast<pb_size_t>(size);
      records_->append(record, bytes_);
    }
  }
}

void LogEncoder::put(const model::RangeSample& range) {
  groma_LogRanges& ranges = records_->ranges.columns();
  add(ranges, range, ranges.t_s_count > 0 ? records_->network_time_dtu : 0);
  records_->network_time_dtu = range.network_time_dtu;
  records_->finish_if_full(records_->ranges, bytes_);
}

void LogEncoder::put(const model::OdometrySample& sample) {
  records_->put(records_->odometry, sample, bytes_);
}

void LogEncoder::put(const model::PoseSample& pose) {
  records_->put(records_->poses, pose, bytes_);
}

void LogEncoder::put(const model::SensorSample& sample) {
  std::visit(
      [this]<class Sample>(const Sample& of) {
        records_->put(std::get<model::kSensorOf<Sample>>(records_->sensors), of, bytes_);
      },
      sample);
}

void LogEncoder::flush() {
  records_->finish(records_->ranges, bytes_);
  records_->finish(records_->odometry, bytes_);
  records_->finish(records_->poses, bytes_);
  std::apply([this](auto&... sensors) { (records_->finish(sensors, bytes_), ...); }, records_->sensors);
}

std::string LogEncoder::take() {
  return std::exchange(bytes_, {});
}

LogContent parse_log(std::string_view bytes, std::optional<std::size_t> only) {
  LogContent content;
  const auto decoder = std::make_unique<wire::FrameDecoder>();
  groma_LogRecord record = groma_LogRecord_init_zero;
  std::size_t section = 0;  // of the current frame, from 1
  for (const char byte : bytes) {
    if (!decoder->push(static_cast<std::uint8_t>(byte))) continue;
    const std::span<const std::uint8_t> payload = decoder->payload();
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    record = groma_LogRecord_init_zero;
    const bool understood = pb_decode(&stream, groma_LogRecord_fields, &record);
    if (understood && record.which_body == groma_LogRecord_start_tag) {
      // The last section is not known in advance: drop a section's samples when the next one begins.
      if (!only && !content.sections.empty()) {
        content.sections.back().samples = {};
      }
      ++section;
    }
    if (!understood || !take(record, !only || section == *only, content.sections)) {
      content.damaged_bytes += decoder->encoded_size();
    }
  }
  decoder->reset();
  content.damaged_bytes += decoder->counters().bytes_discarded;
  return content;
}

}  // namespace groma::io
