#include "host/daemon/config.hpp"

#include <arpa/inet.h>
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <limits>
#include <set>

#include "host/filter/state.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/input_file.hpp"
#include "host/io/site_description.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/link/can_path.hpp"
#include "host/link/network_link.hpp"
#include "host/link/usb_port.hpp"

namespace groma::daemon {
namespace {

using io::YamlValue;

constexpr double kMinDrive_s = 10.0;
constexpr double kMaxDrive_s = 3600.0;
constexpr double kMaxReorderLag_s = 0.5;  // SessionConfig::max_delay_s: later measurements are dropped
constexpr double kMaxSpeed = 1000.0;
constexpr std::array<std::string_view, 2> kSwitch{"false", "true"};

std::filesystem::path parse_path(const YamlValue& yaml, const std::filesystem::path& folder) {
  const std::string text = yaml.text();
  if (text.empty()) yaml.fail("is empty", "name a path");
  return folder / text;
}

bool is_numeric_address(const std::string& text) {
  in_addr v4{};
  in6_addr v6{};
  return ::inet_pton(AF_INET, text.c_str(), &v4) == 1 || ::inet_pton(AF_INET6, text.c_str(), &v6) == 1;
}

// A path, or tcp://HOST:PORT and the like.
std::filesystem::path parse_address(const YamlValue& yaml, const std::filesystem::path& folder) {
  const std::string text = yaml.text();
  if (!link::is_network_path(text)) return parse_path(yaml, folder);
  if (!link::parse_network_path(text)) yaml.fail("is no address", std::string(link::kNetworkPathAdvice));
  return text;
}

double parse_between(const YamlValue& yaml, double min, double max) {
  const double value = yaml.number();
  if (!(value >= min && value <= max)) {
    yaml.fail(fmt::format("is {}", value), fmt::format("it has to be from {} to {}", min, max));
  }
  return value;
}

NodeLink parse_serial_node(const YamlValue& entry, const std::filesystem::path& folder) {
  NodeLink node;
  const auto serial = entry.find("serial");
  const auto path = entry.find("path");
  if (serial.has_value() == path.has_value()) {
    entry.fail("must have either 'path' or 'serial'",
               "name the port, or the serial number of its USB device");
  }
  if (serial) {
    if (serial->text().empty()) serial->fail("is empty", "name the serial number of a USB device");
    node.path = std::string(link::kUsbPortScheme) + serial->text();
  } else {
    node.path = parse_address(*path, folder);
  }
  if (const auto baud = entry.find("baud")) {
    node.baud = static_cast<unsigned>(baud->integer(1200, 4'000'000));
  }
  return node;
}

NodeLink parse_can_node(const YamlValue& entry) {
  const YamlValue path = entry.at("path");
  if (const auto serial = entry.find("serial")) {
    serial->fail("cannot be combined with a node on a CAN bus", "remove one of them");
  }
  const auto can = link::parse_can_path(path.text());
  if (!can) path.fail("names no node on a CAN bus", std::string(link::kCanPathAdvice));
  if (const auto baud = entry.find("baud")) {
    baud->fail("is for serial ports only", "remove it: a CAN interface's bit rate is set with 'ip link'");
  }
  return {path.text(), link::equivalent_baud(can->format)};
}

// Must be unique among the entries. A CAN node's identity does not depend on the frame format, that of a USB
// device not on leading zeros.
std::string identity_of(const NodeLink& node) {
  const std::string path = node.path.string();
  if (const auto can = link::parse_can_path(path)) return fmt::format("can:{}/{}", can->interface, can->node);
  if (!link::is_usb_port_path(path)) return path;
  const std::size_t digits = path.find_first_not_of('0', link::kUsbPortScheme.size());
  return std::string(link::kUsbPortScheme) + path.substr(std::min(digits, path.size()));
}

std::vector<NodeLink> parse_nodes(const YamlValue& yaml, const std::filesystem::path& folder) {
  std::vector<NodeLink> nodes;
  std::set<std::string> seen;
  for (const YamlValue& entry : yaml.list()) {
    entry.expect_keys({{}, {"path", "serial", "baud"}});
    const auto path = entry.find("path");
    NodeLink node =
        path && link::is_can_path(path->text()) ? parse_can_node(entry) : parse_serial_node(entry, folder);
    if (!seen.insert(identity_of(node)).second) {
      path.value_or(entry).fail("is given twice", "name each port, or node of a bus, once");
    }
    nodes.push_back(std::move(node));
  }
  if (nodes.empty()) yaml.fail("is empty", "name the port of each tag");
  return nodes;
}

std::vector<model::Tag> parse_tags(const YamlValue& yaml) {
  std::vector<model::Tag> tags;
  for (const YamlValue& entry : yaml.list()) {
    entry.expect_keys({{"id", "lever_arm_m"}});
    const auto id =
        static_cast<model::NodeId>(entry.at("id").integer(0, std::numeric_limits<model::NodeId>::max()));
    const bool repeated =
        std::any_of(tags.begin(), tags.end(), [&](const auto& tag) { return tag.id == id; });
    if (repeated) entry.at("id").fail("is given twice", "name each tag once");
    const std::vector<double> arm_m = entry.at("lever_arm_m").numbers(3);
    tags.push_back({id, {arm_m[0], arm_m[1], arm_m[2]}});
  }
  if (tags.empty()) yaml.fail("is empty", "name each tag of the robot with its lever arm");
  if (tags.size() > filter::kMaxTags) {
    yaml.fail(fmt::format("has {} tags", tags.size()), fmt::format("at most {} are used", filter::kMaxTags));
  }
  std::sort(tags.begin(), tags.end(), [](const auto& a, const auto& b) { return a.id < b.id; });
  return tags;
}

CalibrationSource parse_calibration_source(const YamlValue& yaml, const std::filesystem::path& folder) {
  CalibrationSource source;
  yaml.expect_keys({{}, {"file", "drive_s", "learn", "output"}});
  const auto file = yaml.find("file");
  const auto drive_s = yaml.find("drive_s");
  const auto learn = yaml.find("learn");
  const auto output = yaml.find("output");
  source.learn = learn && learn->one_of(kSwitch) == 1;
  if (file) source.file = parse_path(*file, folder);
  if (output) source.output = parse_path(*output, folder);
  if (source.learn) {
    if (drive_s) drive_s->fail("cannot be combined with 'learn'", "remove one of them");
    return source;
  }
  if (file.has_value() == drive_s.has_value()) {
    yaml.fail("must have either 'file' or 'drive_s'",
              "give a calibration, the length of a calibration drive, or 'learn: true'");
  }
  if (file) {
    if (output) output->fail("requires 'drive_s' or 'learn'", "remove it: the file is not changed");
    return source;
  }
  source.drive_s = parse_between(*drive_s, kMinDrive_s, kMaxDrive_s);
  return source;
}

void parse_robot(const YamlValue& yaml, const std::filesystem::path& folder, io::InputFiles& files,
                 Config& config) {
  const auto socket = yaml.find("robot_socket");
  const auto robot = yaml.find("robot");
  if (socket.has_value() == robot.has_value()) {
    yaml.fail("must have either 'robot_socket' or 'robot'",
              "name the robot's socket, or give 'listen' or the signals on its CAN bus");
  }
  if (socket) {
    config.robot_socket = parse_address(*socket, folder);
  } else if (const auto listen = robot->find("listen")) {
    robot->expect_keys({{"listen"}});
    config.robot_listen = parse_address(*listen, folder);
    const auto network = link::parse_network_path(config.robot_listen.string());
    if (network && (!is_numeric_address(network->host) || network->local_port)) {
      listen->fail("is not a numeric address and a port",
                   "write tcp://127.0.0.1:4723 for this computer only, tcp://0.0.0.0:4723 for the network");
    }
  } else {
    config.robot_can = parse_can_signals(*robot, folder, files);
  }
}

// Keys that are absent keep their values.
void parse_endpoint(const YamlValue& yaml, Endpoint& endpoint) {
  yaml.expect_keys({{}, {"address", "port"}});
  if (const auto address = yaml.find("address")) {
    endpoint.address = address->text();
    if (!is_numeric_address(endpoint.address)) {
      address->fail("is not a numeric address",
                    "write 127.0.0.1 for this computer only, 0.0.0.0 for the network");
    }
  }
  if (const auto port = yaml.find("port")) {
    endpoint.port = static_cast<std::uint16_t>(port->integer(0, std::numeric_limits<std::uint16_t>::max()));
  }
}

filter::Model parse_model(const YamlValue& yaml) {
  const auto model = filter::model_from_name(yaml.text());
  if (!model) {
    std::string names;
    for (const filter::Model known : filter::kModels) {
      names += (names.empty() ? "" : ", ") + std::string(filter::model_name(known));
    }
    yaml.fail("is not a model", "choose one of " + names);
  }
  return *model;
}

}  // namespace

std::vector<io::DescriptionFile> Config::description() const {
  io::Dataset dataset;
  dataset.name = "a log of gromad";
  dataset.origin = "recorded";
  dataset.odometry_noise = odometry;
  dataset.range_priors = range;
  dataset.sensors = sensors;
  dataset.surface = surface;
  dataset.tags = tags;
  return io::describe(dataset);
}

filter::Config Config::filter_config() const {
  filter::Config out;
  out.model = model;
  out.odometry = odometry;
  out.range_sigma_m = range.sigma_m;
  out.sensors = filter::SensorConfig(sensors);
  out.range_delay_sigma_s = filter::kRangeDelaySigma_s;
  out.odometry_delay_sigma_s = filter::kOdometryDelaySigma_s;
  return out;
}

Config read_config(const std::filesystem::path& path) {
  io::InputFiles files;
  const YamlValue yaml = YamlValue::parse(path, files.read(path));
  const std::filesystem::path folder = path.parent_path();
  yaml.expect_keys({{"schema", "nodes", "tags", "odometry", "range", "surface", "calibration"},
                    {"robot_socket", "robot", "imu", "gnss", "model", "pose_stream", "web", "log",
                     "last_pose", "reorder_lag_s", "speed"}});
  if (yaml.at("schema").integer(0, std::numeric_limits<std::int64_t>::max()) != 1) {
    yaml.at("schema").fail("is not 1", "this program reads schema 1 only");
  }
  Config config;
  config.nodes = parse_nodes(yaml.at("nodes"), folder);
  parse_robot(yaml, folder, files, config);
  config.tags = parse_tags(yaml.at("tags"));
  config.odometry = io::parse_odometry_noise(yaml.at("odometry"));
  config.range = io::parse_range_priors(yaml.at("range"));
  config.sensors = io::parse_sensors(yaml);
  config.surface = io::parse_surface(yaml.at("surface"), folder, files);
  config.calibration = parse_calibration_source(yaml.at("calibration"), folder);
  if (const auto model = yaml.find("model")) config.model = parse_model(*model);
  if (const auto stream = yaml.find("pose_stream")) parse_endpoint(*stream, config.pose_stream);
  if (const auto web = yaml.find("web")) {
    parse_endpoint(*web, config.web.emplace(Endpoint{.address = "127.0.0.1", .port = 4722}));
  }
  if (const auto log = yaml.find("log")) config.log = parse_path(*log, folder);
  if (const auto pose = yaml.find("last_pose")) config.last_pose = parse_path(*pose, folder);
  if (const auto lag = yaml.find("reorder_lag_s")) {
    config.reorder_lag_s = parse_between(*lag, 0.0, kMaxReorderLag_s);
  }
  if (const auto speed = yaml.find("speed")) {
    config.speed = parse_between(*speed, 1.0 / kMaxSpeed, kMaxSpeed);
    if (config.robot_can && config.speed != 1.0)
      speed->fail("cannot be combined with odometry over CAN",
                  "remove it: such odometry has this computer's time");
  }
  return config;
}

}  // namespace groma::daemon
