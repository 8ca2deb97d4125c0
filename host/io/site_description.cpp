#include "host/io/site_description.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "host/io/csv.hpp"
#include "host/io/error.hpp"
#include "host/model/plausible.hpp"

namespace groma::io {

namespace {

constexpr std::array<std::string_view, 5> kSurfaceTypes{"plane", "bspline", "points", "grid", "floors"};
constexpr std::size_t kFloors = 4;  // in kSurfaceTypes
constexpr int kMaxFloors = 100;
constexpr int kMaxSurfaceCells = 10'000;  // along one axis

constexpr std::string_view kGridHeader = "x0_m,y0_m,dx_m,dy_m,nx,ny";
constexpr std::string_view kOnEarth = "give metres; nothing on the ground is beyond 8e7 m";

void check_coordinate(double value_m, const FilePlace& place) {
  if (!(std::abs(value_m) <= model::kMaxCoordinate_m))
    throw DataError(place, fmt::format("{:.3g} m is not a possible height or position", value_m), kOnEarth);
}

double parse_coordinate(std::string_view field, const FilePlace& place) {
  const double value_m = parse_number(field, place);
  check_coordinate(value_m, place);
  return value_m;
}

// A file with the line x0_m,y0_m,dx_m,dy_m,nx,ny, then nx rows of ny heights.
struct HeightGrid {
  model::BSpline::Grid grid;
  std::vector<double> heights_m;  // NaN: unknown
};

// The fields of a line.
std::vector<std::string_view> fields_of(std::string_view line) {
  std::vector<std::string_view> fields;
  for (bool more = true; more;) {
    const std::size_t comma = line.find(',');
    more = comma != std::string_view::npos;
    fields.push_back(line.substr(0, comma));
    line = more ? line.substr(comma + 1) : line.substr(line.size());
  }
  return fields;
}

// least: lower bound of nx and ny; with_gaps: a height may be empty or nan.
HeightGrid parse_grid(const std::filesystem::path& path, std::string_view text, double least,
                      bool with_gaps) {
  LineReader lines(text);
  // All fields of the line as numbers.
  const auto numbers = [&](std::size_t count, std::string_view meaning, bool gaps, auto parse,
                           std::vector<double>& out) {
    const std::vector<std::string_view> fields = fields_of(lines.line());
    for (std::size_t i = 0; i < std::min(count, fields.size()); ++i) {
      const std::string_view field = fields[i];
      const bool is_gap =
          field.find_first_not_of(" \t\r") == std::string_view::npos || field == "nan" || field == "NaN";
      if (gaps && is_gap) {
        out.push_back(std::numeric_limits<double>::quiet_NaN());
        continue;
      }
      const auto column = static_cast<std::size_t>(field.data() - lines.line().data()) + 1;
      out.push_back(parse(field, FilePlace{path, lines.number(), column}));
    }
    if (fields.size() != count) {
      throw DataError({path, lines.number()}, fmt::format("the row has {} numbers", fields.size()),
                      fmt::format("it has to have {}: {}", count, meaning));
    }
  };

  if (!lines.next())
    throw DataError({path, 1}, "the file is empty", fmt::format("its first line is {}", kGridHeader));
  std::vector<double> header;
  numbers(6, kGridHeader, false, parse_number, header);
  const FilePlace header_place{path, lines.number()};
  if (!(header[2] > 0.0) || !(header[3] > 0.0)) {
    throw DataError(header_place, "dx_m and dy_m have to be above 0", "give the grid's steps in metres");
  }
  const auto count = [&](double value, std::string_view name) {
    if (!(value >= least && value <= kMaxSurfaceCells) || value != std::floor(value)) {
      throw DataError(header_place, fmt::format("{} is {}", name, value),
                      fmt::format("it has to be a whole number from {} to {}", least, kMaxSurfaceCells));
    }
    return static_cast<int>(value);
  };
  HeightGrid out;
  out.grid = {header[0], header[1], header[2], header[3], count(header[4], "nx"), count(header[5], "ny")};
  const model::BSpline::Grid& grid = out.grid;
  const double reach_m =
      std::max(std::abs(grid.x0_m) + grid.dx_m * grid.nx, std::abs(grid.y0_m) + grid.dy_m * grid.ny);
  if (!(reach_m <= model::kMaxCoordinate_m)) {
    throw DataError(header_place, fmt::format("the grid reaches to {:.3g} m", reach_m), kOnEarth);
  }
  int rows = 0;
  while (lines.next()) {
    if (rows == out.grid.nx) {
      throw DataError({path, lines.number()}, fmt::format("there are more than nx = {} rows", out.grid.nx),
                      "remove the other rows, or correct nx");
    }
    numbers(static_cast<std::size_t>(out.grid.ny), "the ny heights of the row", with_gaps, parse_coordinate,
            out.heights_m);
    ++rows;
  }
  if (rows != out.grid.nx) {
    throw DataError({path, lines.number()}, fmt::format("there are {} rows of heights", rows),
                    fmt::format("nx requires {}", out.grid.nx));
  }
  return out;
}

model::BSpline parse_spline(const std::filesystem::path& path, std::string_view text) {
  HeightGrid parsed = parse_grid(path, text, 4.0, false);
  return {parsed.grid, std::move(parsed.heights_m)};
}

// A file that begins with a number is a grid.
bool begins_with_number(std::string_view text) {
  LineReader lines(text);
  if (!lines.next()) return false;
  const std::size_t first = lines.line().find_first_not_of(" \t");
  return std::string_view("+-.0123456789").find(lines.line()[first]) != std::string_view::npos;
}

std::vector<Eigen::Vector3d> points_of(const HeightGrid& grid) {
  std::vector<Eigen::Vector3d> points;
  points.reserve(grid.heights_m.size());
  for (int i = 0; i < grid.grid.nx; ++i) {
    for (int j = 0; j < grid.grid.ny; ++j) {
      const double z_m = grid.heights_m[static_cast<std::size_t>(i) * static_cast<std::size_t>(grid.grid.ny) +
                                        static_cast<std::size_t>(j)];
      if (std::isnan(z_m)) continue;
      points.emplace_back(grid.grid.x0_m + i * grid.grid.dx_m, grid.grid.y0_m + j * grid.grid.dy_m, z_m);
    }
  }
  return points;
}

std::filesystem::path parse_file(const YamlValue& yaml, const std::filesystem::path& folder) {
  const std::string file = yaml.text();
  if (file.empty()) yaml.fail("is empty", "name the file, such as surface.csv");
  return folder / file;
}

model::SurfaceMismatch parse_mismatch(const YamlValue& yaml) {
  model::SurfaceMismatch mismatch;
  mismatch.sigma_m = yaml.at("sigma_m").number();
  if (mismatch.sigma_m < 0.0) yaml.at("sigma_m").fail("is below 0", "give a standard deviation in metres");
  mismatch.length_m = yaml.at("length_m").positive_number();
  mismatch.slope_sigma = model::slope_sigma(mismatch.sigma_m, mismatch.length_m);
  if (const auto slope = yaml.find("slope_sigma")) {
    mismatch.slope_sigma = slope->number();
    if (mismatch.slope_sigma < 0.0) slope->fail("is below 0", "give a standard deviation, without unit");
  }
  return mismatch;
}

YamlType mismatch_type() {
  return YamlType::map(
      {{"sigma_m", YamlType::number(), "Standard deviation of the ground's height, m."},
       {"length_m", YamlType::positive(), "Its correlation length, m."},
       {"slope_sigma", YamlType::number(), "Standard deviation of the ground's slope.", false}});
}

// One of kSurfaceTypes, with its other keys.
YamlType chart_type(std::size_t type, std::vector<YamlKey> keys) {
  keys.insert(keys.begin(),
              {"type", YamlType::word({std::string(kSurfaceTypes.at(type))}), "Its description."});
  if (type != kFloors) {
    keys.push_back({"mismatch", mismatch_type(), "How far the ground may differ from the surface.", false});
  }
  return YamlType::map(std::move(keys));
}

// The types of a single floor, in the order of kSurfaceTypes.
std::vector<YamlType> chart_types() {
  const YamlKey file{"file", YamlType::text(), "A file, relative to the folder of this one."};
  const YamlKey spacing{"spacing_m", YamlType::positive(), "Metres between the knots of the fit.", false};
  const YamlKey smoothing{"smoothing", YamlType::positive(), "Weight of the bending in the fit.", false};
  return {chart_type(0, {{"z_m", YamlType::number(), "Height at x = y = 0, m."},
                         {"normal", YamlType::numbers(3), "Vector that points up from the plane."}}),
          chart_type(1, {file}), chart_type(2, {file, spacing, smoothing}),
          chart_type(3, {file, spacing, smoothing})};
}

model::SurfaceFitOptions parse_fit_options(const YamlValue& yaml) {
  model::SurfaceFitOptions options;
  if (const auto spacing = yaml.find("spacing_m")) options.spacing_m = spacing->positive_number();
  if (const auto smoothing = yaml.find("smoothing")) options.smoothing = smoothing->positive_number();
  return options;
}

std::vector<Eigen::Vector2d> parse_domain(const YamlValue& yaml) {
  std::vector<Eigen::Vector2d> corners;
  for (const YamlValue& corner : yaml.list()) {
    const std::vector<double> xy = corner.numbers(2);
    corners.emplace_back(xy[0], xy[1]);
  }
  if (corners.size() < 3) yaml.fail("has fewer than 3 corners", "list the polygon's corners in order");
  return corners;
}

// Parses one chart; the caller sets its name and domain.
model::Chart parse_chart(const YamlValue& yaml, const std::filesystem::path& folder, InputFiles& files) {
  model::Chart chart;
  const std::size_t type = yaml.at("type").one_of(kSurfaceTypes);
  if (type == 1) {
    const std::filesystem::path path = parse_file(yaml.at("file"), folder);
    chart.shape = parse_spline(path, files.read(path));
  } else if (type == 2 || type == 3) {
    const std::filesystem::path path = parse_file(yaml.at("file"), folder);
    const std::string text = files.read(path);
    if (type == 3 && !begins_with_number(text)) {
      throw DataError({path, 1}, "is not a grid", fmt::format("its first line is {}", kGridHeader));
    }
    const model::SurfaceFit fit = fit_heights(path, text, parse_fit_options(yaml));
    chart.shape = fit.spline;
    chart.mismatch = fit.mismatch;
  } else {
    const std::vector<double> normal = yaml.at("normal").numbers(3);
    if (!(normal[2] > 0.0)) yaml.at("normal").fail("does not point up", "its z component has to be above 0");
    chart.shape = model::Plane(yaml.at("z_m").number(), {normal[0], normal[1], normal[2]});
  }
  if (const auto mismatch = yaml.find("mismatch")) chart.mismatch = parse_mismatch(*mismatch);
  return chart;
}

model::ScalarPrior parse_prior(const YamlValue& yaml) {
  const std::vector<YamlValue> values = yaml.list_of(2);
  return {values[0].number(), values[1].positive_number()};
}

}  // namespace

std::vector<Eigen::Vector3d> parse_heights(const std::filesystem::path& path, std::string_view text) {
  std::vector<Eigen::Vector3d> points;
  if (begins_with_number(text)) {
    points = points_of(parse_grid(path, text, 1.0, true));
  } else {
    CsvReader csv(path, text, {{"x_m"}, {"y_m"}, {"z_m"}});
    const auto coordinate = [&csv](std::size_t column) {
      const double value_m = csv.number(column);
      check_coordinate(value_m, csv.place(column));
      return value_m;
    };
    while (csv.next()) points.emplace_back(coordinate(0), coordinate(1), coordinate(2));
  }
  if (points.size() < model::kMinSurfacePoints) {
    throw DataError({path}, fmt::format("has {} heights", points.size()),
                    fmt::format("a surface needs {} or more", model::kMinSurfacePoints));
  }
  return points;
}

model::SurfaceFit fit_heights(const std::filesystem::path& path, std::string_view text,
                              const model::SurfaceFitOptions& options) {
  std::optional<model::SurfaceFit> fit = model::fit_surface(parse_heights(path, text), options);
  if (!fit) {
    throw DataError({path},
                    fmt::format("needs more than {} control heights at this spacing, or has no solution",
                                model::kMaxControlHeights),
                    "choose a larger spacing_m, and check for points far from all others");
  }
  return *std::move(fit);
}

YamlType surface_type() {
  std::vector<YamlType> types = chart_types();
  const YamlType floor =
      YamlType::map({{"name", YamlType::text(), "The floor's name, in poses."},
                     {"surface", YamlType::variant(types), "Its surface, which has no floors."},
                     {"domain_m", YamlType::list(YamlType::numbers(2)),
                      "Corners of the polygon that it covers, m.", false}});
  types.push_back(chart_type(kFloors, {{"floors", YamlType::list(floor), "All floors and ramps."}}));
  return YamlType::variant(std::move(types));
}

model::Surface parse_surface(const YamlValue& yaml, const std::filesystem::path& folder, InputFiles& files) {
  surface_type().expect(yaml);
  std::vector<model::Chart> charts;
  if (yaml.at("type").one_of(kSurfaceTypes) != kFloors) {
    charts.push_back(parse_chart(yaml, folder, files));
    return model::Surface(std::move(charts));
  }
  for (const YamlValue& floor : yaml.at("floors").list()) {
    model::Chart chart = parse_chart(floor.at("surface"), folder, files);
    chart.name = floor.at("name").text();
    if (chart.name.empty() || chart.name.find_first_of(",\"\r\n") != std::string::npos) {
      floor.at("name").fail("is not a valid name", "name the floor, without commas, quotes and line ends");
    }
    for (const model::Chart& other : charts) {
      if (other.name == chart.name) floor.at("name").fail("occurs twice", "name each floor once");
    }
    if (const auto domain = floor.find("domain_m")) chart.domain_m = parse_domain(*domain);
    charts.push_back(std::move(chart));
  }
  if (charts.empty() || charts.size() > kMaxFloors) {
    yaml.at("floors").fail(fmt::format("has {} floors", charts.size()),
                           fmt::format("list 1 to {} of them, ramps included", kMaxFloors));
  }
  return model::Surface(std::move(charts));
}

YamlType odometry_noise_type() {
  return YamlType::map({{"sigma_vx_mps", YamlType::positive(), "Of the speed along x, m/s."},
                        {"sigma_vy_mps", YamlType::positive(), "Of the speed along y, m/s."},
                        {"sigma_omega_radps", YamlType::positive(), "Of the yaw rate, rad/s."},
                        {"sigma_curve", YamlType::positive(),
                         "Of the relative error of the yaw rate in a curve; not white.", false}});
}

model::OdometryNoise parse_odometry_noise(const YamlValue& yaml) {
  odometry_noise_type().expect(yaml);
  model::OdometryNoise out{yaml.at("sigma_vx_mps").number(), yaml.at("sigma_vy_mps").number(),
                           yaml.at("sigma_omega_radps").number()};
  if (const auto curve = yaml.find("sigma_curve")) out.sigma_curve = curve->number();
  return out;
}

YamlType steering_type() {
  return YamlType::map(
      {{"wheelbase_m", YamlType::positive(), "From the rear axle to the front one, m."},
       {"rear_axle_x_m", YamlType::number(), "Place of the rear axle along base_link's x, m.", false},
       {"sigma_speed_mps", YamlType::positive(), "Of the wheel speed, m/s.", false},
       {"sigma_steering_rad", YamlType::positive(), "Of the steering angle, rad.", false},
       {"sigma_side_mps", YamlType::positive(), "Of the rear axle's sideways slip, m/s.", false},
       {"sigma_curve", YamlType::positive(), "Of the relative error of the yaw rate in a curve; not white.",
        false}});
}

model::Steering parse_steering(const YamlValue& yaml) {
  steering_type().expect(yaml);
  model::Steering out{.wheelbase_m = yaml.at("wheelbase_m").number()};
  const auto take = [&](std::string_view key, double& value) {
    if (const auto given = yaml.find(key)) value = given->number();
  };
  take("rear_axle_x_m", out.rear_axle_x_m);
  take("sigma_speed_mps", out.sigma_speed_mps);
  take("sigma_steering_rad", out.sigma_steering_rad);
  take("sigma_side_mps", out.sigma_side_mps);
  take("sigma_curve", out.sigma_curve);
  return out;
}

void expect_odometry(const YamlValue& yaml) {
  const bool has_both = yaml.find("odometry") && yaml.find("steering");
  if (!has_both && (yaml.find("odometry") || yaml.find("steering"))) return;
  yaml.fail(has_both ? "has both 'odometry' and 'steering'" : "has neither 'odometry' nor 'steering'",
            "give 'steering' for a car-like vehicle that reports its steering angle, else 'odometry'");
}

YamlType imu_type() {
  return YamlType::map(
      {{"sigma_omega_radps", YamlType::positive(), "White noise of the yaw rate, rad/s.", false},
       {"bias_sigma_radps", YamlType::positive(), "Standard deviation of its bias, rad/s.", false}});
}

void parse_imu(const YamlValue& yaml, model::SensorDescription& out) {
  imu_type().expect(yaml);
  if (const auto sigma = yaml.find("sigma_omega_radps")) out.gyro_sigma_radps = sigma->number();
  if (const auto sigma = yaml.find("bias_sigma_radps")) out.gyro_bias_sigma_radps = sigma->number();
}

YamlType gnss_type() {
  return YamlType::map({{"lever_arm_m", YamlType::numbers(3), "Position of its antenna in base_link, m."}});
}

void parse_gnss(const YamlValue& yaml, model::SensorDescription& out) {
  gnss_type().expect(yaml);
  const std::vector<double> lever_arm = yaml.at("lever_arm_m").numbers(3);
  out.gnss_lever_arm_m = Eigen::Vector3d(lever_arm[0], lever_arm[1], lever_arm[2]);
}

model::SensorDescription parse_sensors(const YamlValue& yaml) {
  model::SensorDescription out;
  if (const auto imu = yaml.find("imu")) parse_imu(*imu, out);
  if (const auto gnss = yaml.find("gnss")) parse_gnss(*gnss, out);
  return out;
}

YamlType range_priors_type() {
  std::vector<YamlKey> keys{{"sigma_m", YamlType::positive(), "White noise of a range, m."}};
  for (const model::PairTerm& term : model::kPairTerms) {
    keys.push_back(
        {std::string(term.key.value), YamlType::numbers(2), "Mean and sigma of a pair's term.", false});
  }
  return YamlType::map(std::move(keys));
}

model::RangePriors parse_range_priors(const YamlValue& yaml) {
  range_priors_type().expect(yaml);
  model::RangePriors priors;
  priors.sigma_m = yaml.at("sigma_m").number();
  for (const model::PairTerm& term : model::kPairTerms) {
    if (const auto prior = yaml.find(term.key.value)) priors.*term.prior = parse_prior(*prior);
  }
  return priors;
}

}  // namespace groma::io
