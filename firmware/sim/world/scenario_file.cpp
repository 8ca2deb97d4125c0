#include "firmware/sim/world/scenario_file.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>
#include <set>
#include <string_view>
#include <utility>

#include "firmware/sim/world/uneven_ground.hpp"
#include "host/io/input_file.hpp"
#include "host/io/yaml_reader.hpp"
#include "host/model/steering.hpp"

namespace groma::sim {

namespace {

using io::YamlValue;

constexpr std::int64_t kMaxId = std::numeric_limits<model::NodeId>::max();
constexpr std::size_t kMaxNodesOfARole = 16;  // the capacity of a schedule
constexpr double kShortestLeg_m = 0.1;

double number(const YamlValue& map, std::string_view key, double otherwise) {
  const std::optional<YamlValue> value = map.find(key);
  return value ? value->number() : otherwise;
}

double positive(const YamlValue& map, std::string_view key, double otherwise) {
  const std::optional<YamlValue> value = map.find(key);
  return value ? value->positive_number() : otherwise;
}

double not_negative(const YamlValue& map, std::string_view key, double otherwise) {
  const std::optional<YamlValue> value = map.find(key);
  if (!value) return otherwise;
  const double read = value->number();
  if (read < 0.0) value->fail(fmt::format("is {}", read), "it must be 0 or more");
  return read;
}

unsigned whole(const YamlValue& map, std::string_view key, std::int64_t min, std::int64_t max,
               unsigned otherwise) {
  const std::optional<YamlValue> value = map.find(key);
  return value ? static_cast<unsigned>(value->integer(min, max)) : otherwise;
}

Eigen::Vector2d point2(const YamlValue& value) {
  const std::vector<double> p = value.numbers(2);
  return {p[0], p[1]};
}

Eigen::Vector3d point3(const YamlValue& value) {
  const std::vector<double> p = value.numbers(3);
  return {p[0], p[1], p[2]};
}

// [mean, sigma]
model::ScalarPrior prior(const YamlValue& value) {
  const std::vector<double> p = value.numbers(2);
  if (p[1] < 0.0) value.fail(fmt::format("has the sigma {}", p[1]), "it must be 0 or more");
  return {p[0], p[1]};
}

model::BSpline::Grid grid(const YamlValue& map, int nx, int ny) {
  model::BSpline::Grid out;
  const Eigen::Vector2d origin = point2(map.at("origin_m"));
  const Eigen::Vector2d step = point2(map.at("step_m"));
  if (!(step.minCoeff() > 0.0))
    map.at("step_m").fail("is not above 0", "write the distance between control heights");
  out.x0_m = origin.x();
  out.y0_m = origin.y();
  out.dx_m = step.x();
  out.dy_m = step.y();
  out.nx = nx;
  out.ny = ny;
  return out;
}

model::Surface parse_ground(const YamlValue& map) {
  map.expect_keys({{"type"}, {"z_m", "normal", "origin_m", "step_m", "heights_m", "size", "seed", "areas"}});
  switch (map.at("type").one_of(std::array<std::string_view, 3>{"plane", "bspline", "uneven"})) {
    case 0: {
      map.expect_keys({{"type"}, {"z_m", "normal"}});
      const std::optional<YamlValue> normal = map.find("normal");
      const Eigen::Vector3d n = normal ? point3(*normal) : Eigen::Vector3d::UnitZ();
      if (normal && !(n.z() > 0.0)) normal->fail("does not point up", "give it a third component above 0");
      return model::Plane(number(map, "z_m", 0.0), n);
    }
    case 1: {
      map.expect_keys({{"type", "origin_m", "step_m", "heights_m"}});
      const std::vector<YamlValue> rows = map.at("heights_m").list();
      if (rows.size() < 4)
        map.at("heights_m").fail(fmt::format("has {} rows", rows.size()), "give it 4 or more");
      const std::size_t ny = rows.front().list().size();
      if (ny < 4) rows.front().fail(fmt::format("has {} heights", ny), "give it 4 or more");
      std::vector<double> heights;
      for (const YamlValue& row : rows) {
        for (const double height : row.numbers(ny)) heights.push_back(height);
      }
      return model::BSpline(grid(map, static_cast<int>(rows.size()), static_cast<int>(ny)),
                            std::move(heights));
    }
    default:
      break;
  }
  map.expect_keys({{"type", "origin_m", "step_m", "size", "areas"}, {"seed"}});
  const std::vector<YamlValue> size = map.at("size").list_of(2);
  std::vector<UnevenArea> areas;
  for (const YamlValue& entry : map.at("areas").list()) {
    entry.expect_keys({{"from_m", "to_m"}, {"edge_m", "slope", "height_m", "wave_m"}});
    UnevenArea area;
    area.from_m = point2(entry.at("from_m"));
    area.to_m = point2(entry.at("to_m"));
    if (!((area.to_m - area.from_m).minCoeff() > 0.0)) {
      entry.at("to_m").fail("is not beyond from_m", "name the lower left corner, then the upper right one");
    }
    area.edge_m = positive(entry, "edge_m", area.edge_m);
    if (const auto slope = entry.find("slope")) area.slope = point2(*slope);
    area.height_m = not_negative(entry, "height_m", area.height_m);
    area.wave_m = positive(entry, "wave_m", area.wave_m);
    areas.push_back(area);
  }
  const auto seed = map.find("seed");
  return uneven_ground(
      grid(map, static_cast<int>(size[0].integer(4, 10'000)), static_cast<int>(size[1].integer(4, 10'000))),
      areas,
      seed ? static_cast<std::uint64_t>(seed->integer(0, std::numeric_limits<std::int64_t>::max())) : 0);
}

std::vector<Material> parse_materials(const YamlValue& list) {
  std::vector<Material> materials;
  for (const YamlValue& entry : list.list()) {
    entry.expect_keys({{"name", "loss_db"}, {"excess_m", "reflection_loss_db"}});
    Material material;
    material.name = entry.at("name").text();
    material.loss_db = not_negative(entry, "loss_db", 0.0);
    material.excess_m = not_negative(entry, "excess_m", 0.0);
    if (entry.find("reflection_loss_db"))
      material.reflection_loss_db = not_negative(entry, "reflection_loss_db", 0.0);
    for (const Material& other : materials) {
      if (other.name == material.name) entry.at("name").fail("occurs twice", "remove one of the materials");
    }
    materials.push_back(std::move(material));
  }
  return materials;
}

std::vector<Wall> parse_walls(const YamlValue& list, const std::vector<Material>& materials) {
  std::vector<Wall> walls;
  for (const YamlValue& entry : list.list()) {
    entry.expect_keys({{"material", "along_m", "top_m"}, {"bottom_m"}});
    const YamlValue material = entry.at("material");
    const std::string name = material.text();
    const auto found =
        std::find_if(materials.begin(), materials.end(), [&](const Material& m) { return m.name == name; });
    if (found == materials.end())
      material.fail(fmt::format("is {}", io::shown(name)), "name one of the materials");
    Wall wall;
    wall.material = static_cast<std::size_t>(found - materials.begin());
    wall.bottom_m = number(entry, "bottom_m", -1.0);
    wall.top_m = entry.at("top_m").number();
    if (wall.top_m <= wall.bottom_m)
      entry.at("top_m").fail("is not above bottom_m", "write the height of its upper edge");
    const std::vector<YamlValue> corners = entry.at("along_m").list();
    if (corners.size() < 2)
      entry.at("along_m").fail("has fewer than two points", "write [[x, y], [x, y], ...]");
    for (std::size_t i = 1; i < corners.size(); ++i) {
      wall.from_m = point2(corners[i - 1]);
      wall.to_m = point2(corners[i]);
      if ((wall.to_m - wall.from_m).norm() < 1e-3) corners[i].fail("equals the point before it", "remove it");
      walls.push_back(wall);
    }
  }
  return walls;
}

RadioClimate parse_climate(const YamlValue& map) {
  map.expect_keys({{}, {"power_at_1m_dbm", "path_exponent", "sensitivity_dbm", "floor_reflection_loss_db"}});
  RadioClimate climate;
  climate.power_at_1m_dbm = number(map, "power_at_1m_dbm", climate.power_at_1m_dbm);
  climate.path_exponent = positive(map, "path_exponent", climate.path_exponent);
  climate.sensitivity_dbm = number(map, "sensitivity_dbm", climate.sensitivity_dbm);
  if (const auto loss = map.find("floor_reflection_loss_db")) {
    climate.floor_reflection_loss_db.reset();
    if (!loss->is_null()) climate.floor_reflection_loss_db = loss->number();
  }
  return climate;
}

// Nodes of one role, sorted by id. `ids`: the ids in use; parse_nodes adds to it.
template <typename Node>
std::vector<Node> parse_nodes(const YamlValue& list, std::string_view place_key,
                              std::set<model::NodeId>& ids) {
  const std::vector<YamlValue> entries = list.list();
  if (entries.empty()) list.fail("is empty", "name at least one");
  if (entries.size() > kMaxNodesOfARole)
    list.fail(fmt::format("has {} entries", entries.size()),
              fmt::format("a schedule holds {}", kMaxNodesOfARole));
  std::vector<Node> nodes;
  for (const YamlValue& entry : entries) {
    entry.expect_keys({{"id", place_key}});
    const auto id = static_cast<model::NodeId>(entry.at("id").integer(1, kMaxId - 1));
    if (!ids.insert(id).second)
      entry.at("id").fail(fmt::format("{} is taken", id), "give each tag and anchor its own id");
    nodes.push_back({id, point3(entry.at(place_key))});
  }
  std::sort(nodes.begin(), nodes.end(), [](const Node& a, const Node& b) { return a.id < b.id; });
  return nodes;
}

BiasOptions parse_biases(const YamlValue& map) {
  map.expect_keys({{}, {"beta_m", "beta_bounds_m", "gamma"}});
  BiasOptions biases;
  if (const auto beta = map.find("beta_m")) biases.beta_m = prior(*beta);
  if (const auto gamma = map.find("gamma")) biases.gamma = prior(*gamma);
  if (const auto bounds = map.find("beta_bounds_m")) {
    const std::vector<double> b = bounds->numbers(2);
    biases.beta_min_m = b[0];
    biases.beta_max_m = b[1];
  }
  if (!(biases.beta_m.mean >= biases.beta_min_m && biases.beta_m.mean <= biases.beta_max_m)) {
    map.fail("has the mean of beta_m outside of beta_bounds_m", "set the bounds on both sides of it");
  }
  return biases;
}

struct RobotOptions {
  PathOptions path;
  double wheelbase_m = 1.6;
  double max_steering_rad = 0.7;

