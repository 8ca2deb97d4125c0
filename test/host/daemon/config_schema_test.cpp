// The JSON schema of the configuration allows what the parser allows: both follow from one table of keys.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <yaml-cpp/yaml.h>

#include <algorithm>
#include <cstdlib>
#include <string>
#include <utility>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/daemon/config.hpp"
#include "test/host/daemon/temporary_folder.hpp"

namespace groma::daemon {
namespace {

using nlohmann::json;
using testing::HasSubstr;

constexpr const char* kEachKey = R"(schema: 1
nodes:
  - {path: tag-1, baud: 115200}
  - {path: can:can0/2}
  - {serial: "000760123456"}
robot_socket: robot.sock
tags:
  - {id: 2, lever_arm_m: [-0.3, 0.1, 0.6]}
odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.04, sigma_omega_radps: 0.01}
range: {sigma_m: 0.12, beta_m: [0.3, 0.4], gamma: [1.0, 0.004]}
surface: {type: plane, z_m: 0.5, normal: [0, 0, 1], mismatch: {sigma_m: 0.1, length_m: 2}}
calibration: {learn: true, output: kept.yaml}
imu: {sigma_omega_radps: 0.01}
gnss: {lever_arm_m: [0, 0, 1]}
model: inflated
pose_stream: {address: "::1", port: 4000}
web: {port: 4001, hosts: [robot7], origins: ["https://viewer.example"], token_file: token, tls: {certificate: c, key: k}, walls: walls.csv, simulated: true}
ros2: {domain_id: 5, namespace: robot1/groma, publish_tf: true, graph: iron, tf_topic: /tf, odom_frame: odom, base_frame: base_link, odometry_topic: /odom, imu_topic: /imu, fix_topic: /fix, pose_topic: /slam_pose, initialpose: /initialpose, datum: [50.8, 12.9, 300]}
log: drive.glog
ring: {folder: kept, size_mib: 64}
last_pose: last-pose.json
reorder_lag_s: 0.3
speed: 4
)";

json scalar_to_json(const YAML::Node& node) {
  const std::string& text = node.Scalar();
  if (node.Tag() == "!") return text;
  if (text == "true" || text == "false") return text == "true";
  char* end = nullptr;
  const double number = std::strtod(text.c_str(), &end);
  if (text.empty() || *end != '\0') return text;
  if (text.find_first_not_of("-0123456789") == std::string::npos) return std::stoll(text);
  return number;
}

json to_json(const YAML::Node& node) {
  if (node.IsScalar()) return scalar_to_json(node);
  json out = node.IsSequence() ? json::array() : json::object();
  for (const auto& entry : node) {
    if (node.IsSequence()) {
      out.push_back(to_json(entry));
    } else {
      out[entry.first.Scalar()] = to_json(entry.second);
    }
  }
  return out;
}

bool has_type(const json& value, const std::string& type) {
  return (type == "object" && value.is_object()) || (type == "array" && value.is_array()) ||
         (type == "string" && value.is_string()) || (type == "boolean" && value.is_boolean()) ||
         (type == "integer" && value.is_number_integer()) || (type == "number" && value.is_number());
}

bool allows(const json& schema, const json& value);

bool has_all(const json& value, const json& keys) {
  return std::all_of(keys.begin(), keys.end(), [&](const json& key) { return value.contains(key); });
}

bool meets_choice(const json& schema, const json& value) {
  for (const char* const kind : {"oneOf", "anyOf"}) {
    if (!schema.contains(kind)) continue;
    const json& choices = schema[kind];
    const auto given = std::count_if(choices.begin(), choices.end(),
                                     [&](const json& one) { return has_all(value, one.at("required")); });
    if (given == 0 || (given > 1 && schema.contains("oneOf"))) return false;
  }
  return true;
}

bool allows_members(const json& schema, const json& value) {
  const json all = schema.value("allOf", json::array());
  if (!meets_choice(schema, value) ||
      !std::all_of(all.begin(), all.end(), [&](const json& one) { return meets_choice(one, value); }))
    return false;
  if (!has_all(value, schema.value("required", json::array()))) return false;
  for (const auto& [key, member] : value.items()) {
    if (!schema.at("properties").contains(key) || !allows(schema["properties"][key], member)) return false;
  }
  return true;
}

