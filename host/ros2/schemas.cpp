// Fields as in github.com/ros2/common_interfaces, rcl_interfaces and geometry2; the same from Humble on.
#include "host/ros2/schemas.hpp"

#include <algorithm>
#include <array>
#include <vector>

namespace groma::ros2 {

namespace {

struct Definition {
  std::string_view type;
  std::string_view fields;
};

constexpr std::array kDefinitions{
    Definition{"builtin_interfaces/Time", "int32 sec\nuint32 nanosec\n"},
    Definition{"builtin_interfaces/Duration", "int32 sec\nuint32 nanosec\n"},
    Definition{"std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id\n"},
    Definition{"std_msgs/ColorRGBA", "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n"},
    Definition{"geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z\n"},
    Definition{"geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z\n"},
    Definition{"geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"},
    Definition{"geometry_msgs/Pose", "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"},
    Definition{"geometry_msgs/Twist", "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"},
    Definition{"geometry_msgs/Transform",
               "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"},
    Definition{"geometry_msgs/PoseWithCovariance", "geometry_msgs/Pose pose\nfloat64[36] covariance\n"},
    Definition{"geometry_msgs/TwistWithCovariance", "geometry_msgs/Twist twist\nfloat64[36] covariance\n"},
    Definition{"geometry_msgs/PoseStamped", "std_msgs/Header header\ngeometry_msgs/Pose pose\n"},
    Definition{"geometry_msgs/TwistStamped", "std_msgs/Header header\ngeometry_msgs/Twist twist\n"},
    Definition{"geometry_msgs/PoseWithCovarianceStamped",
               "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n"},
    Definition{"geometry_msgs/TwistWithCovarianceStamped",
               "std_msgs/Header header\ngeometry_msgs/TwistWithCovariance twist\n"},
    Definition{"geometry_msgs/TransformStamped",
               "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"},
    Definition{"nav_msgs/Odometry",
               "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
               "geometry_msgs/TwistWithCovariance twist\n"},
    Definition{"tf2_msgs/TFMessage", "geometry_msgs/TransformStamped[] transforms\n"},
    Definition{"sensor_msgs/Imu",
               "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
               "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
               "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
               "float64[9] linear_acceleration_covariance\n"},
    Definition{"sensor_msgs/NavSatStatus", "int8 status\nuint16 service\n"},
    Definition{
        "sensor_msgs/NavSatFix",
        "std_msgs/Header header\nsensor_msgs/NavSatStatus status\nfloat64 latitude\nfloat64 longitude\n"
        "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type\n"},
    Definition{"sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data\n"},
    Definition{"rmw_dds_common/Gid", "uint8[16] data\n"},
    Definition{"rmw_dds_common/NodeEntitiesInfo",
               "string<=256 node_namespace\nstring<=256 node_name\nrmw_dds_common/Gid[] reader_gid_seq\n"
               "rmw_dds_common/Gid[] writer_gid_seq\n"},
    Definition{"rmw_dds_common/ParticipantEntitiesInfo",
               "rmw_dds_common/Gid gid\nrmw_dds_common/NodeEntitiesInfo[] node_entities_info_seq\n"},
    Definition{"diagnostic_msgs/KeyValue", "string key\nstring value\n"},
    Definition{"diagnostic_msgs/DiagnosticStatus",
               "byte level\nstring name\nstring message\nstring hardware_id\n"
               "diagnostic_msgs/KeyValue[] values\n"},
    Definition{"diagnostic_msgs/DiagnosticArray",
               "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status\n"},
    Definition{"visualization_msgs/UVCoordinate", "float32 u\nfloat32 v\n"},
    Definition{"visualization_msgs/MeshFile", "string filename\nuint8[] data\n"},
    Definition{"visualization_msgs/Marker",
               "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n"
               "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n"
               "builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n"
               "std_msgs/ColorRGBA[] colors\nstring texture_resource\nsensor_msgs/CompressedImage texture\n"
               "visualization_msgs/UVCoordinate[] uv_coordinates\nstring text\nstring mesh_resource\n"
               "visualization_msgs/MeshFile mesh_file\nbool mesh_use_embedded_materials\n"},
    Definition{"visualization_msgs/MarkerArray", "visualization_msgs/Marker[] markers\n"},
    // Our own.
    Definition{"groma_msgs/Range",
               "# NaN, and a network_time_dtu of 0: not known; line_of_sight, corrections: as in ranges.csv\n"
               "float64 t_s\nuint16 tag_id\nuint16 anchor_id\nfloat64 range_m\n"
               "float32 first_path_power_dbm\nfloat32 receive_power_dbm\nfloat32 clock_offset_ppm\n"
               "float32 noise\nuint8 line_of_sight\nuint8 corrections\nint64 network_time_dtu\n"},
    Definition{"groma_msgs/Ranges", "std_msgs/Header header\ngroma_msgs/Range[] ranges\n"},
    Definition{"groma_msgs/Position",
               "std_msgs/Header header\nfloat64 x_m\nfloat64 y_m\nfloat64[3] covariance_m2\n"},
};

std::string_view fields_of(std::string_view type) {
  const auto* const found = std::find_if(kDefinitions.begin(), kDefinitions.end(),
                                         [type](const Definition& of) { return of.type == type; });
  return found == kDefinitions.end() ? std::string_view() : found->fields;
}

// Adds the types that the fields contain, and so on.
void add_contained(std::string_view fields, std::vector<std::string_view>& types) {
  while (!fields.empty()) {
    const std::string_view line = fields.substr(0, fields.find('\n'));
    fields.remove_prefix(line.size() + 1);
    const std::string_view type = line.substr(0, line.find_first_of(" ["));
    if (type.find('/') == std::string_view::npos) continue;
    if (std::find(types.begin(), types.end(), type) != types.end()) continue;
    types.push_back(type);
    add_contained(fields_of(type), types);
  }
}

}  // namespace

std::string schema_of(std::string_view type) {
  std::string name(type);
  if (const std::size_t at = name.find("/msg/"); at != std::string::npos) name.replace(at, 5, "/");
  const std::string_view fields = fields_of(name);
  std::vector<std::string_view> contained;
  add_contained(fields, contained);
  std::string schema(fields);
  for (const std::string_view of : contained) {
    schema += std::string(80, '=') + "\nMSG: ";
    schema += of;
    schema += '\n';
    schema += fields_of(of);
  }
  return schema;
}

}  // namespace groma::ros2