  [[nodiscard]] bool is_car() const noexcept { return path.drive == Drive::kCar; }
};

RobotOptions parse_robot(const YamlValue& map) {
  map.expect_keys({{},
                   {"drive", "max_speed_mps", "max_acceleration_mps2", "max_yaw_rate_radps",
                    "corner_radius_m", "loop", "wheelbase_m", "max_steering_rad"}});
  RobotOptions robot;
  PathOptions& options = robot.path;
  if (const auto drive = map.find("drive")) {
    constexpr std::array<Drive, 3> kDrives{Drive::kDifferential, Drive::kOmnidirectional, Drive::kCar};
    options.drive =
        kDrives.at(drive->one_of(std::array<std::string_view, 3>{"differential", "omnidirectional", "car"}));
  }
  for (const char* key : {"wheelbase_m", "max_steering_rad"}) {
    const auto value = map.find(key);
    if (value && !robot.is_car()) value->fail("is for a car", "set robot.drive to car, or remove it");
  }
  robot.wheelbase_m = positive(map, "wheelbase_m", robot.wheelbase_m);
  robot.max_steering_rad = positive(map, "max_steering_rad", robot.max_steering_rad);
  if (!(robot.max_steering_rad <= model::kMostSteering_rad)) {
    map.at("max_steering_rad")
        .fail("is no steering angle", "write the largest angle of the front wheel, rad");
  }
  options.max_speed_mps = positive(map, "max_speed_mps", options.max_speed_mps);
  options.max_acceleration_mps2 = positive(map, "max_acceleration_mps2", options.max_acceleration_mps2);
  options.max_yaw_rate_radps = positive(map, "max_yaw_rate_radps", options.max_yaw_rate_radps);
  options.corner_radius_m = positive(map, "corner_radius_m", options.corner_radius_m);
  if (const auto loop = map.find("loop"))
    options.loop = loop->one_of(std::array<std::string_view, 2>{"false", "true"}) == 1;
  return robot;
}

void expect_corners_of_a_car(const YamlValue& drives, const Scenario& scenario, const RobotOptions& robot) {
  const double least_m = robot.wheelbase_m / std::tan(robot.max_steering_rad);
  const Path path(joined(scenario.drives), scenario.path);
  if (scenario.path.loop && path.gear_changes() % 2 != 0) {
    drives.fail(
        fmt::format("reverse {} times in a loop, which would end in the other gear", path.gear_changes()),
        "let the path double back once more, or remove robot.loop");
  }
  const double radius_m = path.least_radius_m();
  if (radius_m >= least_m) return;
  drives.fail(
      fmt::format("have a corner with a radius of {:.2f} m, but the car needs {:.2f} m", radius_m, least_m),
      "set a larger robot.corner_radius_m with longer legs, or let the path double back there");
}

std::vector<DriveLeg> parse_drives(const YamlValue& list, const PathOptions& robot) {
  std::vector<DriveLeg> drives;
  std::optional<Eigen::Vector2d> last;
  for (const YamlValue& entry : list.list()) {
    entry.expect_keys({{"name", "waypoints"}});
    DriveLeg drive;
    drive.name = entry.at("name").text();
    for (const YamlValue& point : entry.at("waypoints").list()) {
      point.expect_keys({{"at_m"}, {"yaw_rad", "stop_s"}});
      Waypoint waypoint;
      const Eigen::Vector2d at = point2(point.at("at_m"));
      if (last && (at - *last).norm() < kShortestLeg_m)
        point.at("at_m").fail("equals the waypoint before it", "remove it, or set stop_s there");
      last = at;
      waypoint.x_m = at.x();
      waypoint.y_m = at.y();
      if (const auto yaw = point.find("yaw_rad")) {
        if (robot.drive != Drive::kOmnidirectional)
          yaw->fail("is given, but the robot follows its path",
                    "set robot.drive to omnidirectional, or remove it");
        waypoint.yaw_rad = yaw->number();
      }
      waypoint.stop_s = not_negative(point, "stop_s", 0.0);
      drive.waypoints.push_back(waypoint);
    }
    if (drive.waypoints.size() < 2) entry.at("waypoints").fail("has fewer than two entries", "add one");
    drives.push_back(std::move(drive));
  }
  if (drives.empty()) list.fail("is empty", "name at least one");
  if (robot.loop) {
    const Waypoint& first = drives.front().waypoints.front();
    if (std::hypot(first.x_m - last->x(), first.y_m - last->y()) < kShortestLeg_m)
      list.fail("ends where it begins", "remove the last waypoint: a loop closes itself");
  }
  return drives;
}

std::vector<WheelSlip> parse_slips(const YamlValue& list) {
  std::vector<WheelSlip> slips;
  for (const YamlValue& entry : list.list()) {
    entry.expect_keys({{"at_s", "duration_s", "scale"}});
    const double from_s = entry.at("at_s").number();
    slips.push_back({from_s, from_s + positive(entry, "duration_s", 0.0), entry.at("scale").number()});
  }
  return slips;
}

std::vector<SlipperyArea> parse_areas(const YamlValue& list) {
  std::vector<SlipperyArea> areas;
  for (const YamlValue& entry : list.list()) {
    entry.expect_keys({{"from_m", "to_m", "noise_factor"}});
    areas.push_back(
        {point2(entry.at("from_m")), point2(entry.at("to_m")), positive(entry, "noise_factor", 1.0)});
  }
  return areas;
}

// The odometry of a car.
OdometryOptions parse_car_odometry(const YamlValue& map, double wheelbase_m) {
  map.expect_keys(
      {{},
       {"rate_hz", "scale_sigma", "slips", "areas", "sigma_speed_mps", "sigma_steering_rad", "sigma_side_mps",
        "sigma_curve", "wheelbase_scale_sigma", "steering_offset_sigma_rad", "understeer_s2pm2"}});
  model::Steering vehicle{.wheelbase_m = wheelbase_m};
  const auto take = [&](std::string_view key, double& value) { value = not_negative(map, key, value); };
  take("sigma_speed_mps", vehicle.sigma_speed_mps);
  take("sigma_steering_rad", vehicle.sigma_steering_rad);
  take("sigma_side_mps", vehicle.sigma_side_mps);
  take("sigma_curve", vehicle.sigma_curve);
  OdometryOptions options = odometry_of(vehicle);
  take("wheelbase_scale_sigma", options.car->wheelbase_scale_sigma);
  take("steering_offset_sigma_rad", options.car->steering_offset_sigma_rad);
  take("understeer_s2pm2", options.car->understeer_s2pm2);
  take("scale_sigma", options.scale_sigma);
  options.rate_hz = positive(map, "rate_hz", options.rate_hz);
  if (const auto slips = map.find("slips")) options.slips = parse_slips(*slips);
  if (const auto areas = map.find("areas")) options.areas = parse_areas(*areas);
  return options;
}

OdometryOptions parse_odometry(const YamlValue& map) {
  map.expect_keys({{},
                   {"rate_hz", "sigma_vx_mps", "sigma_vy_mps", "sigma_omega_radps", "scale_sigma",
                    "yaw_rate_bias_sigma_radps", "slips", "areas"}});
  OdometryOptions options;
  if (const auto slips = map.find("slips")) options.slips = parse_slips(*slips);
  if (const auto areas = map.find("areas")) options.areas = parse_areas(*areas);
  options.rate_hz = positive(map, "rate_hz", options.rate_hz);
  options.noise.sigma_vx_mps = not_negative(map, "sigma_vx_mps", options.noise.sigma_vx_mps);
  options.noise.sigma_vy_mps = not_negative(map, "sigma_vy_mps", options.noise.sigma_vy_mps);
  options.noise.sigma_omega_radps = not_negative(map, "sigma_omega_radps", options.noise.sigma_omega_radps);
  options.scale_sigma = not_negative(map, "scale_sigma", options.scale_sigma);
  options.yaw_rate_bias_sigma_radps =
      not_negative(map, "yaw_rate_bias_sigma_radps", options.yaw_rate_bias_sigma_radps);
  return options;
}

PosePriorOptions parse_pose_prior(const YamlValue& map) {
  map.expect_keys({{},
                   {"rate_hz", "correlated_sigma_m", "correlated_sigma_rad", "correlation_s", "white_sigma_m",
                    "white_sigma_rad"}});
  PosePriorOptions options;
  options.rate_hz = positive(map, "rate_hz", options.rate_hz);
  options.correlated_sigma_m = not_negative(map, "correlated_sigma_m", options.correlated_sigma_m);
  options.correlated_sigma_rad = not_negative(map, "correlated_sigma_rad", options.correlated_sigma_rad);
  options.correlation_s = positive(map, "correlation_s", options.correlation_s);
  options.white_sigma_m = not_negative(map, "white_sigma_m", options.white_sigma_m);
  options.white_sigma_rad = not_negative(map, "white_sigma_rad", options.white_sigma_rad);
  return options;
}

RadioOptions parse_radio(const YamlValue& map) {
  map.expect_keys({{}, {"clock_ppm", "stamp_sigma_ns", "loss", "delayed_transmit_gain_ppm"}});
  RadioOptions options;
  options.clock_ppm = not_negative(map, "clock_ppm", options.clock_ppm);
  options.timestamp_sigma_ns = not_negative(map, "stamp_sigma_ns", options.timestamp_sigma_ns);
  options.loss = not_negative(map, "loss", options.loss);
  options.delayed_transmit_gain_ppm =
      not_negative(map, "delayed_transmit_gain_ppm", options.delayed_transmit_gain_ppm);
  if (options.loss >= 1.0) map.at("loss").fail("leaves no frame", "write the share that is lost, below 1");
  return options;
}

ScheduleOptions parse_schedule(const YamlValue& map, const std::vector<model::Anchor>& anchors) {
  map.expect_keys({{},
                   {"master_id", "backup_ids", "method", "preamble", "turn_round_us", "response_gap_us",
                    "guard_us", "arm_ahead"}});
  ScheduleOptions options;
  options.master_id = anchors.front().id;
  const auto anchor_in = [&](const YamlValue& value) {
    const std::int64_t id = value.integer(1, kMaxId - 1);
    if (std::none_of(anchors.begin(), anchors.end(), [&](const model::Anchor& a) { return a.id == id; })) {
      value.fail(fmt::format("is {}", id), "name one of the anchors");
    }
    return static_cast<model::NodeId>(id);
  };
  if (const auto master = map.find("master_id")) options.master_id = anchor_in(*master);
  if (const auto backups = map.find("backup_ids")) {
    options.backup_ids.emplace();
    for (const YamlValue& entry : backups->list()) {
      const model::NodeId id = anchor_in(entry);
      const auto& named = *options.backup_ids;
      if (id == options.master_id || std::find(named.begin(), named.end(), id) != named.end()) {
        entry.fail(fmt::format("{} has its rank already", id), "name each anchor once, and not the master");
      }
      options.backup_ids->push_back(id);
    }
  }
  if (const auto method = map.find("method")) {
    options.method = method->one_of(std::array<std::string_view, 2>{"final", "next-poll"}) == 0
                         ? ScheduleOptions::Method::kFinal
                         : ScheduleOptions::Method::kNextPoll;
  }
  if (const auto preamble = map.find("preamble")) {
    options.preamble =
        std::array{64U, 128U, 256U}[preamble->one_of(std::array<std::string_view, 3>{"64", "128", "256"})];
  }
  options.turn_round_us = whole(map, "turn_round_us", 90, 5'000, options.turn_round_us);
  options.response_gap_us = whole(map, "response_gap_us", 35, 2'000, options.response_gap_us);
  options.guard_us = whole(map, "guard_us", 2, 1'000, options.guard_us);
  if (const auto ahead = map.find("arm_ahead"))
    options.arm_ahead = ahead->one_of(std::array<std::string_view, 2>{"false", "true"}) == 1;
  return options;
}

}  // namespace

Scenario parse_scenario(const std::filesystem::path& path, const std::string& text) {
  const YamlValue root = YamlValue::parse(path, text);
  root.expect_keys({{"schema", "name", "anchors", "tags", "drives"},
                    {"ground", "materials", "walls", "climate", "biases", "robot", "odometry", "pose_prior",
                     "radio", "schedule", "link", "range_sigma_m"}});
  (void)root.at("schema").integer(1, 1);
  Scenario scenario;
  scenario.name = root.at("name").text();
  if (const auto ground = root.find("ground")) scenario.ground = parse_ground(*ground);
  if (const auto materials = root.find("materials")) scenario.materials = parse_materials(*materials);
  if (const auto walls = root.find("walls")) scenario.walls = parse_walls(*walls, scenario.materials);
  if (const auto climate = root.find("climate")) scenario.climate = parse_climate(*climate);
  std::set<model::NodeId> ids;
  scenario.anchors = parse_nodes<model::Anchor>(root.at("anchors"), "position_m", ids);
  scenario.tags = parse_nodes<model::Tag>(root.at("tags"), "lever_arm_m", ids);
  if (const auto biases = root.find("biases")) scenario.biases = parse_biases(*biases);
  RobotOptions robot;
  if (const auto given = root.find("robot")) robot = parse_robot(*given);
  scenario.path = robot.path;
  scenario.drives = parse_drives(root.at("drives"), scenario.path);
  if (robot.is_car()) expect_corners_of_a_car(root.at("drives"), scenario, robot);
  if (const auto odometry = root.find("odometry")) {
    scenario.odometry =
        robot.is_car() ? parse_car_odometry(*odometry, robot.wheelbase_m) : parse_odometry(*odometry);
  } else if (robot.is_car()) {
    scenario.odometry = odometry_of({.wheelbase_m = robot.wheelbase_m});
  }
  if (const auto pose_prior = root.find("pose_prior")) scenario.pose_prior = parse_pose_prior(*pose_prior);
  if (const auto radio = root.find("radio")) scenario.radio = parse_radio(*radio);
  scenario.schedule.master_id = scenario.anchors.front().id;
  if (const auto schedule = root.find("schedule")) {
    scenario.schedule = parse_schedule(*schedule, scenario.anchors);
  }
  if (const auto link = root.find("link")) {
    link->expect_keys({{}, {"bit_per_s"}});
    scenario.link.bit_per_s = whole(*link, "bit_per_s", 9'600, 8'000'000, scenario.link.bit_per_s);
  }
  scenario.range_sigma_m = positive(root, "range_sigma_m", scenario.range_sigma_m);
  return scenario;
}

Scenario read_scenario(const std::filesystem::path& path) {
  return parse_scenario(path, io::read_configuration(path));
}

}  // namespace groma::sim