// The part of JSON Schema that the configuration's schema uses.
bool allows(const json& schema, const json& value) {
  if (schema.contains("anyOf") && !schema.contains("type")) {
    const json& any = schema["anyOf"];
    return std::any_of(any.begin(), any.end(), [&](const json& one) { return allows(one, value); });
  }
  if (schema.contains("enum"))
    return std::find(schema["enum"].begin(), schema["enum"].end(), value) != schema["enum"].end();
  if (!has_type(value, schema.at("type"))) return false;
  if (value.is_object()) return allows_members(schema, value);
  if (value.is_number()) {
    const double number = value;
    return number >= schema.value("minimum", number) && number <= schema.value("maximum", number) &&
           (!schema.contains("exclusiveMinimum") || number > schema["exclusiveMinimum"].get<double>());
  }
  if (!value.is_array()) return true;
  const std::size_t size = value.size();
  return size >= schema.value("minItems", size) && size <= schema.value("maxItems", size) &&
         std::all_of(value.begin(), value.end(),
                     [&](const json& one) { return allows(schema["items"], one); });
}

class ConfigSchema : public testing::Test {
 protected:
  std::vector<ConfigProblem> problems_of(const std::string& text) {
    folder_.write("walls.csv", "x0_m,y0_m,x1_m,y1_m\n");
    return parse_config(folder_.write("gromad.yaml", text)).problems;
  }
  bool schema_allows(const std::string& text) const { return allows(schema_, to_json(YAML::Load(text))); }

  groma::test::TemporaryFolder folder_;
  json schema_ = json::parse(config_schema());
};

// The good file with one text replaced.
std::string with(const std::string& from, const std::string& to) {
  std::string text = kEachKey;
  const std::size_t at = text.find(from);
  EXPECT_NE(at, std::string::npos) << from;
  return text.replace(at, from.size(), to);
}

TEST_F(ConfigSchema, AllowsAFileWithEachKey) {
  EXPECT_TRUE(problems_of(kEachKey).empty()) << problems_of(kEachKey).front().text;
  EXPECT_TRUE(schema_allows(kEachKey));
  for (const auto& [key, property] : schema_["properties"].items()) {
    // In place of robot_socket and odometry.
    if (key != "robot" && key != "steering")
      EXPECT_THAT("\n" + std::string(kEachKey), HasSubstr("\n" + key + ":"));
    EXPECT_FALSE(property.value("description", "").empty()) << key;
  }
}

TEST_F(ConfigSchema, AndParserTakeEitherOdometryOrSteering) {
  const std::string odometry =
      "odometry: {sigma_vx_mps: 0.05, sigma_vy_mps: 0.04, sigma_omega_radps: 0.01}\n";
  const std::string steering = "steering: {wheelbase_m: 1.6}\n";
  EXPECT_TRUE(schema_allows(with(odometry, steering)));
  EXPECT_TRUE(problems_of(with(odometry, steering)).empty());
  for (const std::string& wrong : {std::string(), odometry + steering, std::string("steering: {}\n")}) {
    EXPECT_FALSE(schema_allows(with(odometry, wrong))) << wrong;
    EXPECT_FALSE(problems_of(with(odometry, wrong)).empty()) << wrong;
  }
}

