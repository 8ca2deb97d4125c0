#include "host/io/dataset_writer.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <iterator>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <variant>

#include "host/io/output_file.hpp"

namespace groma::io {

namespace {

template <typename... Values>
void add(std::string& text, fmt::format_string<const Values&...> format, const Values&... values) {
  fmt::format_to(std::back_inserter(text), format, values...);
}

// YAML's double-quoted style.
std::string double_quoted(std::string_view plain) {
  std::string text = "\"";
  for (const char c : plain) {
    if (c == '"' || c == '\\') text += '\\';
    text += c;
  }
  return text + '"';
}

std::string spline_file(const model::Surface& surface, std::size_t chart) {
  return surface.chart_count() == 1 ? "surface.csv" : fmt::format("surface_{}.csv", chart + 1);
}

std::string format_chart(const model::Chart& chart, const std::string& file) {
  std::string text;
  if (std::holds_alternative<model::BSpline>(chart.shape)) {
    text = fmt::format("{{type: bspline, file: {}", file);
  } else {
    const model::SurfacePoint origin = std::get<model::Plane>(chart.shape).at(0.0, 0.0);
    text = fmt::format("{{type: plane, z_m: {}, normal: [{}, {}, 1]", origin.z_m, -origin.gradient.x(),
                       -origin.gradient.y());
  }
  if (chart.mismatch.is_any()) {
    add(text, ", mismatch: {{sigma_m: {}, slope_sigma: {}, length_m: {}}}", chart.mismatch.sigma_m,
        chart.mismatch.slope_sigma, chart.mismatch.length_m);
  }
  return text + '}';
}

std::string format_description(const Dataset& dataset) {
  std::string text = "schema: 1\n";
  add(text, "name: {}\norigin: {}\n", double_quoted(dataset.name), double_quoted(dataset.origin));
  const model::OdometryNoise& odometry = dataset.odometry_noise;
  add(text, "odometry: {{sigma_vx_mps: {}, sigma_vy_mps: {}, sigma_omega_radps: {}", odometry.sigma_vx_mps,
      odometry.sigma_vy_mps, odometry.sigma_omega_radps);
  if (odometry.sigma_curve > 0.0) add(text, ", sigma_curve: {}", odometry.sigma_curve);
  text += "}\n";
  const model::RangePriors& range = dataset.range_priors;
  add(text, "range: {{sigma_m: {}", range.sigma_m);
  for (const model::PairTerm& term : model::kPairTerms) {
    const model::ScalarPrior& prior = range.*term.prior;
    add(text, ", {}: [{}, {}]", term.key.value, prior.mean, prior.sigma);
  }
  text += "}\n";
  const model::SensorDescription& sensors = dataset.sensors;
  if (sensors.gyro_sigma_radps || sensors.gyro_bias_sigma_radps) {
    text += "imu: {";
    if (sensors.gyro_sigma_radps) add(text, "sigma_omega_radps: {}", *sensors.gyro_sigma_radps);
    if (sensors.gyro_sigma_radps && sensors.gyro_bias_sigma_radps) text += ", ";
    if (sensors.gyro_bias_sigma_radps) add(text, "bias_sigma_radps: {}", *sensors.gyro_bias_sigma_radps);
    text += "}\n";
  }
  if (sensors.gnss_lever_arm_m) {
    const Eigen::Vector3d& arm_m = *sensors.gnss_lever_arm_m;
    add(text, "gnss: {{lever_arm_m: [{}, {}, {}]}}\n", arm_m.x(), arm_m.y(), arm_m.z());
  }
  const std::vector<model::Chart>& charts = dataset.surface.charts();
  if (charts.size() == 1 && charts.front().name.empty()) {
    add(text, "surface: {}\n", format_chart(charts.front(), spline_file(dataset.surface, 0)));
    return text;
  }
  text += "surface:\n  type: floors\n  floors:\n";
  for (std::size_t i = 0; i < charts.size(); ++i) {
    add(text, "    - name: {}\n      surface: {}\n", double_quoted(charts[i].name),
        format_chart(charts[i], spline_file(dataset.surface, i)));
    if (charts[i].domain_m.empty()) continue;
    text += "      domain_m: [";
    for (const Eigen::Vector2d& corner : charts[i].domain_m)
      add(text, "{}[{}, {}]", text.back() == '[' ? "" : ", ", corner.x(), corner.y());
    text += "]\n";
  }
  return text;
}

}  // namespace

std::string format_spline(const model::BSpline& spline) {
  const model::BSpline::Grid& grid = spline.grid();
  std::string text =
      "# uniform cubic B-spline: x0_m,y0_m,dx_m,dy_m,nx,ny, then nx rows of ny control heights (m)\n";
  add(text, "{},{},{},{},{},{}\n", grid.x0_m, grid.y0_m, grid.dx_m, grid.dy_m, grid.nx, grid.ny);
  const auto columns = static_cast<std::size_t>(grid.ny);
  for (std::size_t i = 0; i < spline.heights_m().size(); ++i) {
    add(text, "{}{}", spline.heights_m()[i], i % columns + 1 == columns ? '\n' : ',');
  }
  return text;
}

namespace {

// Writes an optional column after the powers only if at least one row has a value for it.
std::string format_ranges(std::span<const model::RangeSample> ranges) {
  using model::RangeSample;
  const auto some = [&](const auto& knows) { return std::any_of(ranges.begin(), ranges.end(), knows); };
  const bool offset = some([](const RangeSample& range) { return std::isfinite(range.clock_offset_ppm); });
  const bool noise = some([](const RangeSample& range) { return std::isfinite(range.noise); });
  const bool line_of_sight =
      some([](const RangeSample& range) { return range.line_of_sight != model::LineOfSight::kNotKnown; });
  const bool corrections = some([](const RangeSample& range) { return range.corrections != 0; });
  const bool network_time = some([](const RangeSample& range) { return range.network_time_dtu != 0; });
  std::string text = "t_s,tag_id,anchor_id,range_m,first_path_power_dbm,receive_power_dbm";
  if (offset) text += ",clock_offset_ppm";
  if (noise) text += ",noise";
  if (line_of_sight) text += ",line_of_sight";
  if (corrections) text += ",corrections";
  if (network_time) text += ",network_time_dtu";
  text += '\n';
  const auto add_known = [&text](float value) {
    text += ',';
    if (std::isfinite(value)) add(text, "{}", value);
  };
  for (const RangeSample& range : ranges) {
    add(text, "{},{},{},{}", range.t_s, range.tag_id, range.anchor_id, range.range_m);
    add_known(range.first_path_power_dbm);
    add_known(range.receive_power_dbm);
    if (offset) add_known(range.clock_offset_ppm);
    if (noise) add_known(range.noise);
    if (line_of_sight) add(text, ",{}", static_cast<unsigned>(range.line_of_sight));
    if (corrections) add(text, ",{}", range.corrections);
    if (network_time) text += ',';
    if (network_time && range.network_time_dtu != 0) add(text, "{}", range.network_time_dtu);
    text += '\n';
  }
  return text;
}

enum class Height { kWritten, kLeftOut };

std::string format_poses(std::span<const model::PoseSample> poses, Height height) {
  const bool attitude = std::any_of(poses.begin(), poses.end(), [](const model::PoseSample& pose) {
    return std::isfinite(pose.roll_rad) || std::isfinite(pose.pitch_rad);
  });
  const bool covariance = std::any_of(
      poses.begin(), poses.end(), [](const model::PoseSample& pose) { return pose.covariance.has_value(); });
  std::string text = height == Height::kWritten ? "t_s,x_m,y_m,z_m,yaw_rad" : "t_s,x_m,y_m,yaw_rad";
  if (attitude) text += ",roll_rad,pitch_rad";
  if (covariance) text += ",p_xx,p_xy,p_xt,p_yy,p_yt,p_tt";
  text += '\n';
  for (const model::PoseSample& pose : poses) {
    add(text, "{},{},{}", pose.t_s, pose.x_m, pose.y_m);
    if (height == Height::kWritten) add(text, ",{}", pose.z_m);
    add(text, ",{}", pose.yaw_rad);
    if (attitude) {
      for (const double angle_rad : {pose.roll_rad, pose.pitch_rad}) {
        text += ',';
        if (std::isfinite(angle_rad)) add(text, "{}", angle_rad);
      }
    }
    if (pose.covariance) {
      for (const double term : *pose.covariance) add(text, ",{}", term);
    } else if (covariance) {
      text.append(model::PoseCovariance{}.size(), ',');
    }
    text += '\n';
  }
  return text;
}

std::string format_odometry(std::span<const model::OdometrySample> samples) {
  std::string text = "t_s,vx_mps,vy_mps,omega_radps\n";
  for (const model::OdometrySample& sample : samples) {
    add(text, "{},{},{},{}\n", sample.t_s, sample.vx_mps, sample.vy_mps, sample.omega_radps);
  }
  return text;
}

std::string format(std::span<const model::YawRateSample> rates) {
  std::string text = "t_s,omega_radps\n";
  for (const model::YawRateSample& rate : rates) add(text, "{},{}\n", rate.t_s, rate.omega_radps);
  return text;
}

std::string format(std::span<const model::PositionSample> positions) {
  std::string text = "t_s,x_m,y_m,p_xx,p_xy,p_yy\n";
  for (const model::PositionSample& position : positions) {
    const auto& [xx, xy, yy] = position.covariance_m2;
    add(text, "{},{},{},{},{},{}\n", position.t_s, position.x_m, position.y_m, xx, xy, yy);
  }
  return text;
}

std::string format(std::span<const model::PoseSample> poses) {
  return format_poses(poses, Height::kLeftOut);
}

std::string format(std::span<const model::ZeroVelocitySample> samples) {
  std::string text = "t_s\n";
  for (const model::ZeroVelocitySample& sample : samples) add(text, "{}\n", sample.t_s);
  return text;
}

void add_point(std::string& text, model::NodeId id, const Eigen::Vector3d& point) {
  add(text, "{},{},{},{}\n", id, point.x(), point.y(), point.z());
}

}  // namespace

std::vector<DescriptionFile> describe(const Dataset& dataset) {
  std::vector<DescriptionFile> files;
  std::string tags = "tag_id,x_m,y_m,z_m\n";
  for (const model::Tag& tag : dataset.tags) add_point(tags, tag.id, tag.lever_arm_m);
  files.push_back({"tags.csv", std::move(tags)});
  for (std::size_t i = 0; i < dataset.surface.charts().size(); ++i) {
    const auto* spline = std::get_if<model::BSpline>(&dataset.surface.charts()[i].shape);
    if (spline == nullptr) continue;
    files.push_back({spline_file(dataset.surface, i), format_spline(*spline)});
  }
  files.push_back({"dataset.yaml", format_description(dataset)});
  return files;
}

void write_dataset(const std::filesystem::path& folder, const Dataset& dataset) {
  make_folder(folder);
  if (!dataset.surveyed_anchors.empty()) {
    std::string text = "anchor_id,x_m,y_m,z_m\n";
    for (const model::Anchor& anchor : dataset.surveyed_anchors)
      add_point(text, anchor.id, anchor.position_m);
    write_file(folder / "anchors.csv", text);
  }
  write_file(folder / "ranges.csv", format_ranges(dataset.ranges));
  write_file(folder / "odometry.csv", format_odometry(dataset.odometry));
  const auto write_poses = [&](const char* name, std::span<const model::PoseSample> poses) {
    if (!poses.empty()) write_file(folder / name, format_poses(poses, Height::kWritten));
  };
  write_poses("groundtruth.csv", dataset.ground_truth);
  write_poses("pose_prior.csv", dataset.pose_prior);
  const auto write_sensor = [&]<class Sample>(const std::vector<Sample>& samples) {
    const std::string_view name = model::kSensorNames.at(model::kSensorOf<Sample>);
    if (!samples.empty())
      write_file(folder / fmt::format("{}.csv", name), format(std::span<const Sample>(samples)));
  };
  std::apply([&](const auto&... tables) { (write_sensor(tables), ...); }, dataset.sensor_samples);
  for (const DescriptionFile& file : describe(dataset)) write_file(folder / file.name, file.text);
}

}  // namespace groma::io
