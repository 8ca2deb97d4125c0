#include "host/convert/export.hpp"

#include <fmt/format.h>

#include <cmath>
#include <iterator>

#include <Eigen/Geometry>
#include <nlohmann/json.hpp>

#include "host/io/calibration_file.hpp"
#include "host/io/csv.hpp"
#include "host/io/input_file.hpp"
#include "host/model/pose.hpp"

namespace groma::convert {

namespace {

using Json = nlohmann::ordered_json;
using Presence = io::CsvReader::Presence;

// R_WT R_z(heading), where roll and pitch are the ZYX angles of the product. Its ZYX yaw differs from the
// heading by a second-order term of the slope: a few steps of fixed-point iteration find it.
Eigen::Matrix3d rotation_on_surface(double heading_rad, double roll_rad, double pitch_rad) {
  double yaw_rad = heading_rad;
  Eigen::Matrix3d rotation;
  constexpr int kSteps = 20;
  for (int i = 0; i < kSteps; ++i) {
    const Eigen::Vector3d normal = model::rotation_from_zyx(yaw_rad, pitch_rad, roll_rad).col(2);
    const Eigen::Vector2d gradient = -normal.head<2>() / normal.z();
    rotation = model::surface_rotation(gradient) * model::rotation_from_zyx(heading_rad, 0.0, 0.0);
    yaw_rad = std::atan2(rotation(1, 0), rotation(0, 0));
  }
  return rotation;
}

Json coordinates(const Eigen::Vector3d& place_m, const std::optional<model::Datum>& datum) {
  const Eigen::Vector3d at = datum ? model::geographic(place_m, *datum) : place_m;
  return Json::array({at.x(), at.y(), at.z()});
}

std::string finish(Json features, const std::optional<model::Datum>& datum) {
  Json out{{"type", "FeatureCollection"}};
  // A foreign member: RFC 7946 has no name for local coordinates.
  if (!datum) out["coordinate_frame"] = "map, metres";
  out["features"] = std::move(features);
  return out.dump(1) + '\n';
}

}  // namespace

std::vector<ExportPose> read_export_poses(const std::filesystem::path& path) {
  const std::string text = io::read_file(path);
  io::CsvReader csv(path, text,
                    {{"t_s"},
                     {"x_m"},
                     {"y_m"},
                     {"yaw_rad"},
                     {"z_m", Presence::kOptional},
                     {"roll_rad", Presence::kOptional},
                     {"pitch_rad", Presence::kOptional},
                     {"p_xx", Presence::kOptional}});
  std::vector<ExportPose> poses;
  while (csv.next()) {
    const double yaw_rad = csv.number(3);
    const double roll_rad = csv.optional_number(5).value_or(0.0);
    const double pitch_rad = csv.optional_number(6).value_or(0.0);
    const Eigen::Matrix3d rotation = csv.has(7) ? rotation_on_surface(yaw_rad, roll_rad, pitch_rad)
                                                : model::rotation_from_zyx(yaw_rad, pitch_rad, roll_rad);
    poses.push_back({csv.number(0),
                     {csv.number(1), csv.number(2), csv.optional_number(4).value_or(0.0)},
                     model::quaternion_of(rotation)});
  }
  return poses;
}

std::string to_tum(const std::vector<ExportPose>& poses) {
  std::string text = "# timestamp tx ty tz qx qy qz qw\n";
  for (const ExportPose& pose : poses) {
    const Eigen::Vector4d& q = pose.quaternion;
    fmt::format_to(std::back_inserter(text), "{} {} {} {} {} {} {} {}\n", pose.t_s, pose.position_m.x(),
                   pose.position_m.y(), pose.position_m.z(), q[0], q[1], q[2], q[3]);
  }
  return text;
}

std::string to_csv(const std::vector<ExportPose>& poses) {
  std::string text = "t_s,x_m,y_m,z_m,qx,qy,qz,qw\n";
  for (const ExportPose& pose : poses) {
    const Eigen::Vector4d& q = pose.quaternion;
    fmt::format_to(std::back_inserter(text), "{},{},{},{},{},{},{},{}\n", pose.t_s, pose.position_m.x(),
                   pose.position_m.y(), pose.position_m.z(), q[0], q[1], q[2], q[3]);
  }
  return text;
}

std::string to_csv(const model::Calibration& calibration) {
  std::string text = "anchor_id,x_m,y_m,z_m,sigma_x_m,sigma_y_m,sigma_z_m,verdict\n";
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!model::has_position(anchor)) continue;
    const Eigen::Vector3d sigma_m = anchor.covariance.diagonal().head<3>().cwiseSqrt();
    fmt::format_to(std::back_inserter(text), "{},{},{},{},{},{},{},{}\n", anchor.id, anchor.position_m.x(),
                   anchor.position_m.y(), anchor.position_m.z(), sigma_m.x(), sigma_m.y(), sigma_m.z(),
                   io::word(anchor.verdict));
  }
  return text;
}

std::string to_geojson(const std::vector<ExportPose>& poses, const std::optional<model::Datum>& datum) {
  Json line = Json::array();
  Json times = Json::array();
  for (const ExportPose& pose : poses) {
    line.push_back(coordinates(pose.position_m, datum));
    times.push_back(pose.t_s);
  }
  Json features = Json::array();
  features.push_back({{"type", "Feature"},
                      {"properties", {{"t_s", std::move(times)}}},
                      {"geometry", {{"type", "LineString"}, {"coordinates", std::move(line)}}}});
  return finish(std::move(features), datum);
}

std::string to_geojson(const model::Calibration& calibration, const std::optional<model::Datum>& datum) {
  Json features = Json::array();
  for (const model::AnchorCalibration& anchor : calibration.anchors) {
    if (!model::has_position(anchor)) continue;
    const Eigen::Vector3d sigma_m = anchor.covariance.diagonal().head<3>().cwiseSqrt();
    features.push_back(
        {{"type", "Feature"},
         {"id", anchor.id},
         {"properties",
          {{"anchor_id", anchor.id},
           {"verdict", io::word(anchor.verdict)},
           {"sigma_m", {sigma_m.x(), sigma_m.y(), sigma_m.z()}},
           {"advice", anchor.advice}}},
         {"geometry", {{"type", "Point"}, {"coordinates", coordinates(anchor.position_m, datum)}}}});
  }
  return finish(std::move(features), datum);
}

}  // namespace groma::convert
