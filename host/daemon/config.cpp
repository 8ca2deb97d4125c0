#include "host/daemon/config.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <set>
#include <utility>

#include <nlohmann/json.hpp>

#include "host/daemon/config_values.hpp"
#include "host/filter/state.hpp"
#include "host/io/dataset_writer.hpp"
#include "host/io/input_file.hpp"
#include "host/io/site_description.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/io/yaml_type.hpp"
#include "host/link/can_path.hpp"
#include "host/link/network_link.hpp"
#include "host/link/usb_port.hpp"
#include "host/web/access.hpp"

namespace groma::daemon {
namespace {

using io::YamlType;
using io::YamlValue;

constexpr double kMinDrive_s = 10.0;
constexpr double kMaxDrive_s = 3600.0;
constexpr double kMaxReorderLag_s = 0.5;  // SessionConfig::max_delay_s: later measurements are dropped
constexpr double kMaxSpeed = 1000.0;
constexpr std::int64_t kMinRing_mib = 16;
constexpr std::int64_t kMaxRing_mib = 1 << 20;
constexpr unsigned kMinBaud = 1200;
constexpr unsigned kMaxBaud = 4'000'000;
constexpr auto kMaxId = std::numeric_limits<model::NodeId>::max();

// A path, or tcp://HOST:PORT and the like.
std::filesystem::path parse_address(const YamlValue& yaml, const std::filesystem::path& folder) {
  const std::string text = yaml.text();
  if (!link::is_network_path(text)) return parse_path(yaml, folder);
  if (!link::parse_network_path(text)) yaml.fail("is no address", std::string(link::kNetworkPathAdvice));
  return text;
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
    node.baud = static_cast<unsigned>(baud->integer(kMinBaud, kMaxBaud));
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
  std::string path = node.path.string();
  if (const auto can = link::parse_can_path(path)) return fmt::format("can:{}/{}", can->interface, can->node);
  if (!link::is_usb_port_path(path)) return path;
  const std::size_t digits = path.find_first_not_of('0', link::kUsbPortScheme.size());
  return std::string(link::kUsbPortScheme) + path.substr(std::min(digits, path.size()));
}

std::vector<NodeLink> parse_nodes(const YamlValue& yaml, const std::filesystem::path& folder) {
  std::vector<NodeLink> nodes;
  std::set<std::string> seen;
  for (const YamlValue& entry : yaml.list()) {
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
    const auto id = static_cast<model::NodeId>(entry.at("id").integer(0, kMaxId));
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
  const auto file = yaml.find("file");
  const auto drive_s = yaml.find("drive_s");
  const auto learn = yaml.find("learn");
  const auto output = yaml.find("output");
  source.learn = learn && learn->text() == "true";
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
  source.drive_s = drive_s->number();
  return source;
}

std::filesystem::path parse_listen(const YamlValue& yaml, const std::filesystem::path& folder) {
  std::filesystem::path path = parse_address(yaml, folder);
  const auto network = link::parse_network_path(path.string());
  if (network && (!web::is_numeric_address(network->host) || network->local_port)) {
    yaml.fail("is not a numeric address and a port",
              "write tcp://127.0.0.1:4723 for this computer only, tcp://0.0.0.0:4723 for the network");
  }
  return path;
}

void parse_robot(const YamlValue& robot, const std::filesystem::path& folder, io::InputFiles& files,
                 Config& config) {
  if (const auto listen = robot.find("listen")) {
    const std::vector<YamlValue> all = listen->is_scalar() ? std::vector{*listen} : listen->list();
    if (all.empty()) listen->fail("is empty", "name a socket or a port");
    for (const YamlValue& each : all) {
      const std::filesystem::path path = parse_listen(each, folder);
      if (std::find(config.robot_listen.begin(), config.robot_listen.end(), path) !=
          config.robot_listen.end()) {
        each.fail("is given twice", "name each socket or port once");
      }
      config.robot_listen.push_back(path);
    }
  }
  const bool has_can = robot.find("can") || robot.find("dbc") || robot.find("signals");
  if (has_can || config.robot_listen.empty()) config.robot_can = parse_can_signals(robot, folder, files);
}

RingSettings parse_ring(const YamlValue& yaml, const std::filesystem::path& folder) {
  RingSettings ring{.folder = parse_path(yaml.at("folder"), folder)};
  if (const auto size = yaml.find("size_mib"))
    ring.size_mib = static_cast<std::uint64_t>(size->integer(kMinRing_mib, kMaxRing_mib));
  return ring;
}

constexpr std::array<const char*, 3> kGraphs{"off", "humble", "iron"};  // as Ros2Settings::Graph
constexpr std::int64_t kMaxDomain = 232;                                // the last one whose ports exist

// A name of ROS 2: letters, digits and underscores between slashes, each part beginning with a letter or "_".
bool is_ros2_name(std::string_view name) {
  bool begins = true;
  for (const char c : name) {
    const bool is_letter = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || c == '_';
    const bool is_digit = c >= '0' && c <= '9';
    if (c == '/' ? begins : begins ? !is_letter : !is_letter && !is_digit) return false;
    begins = c == '/';
  }
  return !begins;
}

void parse_ros2_topic(const YamlValue& yaml, const char* key, std::string& topic) {
  const auto value = yaml.find(key);
  if (!value) return;
  topic = value->text();
  if (!topic.empty() && (topic.front() != '/' || !is_ros2_name(std::string_view(topic).substr(1))))
    value->fail("is no name of a topic", "write it as /odom, or \"\" to read none");
}

void parse_ros2_frame(const YamlValue& yaml, const char* key, std::string& frame) {
  const auto value = yaml.find(key);
  if (!value) return;
  frame = value->text();
  if (frame.empty() || frame.front() == '/')
    value->fail("is no name of a frame", "write it as base_link, without a slash in front");
}

Ros2Settings parse_ros2(const YamlValue& yaml) {
  Ros2Settings out;
  if (const auto domain = yaml.find("domain_id"))
    out.domain_id = static_cast<std::uint32_t>(domain->integer(0, kMaxDomain));
  if (const auto name = yaml.find("namespace")) {
    out.name_space = name->text();
    if (!is_ros2_name(out.name_space))
      name->fail("is no namespace", "write it as groma, or robot1/groma, without slashes at its ends");
  }
  if (const auto tf = yaml.find("publish_tf")) out.publishes_tf = tf->text() == "true";
  if (const auto graph = yaml.find("graph")) {
    const auto at = std::find(kGraphs.begin(), kGraphs.end(), graph->text());
    out.graph = static_cast<Ros2Settings::Graph>(at - kGraphs.begin());
  }
  parse_ros2_topic(yaml, "tf_topic", out.tf_topic);
  parse_ros2_frame(yaml, "odom_frame", out.odom_frame);
  parse_ros2_frame(yaml, "base_frame", out.base_frame);
  parse_ros2_topic(yaml, "odometry_topic", out.odometry_topic);
  parse_ros2_topic(yaml, "imu_topic", out.imu_topic);
  parse_ros2_topic(yaml, "fix_topic", out.fix_topic);
  parse_ros2_topic(yaml, "pose_topic", out.pose_topic);
  parse_ros2_topic(yaml, "initialpose", out.initialpose);
  if (const auto datum = yaml.find("datum")) {
    const std::vector<double> terms = datum->numbers(3);
    out.datum = model::Datum{terms[0], terms[1], terms[2]};
    if (!model::is_on_earth(*out.datum))
      datum->fail("is beyond the Earth",
                  "give latitude and longitude of the map's origin in degrees, and its height in m");
  }
  if (!out.fix_topic.empty() && !out.datum)
    yaml.at("fix_topic").fail("needs 'datum'", "give the latitude, longitude and height of the map's origin");
  return out;
}

void parse_speed(const YamlValue& yaml, Config& config) {
  config.speed = yaml.number();
  if (config.robot_can && config.speed != 1.0) {
    yaml.fail("cannot be combined with odometry over CAN",
              "remove it: such odometry has this computer's time");
  }
}

// The keys of which at least one is given.
void expect_robot(const YamlValue& yaml) {
  if (yaml.find("robot_socket") || yaml.find("robot") || yaml.find("ros2")) return;
  yaml.fail("has neither 'robot_socket' nor 'robot' nor 'ros2'",
            "name the robot's socket, give 'listen' or the signals on its CAN bus, or a domain of ROS 2");
}

// What the value of a top-level key is parsed with.
struct Context {
  const std::filesystem::path& folder;
  Config& config;
};

// A top-level key. The types of all are the table that the check, the parser and the JSON schema share.
struct ConfigKey {
  io::YamlKey key;
  void (*parse)(const YamlValue& yaml, const Context& context, io::InputFiles& files);
};

YamlType nodes_type() {
  return YamlType::list(YamlType::map(
      {{"path", YamlType::text(),
        "A serial port, a Unix socket, can:INTERFACE/ID, canfd:INTERFACE/ID, tcp://HOST:PORT or "
        "udp://HOST:PORT.",
        false},
       {"serial", YamlType::text(), "Serial number of a USB device with a serial port.", false},
       {"baud", YamlType::integer(kMinBaud, kMaxBaud), "Bits per second of a serial port.", false}},
      {{.of = {{"path"}, {"serial"}}}}));
}

YamlType robot_type() {
  std::vector<io::YamlKey> signals;
  for (std::size_t i = 0; i < kCanQuantities; ++i) {
    const bool is_required = i == 0 || i == 2;
    signals.push_back(
        {std::string(kCanQuantityNames.at(i)),
         YamlType::text_or(YamlType::map({{"signal", YamlType::text(), "MESSAGE.SIGNAL of the DBC file."},
                                          {"scale", YamlType::number(), "SI units in one unit.", false}})),
         "MESSAGE.SIGNAL of the DBC file, or with a scale.", is_required});
  }
  return YamlType::map(
      {{"listen", YamlType::text_or(YamlType::list(YamlType::text())),
        "A Unix socket, tcp://ADDRESS:PORT or udp://ADDRESS:PORT to serve, or a list of them.", false},
       {"can", YamlType::text(), "Interface of the robot's CAN bus.", false},
       {"dbc", YamlType::text(), "DBC file of its messages.", false},
       {"signals", YamlType::map(std::move(signals)), "The signals of odometry and IMU.", false}},
      {{.of = {{"listen"}, {"can", "dbc", "signals"}}, .combines = true}});
}

YamlType tags_type() {
  return YamlType::list(
      YamlType::map({{"id", YamlType::integer(0, kMaxId), "The tag's id."},
                     {"lever_arm_m", YamlType::numbers(3), "Its antenna in base_link, m."}}));
}

YamlType calibration_type() {
  return YamlType::map(
      {{"file", YamlType::text(), "The calibration file to localize with.", false},
       {"drive_s", YamlType::between(kMinDrive_s, kMaxDrive_s), "Length of a calibration drive, s.", false},
       {"learn", YamlType::boolean(), "Calibrate anchors while driving.", false},
       {"output", YamlType::text(), "The file that receives the calibration.", false}});
}

YamlType ring_type() {
  return YamlType::map(
      {{"folder", YamlType::text(), "Folder of the recording's files; made if it is missing."},
       {"size_mib", YamlType::integer(kMinRing_mib, kMaxRing_mib), "Size of the recording at most, MiB.",
        false}});
}

YamlType ros2_type() {
  return YamlType::map(
      {{"domain_id", YamlType::integer(0, kMaxDomain), "ROS_DOMAIN_ID of the other nodes.", false},
       {"namespace", YamlType::text(), "Of the topics pose, odometry, anchors and links; default groma.",
        false},
       {"publish_tf", YamlType::boolean(), "Whether map to odom is published.", false},
       {"graph", YamlType::word({kGraphs.begin(), kGraphs.end()}),
        "The release of ROS 2 whose node list shows gromad; iron is also for later ones.", false},
       {"tf_topic", YamlType::text(), "Topic of transforms; default /tf.", false},
       {"odom_frame", YamlType::text(), "Frame of the odometry; default odom.", false},
       {"base_frame", YamlType::text(), "Frame of the robot; default base_link.", false},
       {"odometry_topic", YamlType::text(),
        "nav_msgs/Odometry; default /odom, or none if 'robot' or 'robot_socket' is given.", false},
       {"imu_topic", YamlType::text(), "sensor_msgs/Imu.", false},
       {"fix_topic", YamlType::text(), "sensor_msgs/NavSatFix; needs datum.", false},
       {"pose_topic", YamlType::text(), "geometry_msgs/PoseWithCovarianceStamped of another localization.",
        false},
       {"initialpose", YamlType::text(), "geometry_msgs/PoseWithCovarianceStamped; default /initialpose.",
        false},
       {"datum", YamlType::numbers(3), "The map's origin: latitude and longitude in degrees, height in m.",
        false}});
}

YamlType model_type() {
  std::vector<std::string> names;
  names.reserve(std::size(filter::kModels));
  for (const filter::Model model : filter::kModels) names.emplace_back(filter::model_name(model));
  return YamlType::word(std::move(names));
}

void parse_schema(const YamlValue& yaml, const Context& /*context*/, io::InputFiles& /*files*/) {
  if (yaml.integer(0, std::numeric_limits<std::int64_t>::max()) != 1) {
    yaml.fail("is not 1", "this program reads schema 1 only");
  }
}

using Yaml = const YamlValue&;
using In = const Context&;
using Files = io::InputFiles&;

// The keys that describe what is required.
void append_required(std::vector<ConfigKey>& keys) {
  keys.push_back({{"schema", YamlType::integer(0, std::numeric_limits<std::int32_t>::max()),
                   "Version of this format: 1."},
                  parse_schema});
  keys.push_back({{"nodes", nodes_type(), "The port of each tag."},
                  [](Yaml yaml, In in, Files&) { in.config.nodes = parse_nodes(yaml, in.folder); }});
  keys.push_back({{"tags", tags_type(), "The robot's tags."},
                  [](Yaml yaml, In in, Files&) { in.config.tags = parse_tags(yaml); }});
  keys.push_back(
      {{"odometry", io::odometry_noise_type(), "Standard deviations of an odometry sample.", false},
       [](Yaml yaml, In in, Files&) { in.config.odometry = io::parse_odometry_noise(yaml); }});
  keys.push_back({{"steering", io::steering_type(), "A car-like vehicle, in place of odometry.", false},
                  [](Yaml yaml, In in, Files&) {
                    in.config.odometry =
                        model::noise_of(in.config.steering.emplace(io::parse_steering(yaml)));
                  }});
  keys.push_back({{"range", io::range_priors_type(), "Noise of a range and priors of each pair."},
                  [](Yaml yaml, In in, Files&) { in.config.range = io::parse_range_priors(yaml); }});
  keys.push_back({{"surface", io::surface_type(), "The ground that the robot drives on."},
                  [](Yaml yaml, In in, Files& files) {
                    in.config.surface = io::parse_surface(yaml, in.folder, files);
                  }});
  keys.push_back(
      {{"calibration", calibration_type(), "Where the anchors' calibration comes from."},
       [](Yaml yaml, In in, Files&) { in.config.calibration = parse_calibration_source(yaml, in.folder); }});
}

void append_optional(std::vector<ConfigKey>& keys) {
  keys.push_back({{"robot_socket", YamlType::text(),
                   "Unix socket or tcp://HOST:PORT on which the robot's software listens.", false},
                  [](Yaml yaml, In in, Files&) { in.config.robot_socket = parse_address(yaml, in.folder); }});
  keys.push_back({{"robot", robot_type(),
                   "Where gromad listens for the robot's software, and the robot's CAN bus.", false},
                  [](Yaml yaml, In in, Files& files) { parse_robot(yaml, in.folder, files, in.config); }});
  keys.push_back({{"imu", io::imu_type(), "Noise of the robot's yaw rates.", false},
                  [](Yaml yaml, In in, Files&) { io::parse_imu(yaml, in.config.sensors); }});
  keys.push_back({{"gnss", io::gnss_type(), "The robot's GNSS antenna.", false},
                  [](Yaml yaml, In in, Files&) { io::parse_gnss(yaml, in.config.sensors); }});
  keys.push_back({{"model", model_type(), "Measurement model of the filter.", false},
                  [](Yaml yaml, In in, Files&) { in.config.model = *filter::model_from_name(yaml.text()); }});
  keys.push_back({{"pose_stream", YamlType::map(endpoint_keys()), "Where the poses are served.", false},
                  [](Yaml yaml, In in, Files&) { parse_endpoint(yaml, in.config.pose_stream); }});
  keys.push_back({{"web", web_type(), "Where the live page and the counters are served by HTTP.", false},
                  [](Yaml yaml, In in, Files& files) { in.config.web = parse_web(yaml, in.folder, files); }});
  keys.push_back({{"ros2", ros2_type(), "Topics of ROS 2.", false},
                  [](Yaml yaml, In in, Files&) { in.config.ros2 = parse_ros2(yaml); }});
  keys.push_back({{"log", YamlType::text(), "File to which all input is appended.", false},
                  [](Yaml yaml, In in, Files&) { in.config.log = parse_path(yaml, in.folder); }});
  keys.push_back({{"ring", ring_type(), "The recording of the last drive.", false},
                  [](Yaml yaml, In in, Files&) { in.config.ring = parse_ring(yaml, in.folder); }});
  keys.push_back({{"last_pose", YamlType::text(), "File with the pose that the next run starts from.", false},
                  [](Yaml yaml, In in, Files&) { in.config.last_pose = parse_path(yaml, in.folder); }});
  keys.push_back({{"reorder_lag_s", YamlType::between(0.0, kMaxReorderLag_s),
                   "How long measurements wait for earlier ones, s.", false},
                  [](Yaml yaml, In in, Files&) { in.config.reorder_lag_s = yaml.number(); }});
  keys.push_back({{"speed", YamlType::between(1.0 / kMaxSpeed, kMaxSpeed),
                   "Rate of the site's clocks, as of groma sim.", false},
                  [](Yaml yaml, In in, Files&) { parse_speed(yaml, in.config); }});
}

std::vector<ConfigKey> config_keys() {
  std::vector<ConfigKey> keys;
  append_required(keys);
  append_optional(keys);
  return keys;
}

YamlType type_of(const std::vector<ConfigKey>& keys) {
  std::vector<io::YamlKey> all;
  all.reserve(keys.size());
  for (const ConfigKey& key : keys) all.push_back(key.key);
  return YamlType::map(std::move(all), {{.of = {{"robot_socket"}, {"robot"}, {"ros2"}}, .combines = true},
                                        {.of = {{"odometry"}, {"steering"}}}});
}

// Errors in the order of their places in the file.
class Errors {
 public:
  void add(const io::ConfigError& error) { add(error.place(), error.what(), std::make_exception_ptr(error)); }
  void add(const io::FilePlace& place, std::string text, std::exception_ptr error) {
    const auto after = std::find_if(errors_.begin(), errors_.end(), [&](const ConfigProblem& other) {
      return std::pair(other.place.line, other.place.column) > std::pair(place.line, place.column);
    });
    errors_.insert(after, ConfigProblem{place, std::move(text), std::move(error)});
  }
  // Adds the error of parsing the value, or of a file that it names.
  template <typename Parse>
  void attempt(const YamlValue& yaml, Parse parse) {
    try {
      parse();
    } catch (const io::ConfigError& error) {
      add(error);
    } catch (const io::Error& error) {
      const bool placed = error.place().line > 0;
      const std::string text =
          placed ? error.what() : fmt::format("{}: {}", io::to_string(yaml.place()), error.what());
      add(yaml.place(), text, std::current_exception());
    }
  }
  [[nodiscard]] std::vector<ConfigProblem> take() { return std::move(errors_); }

 private:
  std::vector<ConfigProblem> errors_;
};

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
  filter::set_unknown_delays(out);
  return out;
}

ConfigReading parse_config(const std::filesystem::path& path, const io::InputFiles::Texts& given) {
  ConfigReading out;
  out.config.path = path;
  Errors errors;
  io::InputFiles all(given);
  const std::filesystem::path folder = path.parent_path();
  try {
    const YamlValue yaml = YamlValue::parse(path, all.read(path));
    out.config.files = all.texts();
    const std::vector<ConfigKey> keys = config_keys();
    for (const io::ConfigError& error : type_of(keys).key_errors_of(yaml)) errors.add(error);
    errors.attempt(yaml, [&] { expect_robot(yaml); });
    errors.attempt(yaml, [&] { io::expect_odometry(yaml); });
    for (const ConfigKey& key : keys) {
      const auto value = yaml.find(key.key.name);
      if (!value) continue;
      const std::vector<io::ConfigError> own = key.key.type.errors_of(*value);
      for (const io::ConfigError& error : own) errors.add(error);
      if (!own.empty()) continue;
      io::InputFiles files(given);
      errors.attempt(*value, [&] { key.parse(*value, {folder, out.config}, files); });
      out.config.files.insert(files.texts().begin(), files.texts().end());
      out.config.values[key.key.name] = value->dump() + files.digest();
      out.places[key.key.name] = value->place();
    }
    // Not two sources of odometry, unless both are named.
    const bool has_other = yaml.find("robot_socket") || yaml.find("robot");
    if (out.config.ros2 && !has_other && !yaml.at("ros2").find("odometry_topic"))
      out.config.ros2->odometry_topic = "/odom";
  } catch (const io::ConfigError& error) {
    errors.add(error);
  } catch (const io::Error& error) {
    errors.add({path}, error.what(), std::current_exception());
  }
  out.problems = errors.take();
  return out;
}

Config read_config(const std::filesystem::path& path) {
  if (!std::filesystem::exists(path))
    throw io::ConfigError({path}, "does not exist", "give the configuration file of gromad");
  ConfigReading reading = parse_config(path);
  if (!reading.problems.empty()) std::rethrow_exception(reading.problems.front().error);
  return std::move(reading.config);
}

std::string config_schema() {
  nlohmann::ordered_json schema{{"$schema", "http://json-schema.org/draft-07/schema#"},
                                {"title", "Configuration of gromad"}};
  schema.update(type_of(config_keys()).schema());
  return schema.dump(2);
}

}  // namespace groma::daemon