TEST_F(ConfigSchema, AndParserRefuseTheSameTypesAndBounds) {
  const std::pair<const char*, const char*> changes[] = {
      {"baud: 115200", "baud: fast"},
      {"baud: 115200", "baud: 1199"},
      {"baud: 115200", "boud: 115200"},
      {"path: tag-1, ", ""},
      {"id: 2", "id: 65536"},
      {"id: 2", "id: 2.5"},
      {"[-0.3, 0.1, 0.6]", "[-0.3, 0.1]"},
      {"[-0.3, 0.1, 0.6]", "[-0.3, 0.1, high]"},
      {"sigma_vx_mps: 0.05", "sigma_vx_mps: 0"},
      {"beta_m: [0.3, 0.4]", "beta_m: 0.3"},
      {"type: plane", "type: sphere"},
      {"type: plane, z_m: 0.5", "type: plane"},
      {"type: plane, z_m: 0.5", "type: plane, z_m: 0.5, file: a.csv"},
      {"length_m: 2", "length_m: -2"},
      {"learn: true", "learn: maybe"},
      {"learn: true", "drive_s: 9"},
      {"model: inflated", "model: magic"},
      {"port: 4000", "port: 65536"},
      {"reorder_lag_s: 0.3", "reorder_lag_s: 0.6"},
      {"speed: 4", "spede: 4"},
      {"speed: 4", "speed: 0"},
      {"size_mib: 64", "size_mib: 15"},
      {"folder: kept, ", ""},
      {"domain_id: 5", "domain_id: 233"},
      {"graph: iron", "graph: jazzy"},
      {"robot_socket: robot.sock\n", "robot: {listen: {}}\n"},
      {"robot_socket: robot.sock\n", "robot: {}\n"},
      {"robot_socket: robot.sock\n", "robot: {can: can0, signals: {vx_mps: A.B, omega_radps: A.C}}\n"},
      {"robot_socket: robot.sock\n", "robot: {can: can0, dbc: a.dbc, signals: {vx_mps: A.B}}\n"},
      {"{serial: \"000760123456\"}", "{serial: \"000760123456\", path: tag-2}"},
      {"imu: {sigma_omega_radps: 0.01}", "imu: 0.01"},
  };
  for (const auto& [from, to] : changes) {
    EXPECT_FALSE(schema_allows(with(from, to))) << to;
    EXPECT_EQ(problems_of(with(from, to)).size(), 1U) << to;
  }
  std::string without_robot = with("robot_socket: robot.sock\n", "");
  const std::size_t ros2 = without_robot.find("ros2:");
  without_robot.erase(ros2, without_robot.find('\n', ros2) + 1 - ros2);
  EXPECT_FALSE(schema_allows(without_robot));
  EXPECT_EQ(problems_of(without_robot).size(), 1U);
}

TEST_F(ConfigSchema, AllowsTheOtherSurfaces) {
  const std::string plane =
      "{type: plane, z_m: 0.5, normal: [0, 0, 1], mismatch: {sigma_m: 0.1, length_m: 2}}";
  for (const std::string surface : {"{type: bspline, file: a.csv}",
                                    "{type: points, file: a.csv, spacing_m: 2}", "{type: grid, file: a.csv}",
                                    "{type: floors, floors: [{name: hall, surface: {type: bspline, file: "
                                    "a.csv}, domain_m: [[0, 0], [1, 0], "
                                    "[1, 1]]}]}"}) {
    EXPECT_TRUE(schema_allows(with(plane, surface))) << surface;
    // The type is good, the file is missing.
    const auto problems = problems_of(with(plane, surface));
    ASSERT_EQ(problems.size(), 1U) << surface;
    EXPECT_THAT(problems.front().text, HasSubstr("gromad.yaml:11:10: ")) << surface;
    EXPECT_THAT(problems.front().text, HasSubstr("a.csv: does not exist")) << surface;
  }
}

TEST_F(ConfigSchema, AllowsTheOtherRobots) {
  const std::string socket = "robot_socket: robot.sock\n";
  for (const std::string robot :
       {"robot: {listen: tcp://127.0.0.1:4723}\n", "robot_socket: tcp://127.0.0.1:4723\n",
        "robot: {listen: ['tcp://127.0.0.1:4723', 'udp://127.0.0.1:4723']}\n",
        "robot_socket: robot.sock\nrobot: {listen: other.sock}\n"}) {
    EXPECT_TRUE(schema_allows(with(socket, robot))) << robot;
    EXPECT_TRUE(problems_of(with(socket, robot)).empty()) << robot;
  }
  std::string can = with(
      socket,
      "robot: {can: can0, dbc: a.dbc, signals: {vx_mps: A.B, omega_radps: {signal: A.C, scale: 0.5}}}\n");
  can.erase(can.find("speed: 4\n"));
  EXPECT_TRUE(schema_allows(can));
  const auto problems = problems_of(can);
  ASSERT_EQ(problems.size(), 1U);
  EXPECT_THAT(problems.front().text, HasSubstr("a.dbc: does not exist"));
}

}  // namespace
}  // namespace groma::daemon
