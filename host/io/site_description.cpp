#include "host/io/site_description.hpp"

#include <fmt/format.h>

#include <array>
#include <cmath>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "host/io/csv.hpp"
#include "host/io/error.hpp"

namespace groma::io {

namespace {

constexpr std::array<std::string_view, 2> kSurfaceTypes{"plane", "bspline"};
constexpr int kMaxSurfaceCells = 10'000;  // along one axis

// The grid's line x0_m,y0_m,dx_m,dy_m,nx,ny, then nx rows of ny control heights.
model::BSpline parse_spline(const std::filesystem::path& path, std::string_view text) {
  LineReader lines(text);
  // All fields of the line as numbers.
  const auto numbers = [&](std::size_t count, std::string_view meaning, std::vector<double>& out) {
    std::string_view rest = lines.line();
    std::size_t found = 0;
    for (bool more = true; more; ++found) {
      const auto column = static_cast<std::size_t>(rest.data() - lines.line().data()) + 1;
      const std::size_t comma = rest.find(',');
      more = comma != std::string_view::npos;
      if (found < count) out.push_back(parse_number(rest.substr(0, comma), {path, lines.number(), column}));
      rest = more ? rest.substr(comma + 1) : rest.substr(rest.size());
    }
    if (found != count) {
      throw DataError({path, lines.number()}, fmt::format("the row has {} numbers", found),
                      fmt::format("it has to have {}: {}", count, meaning));
    }
  };

  if (!lines.next())
    throw DataError({path, 1}, "the file is empty", "its first line is x0_m,y0_m,dx_m,dy_m,nx,ny");
  std::vector<double> header;
  numbers(6, "x0_m,y0_m,dx_m,dy_m,nx,ny", header);
  const FilePlace header_place{path, lines.number()};
  if (!(header[2] > 0.0) || !(header[3] > 0.0)) {
    throw DataError(header_place, "dx_m and dy_m have to be above 0", "give the grid's steps in metres");
  }
  const auto count = [&](double value, std::string_view name) {
    if (!(value >= 4.0 && value <= kMaxSurfaceCells) || value != std::floor(value)) {
      throw DataError(header_place, fmt::format("{} is {}", name, value),
                      fmt::format("it has to be a whole number from 4 to {}", kMaxSurfaceCells));
    }
    return static_cast<int>(value);
  };
  const model::BSpline::Grid grid{
      header[0], header[1], header[2], header[3], count(header[4], "nx"), count(header[5], "ny")};

  std::vector<double> heights_m;
  int rows = 0;
  while (lines.next()) {
    if (rows == grid.nx) {
      throw DataError({path, lines.number()}, fmt::format("there are more than nx = {} rows", grid.nx),
                      "take the rest out, or mend nx");
    }
    numbers(static_cast<std::size_t>(grid.ny), "the ny control heights of the row", heights_m);
    ++rows;
  }
  if (rows != grid.nx) {
    throw DataError({path, lines.number()}, fmt::format("there are {} rows of heights", rows),
                    fmt::format("nx asks for {}", grid.nx));
  }
  return {grid, std::move(heights_m)};
}

model::ScalarPrior parse_prior(const YamlValue& yaml) {
  const std::vector<YamlValue> values = yaml.list_of(2);
  return {values[0].number(), values[1].positive_number()};
}

}  // namespace

model::Surface parse_surface(const YamlValue& yaml, const std::filesystem::path& folder, InputFiles& files) {
  if (yaml.find("type").has_value() && yaml.at("type").one_of(kSurfaceTypes) == 1) {
    yaml.expect_keys({{"type", "file"}});
    const std::string file = yaml.at("file").text();
    if (file.empty()) yaml.at("file").fail("is empty", "name the file, such as surface.csv");
    const std::filesystem::path path = folder / file;
    return parse_spline(path, files.read(path));
  }
  yaml.expect_keys({{"type", "z_m", "normal"}});
  const std::vector<double> normal = yaml.at("normal").numbers(3);
  if (!(normal[2] > 0.0)) yaml.at("normal").fail("does not point up", "its z component has to be above 0");
  return model::Plane(yaml.at("z_m").number(), {normal[0], normal[1], normal[2]});
}

model::OdometryNoise parse_odometry_noise(const YamlValue& yaml) {
  yaml.expect_keys({{"sigma_vx_mps", "sigma_vy_mps", "sigma_omega_radps"}});
  return {yaml.at("sigma_vx_mps").positive_number(), yaml.at("sigma_vy_mps").positive_number(),
          yaml.at("sigma_omega_radps").positive_number()};
}

model::SensorDescription parse_sensors(const YamlValue& yaml) {
  model::SensorDescription out;
  if (const auto imu = yaml.find("imu")) {
    imu->expect_keys({{}, {"sigma_omega_radps", "bias_sigma_radps"}});
    if (const auto sigma = imu->find("sigma_omega_radps")) out.gyro_sigma_radps = sigma->positive_number();
    if (const auto sigma = imu->find("bias_sigma_radps"))
      out.gyro_bias_sigma_radps = sigma->positive_number();
  }
  if (const auto gnss = yaml.find("gnss")) {
    gnss->expect_keys({{"lever_arm_m"}});
    const std::vector<double> lever_arm = gnss->at("lever_arm_m").numbers(3);
    out.gnss_lever_arm_m = Eigen::Vector3d(lever_arm[0], lever_arm[1], lever_arm[2]);
  }
  return out;
}

model::RangePriors parse_range_priors(const YamlValue& yaml) {
  yaml.expect_keys({{"sigma_m"}, {"beta_m", "gamma"}});
  model::RangePriors priors;
  priors.sigma_m = yaml.at("sigma_m").positive_number();
  if (const auto beta_m = yaml.find("beta_m")) priors.beta_m = parse_prior(*beta_m);
  if (const auto gamma = yaml.find("gamma")) priors.gamma = parse_prior(*gamma);
  return priors;
}

}  // namespace groma::io
