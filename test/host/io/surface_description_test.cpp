// The surface in dataset.yaml and gromad's configuration: fitted heights, floors, mismatch.
#include <gtest/gtest.h>

#include <string>

#include "host/io/dataset_writer.hpp"
#include "host/io/error.hpp"
#include "host/io/site_description.hpp"

namespace groma::io {
namespace {

// The surface of a description, with heights.csv beside it.
model::Surface read(const std::string& surface, const std::string& heights = "") {
  InputFiles files;
  files.provide("site/heights.csv", heights);
  return parse_surface(YamlValue::parse("site/dataset.yaml", "surface: " + surface + "\n").at("surface"),
                       "site", files);
}

template <class Expected>
std::string complaint(const std::string& surface, const std::string& heights = "") {
  try {
    read(surface, heights);
  } catch (const Expected& error) {
    return error.what();
  }
  return "none";
}

std::string tilted_points() {
  std::string text = "id,z_m,x_m,y_m\n";
  for (int i = 0; i < 10; ++i) {
    for (int j = 0; j < 10; ++j)
      text += "p," + std::to_string(1.0 + 0.1 * i) + "," + std::to_string(i) + "," + std::to_string(j) + "\n";
  }
  return text;
}

TEST(SurfaceDescription, HeightsOfAListAreFitted) {
  const model::Surface surface = read("{type: points, file: heights.csv, spacing_m: 3}", tilted_points());
  EXPECT_NEAR(surface.at(4.5, 4.5).z_m, 1.45, 0.01);
  EXPECT_NEAR(surface.at(4.5, 4.5).gradient.x(), 0.1, 0.01);
}

TEST(SurfaceDescription, HeightsOfAGridWithGapsAreFitted) {
  std::string grid = "0,0,1,1,8,6\n";
  for (int i = 0; i < 8; ++i)
    grid += i == 4
                ? "0.4,,nan,0.4,0.4,0.4\n"
                : "0." + std::to_string(i) + ",0." + std::to_string(i) + ",0." + std::to_string(i) + ",0." +
                      std::to_string(i) + ",0." + std::to_string(i) + ",0." + std::to_string(i) + "\n";
  const model::Surface surface = read("{type: grid, file: heights.csv, spacing_m: 2, smoothing: 0.01}", grid);
  EXPECT_NEAR(surface.at(4.0, 1.5).z_m, 0.4, 0.01);
}

TEST(SurfaceDescription, ErrorsInHeightsNameTheLine) {
  const std::string kPoints = "{type: points, file: heights.csv}";
  EXPECT_NE(complaint<DataError>(kPoints, "x_m,y_m,z_m\n0,0,0\n1,tall,0\n").find("heights.csv:3:3"),
            std::string::npos);
  EXPECT_NE(complaint<DataError>(kPoints, "x_m,y_m\n0,0\n").find("z_m"), std::string::npos);
  EXPECT_NE(complaint<DataError>(kPoints, "x_m,y_m,z_m\n0,0,0\n").find("has 1 heights"), std::string::npos);
  EXPECT_NE(
      complaint<DataError>("{type: grid, file: heights.csv}", "0,0,1,1,2,2\n0,0\n0\n").find("heights.csv:3"),
      std::string::npos);
  EXPECT_NE(complaint<DataError>("{type: grid, file: heights.csv}", "x_m,y_m,z_m\n").find("is not a grid"),
            std::string::npos);
  EXPECT_NE(complaint<ConfigError>("{type: points, file: heights.csv, spacing_m: 0}", tilted_points())
                .find("dataset.yaml:1"),
            std::string::npos);
  EXPECT_NE(complaint<DataError>("{type: points, file: heights.csv, spacing_m: 1e-4}", tilted_points())
                .find("larger spacing_m"),
            std::string::npos);
}

TEST(SurfaceDescription, RejectsHeightsAndGridsLargerThanTheEarth) {
  const std::string kGrid = "{type: grid, file: heights.csv}";
  const std::string kRows = "0,0,0,0\n0,0,0,0\n0,0,0,0\n0,0,0,0\n";
  for (const std::string header :
       {"0,0,1e308,1,4,4\n", "0,0,1,1e9,4,4\n", "-1e308,0,1,1,4,4\n", "0,1e300,1,1,4,4\n"}) {
    EXPECT_NE(complaint<DataError>(kGrid, header + kRows).find("heights.csv:1: the grid reaches to"),
              std::string::npos)
        << header;
    EXPECT_NE(
        complaint<DataError>("{type: bspline, file: heights.csv}", header + kRows).find("heights.csv:1: "),
        std::string::npos)
        << header;
  }
  EXPECT_NE(complaint<DataError>(kGrid, "0,0,1,1,4,4\n0,0,1e308,0\n").find("heights.csv:2:5: 1e+308 m"),
            std::string::npos);
  EXPECT_NE(
      complaint<DataError>("{type: points, file: heights.csv}", "x_m,y_m,z_m\n0,0,0\n1,-1e308,0\n1,1,0\n")
          .find("heights.csv:3:3: -1e+308 m"),
      std::string::npos);
}

TEST(SurfaceDescription, AMismatchWithoutSlopeDerivesItFromItsLength) {
  const model::Surface surface =
      read("{type: plane, z_m: 0, normal: [0, 0, 1], mismatch: {sigma_m: 0.03, length_m: 4}}");
  EXPECT_EQ(surface.mismatch(0).sigma_m, 0.03);
  EXPECT_EQ(surface.mismatch(0).slope_sigma, model::slope_sigma(0.03, 4.0));
  EXPECT_NE(
      complaint<ConfigError>("{type: plane, z_m: 0, normal: [0, 0, 1], mismatch: {sigma_m: -1, length_m: 4}}")
          .find("sigma_m"),
      std::string::npos);
}

TEST(SurfaceDescription, FloorsAreWrittenAndReadBackEqual) {
  const std::string floors =
      "{type: floors, floors: [{name: hall, surface: {type: plane, z_m: 0, normal: [0, 0, 1], mismatch: "
      "{sigma_m: "
      "0.01, length_m: 2}}, domain_m: [[0, 0], [9, 0], [9, 5], [0, 5]]}, {name: roof, surface: {type: "
      "points, file: "
      "heights.csv, spacing_m: 3}}]}";
  Dataset written;
  written.name = "floors";
  written.origin = "simulated";
  written.surface = read(floors, tilted_points());
  InputFiles files;
  std::string description;
  for (DescriptionFile& file : describe(written)) {
    if (file.name == "dataset.yaml") description = file.text;
    files.provide("log/" + file.name, std::move(file.text));
  }
  const model::Surface again =
      parse_surface(YamlValue::parse("log/dataset.yaml", description).at("surface"), "log", files);
  ASSERT_EQ(again.chart_count(), 2);
  EXPECT_EQ(again.charts()[0].name, "hall");
  EXPECT_EQ(again.charts()[0].domain_m, written.surface.charts()[0].domain_m);
  EXPECT_EQ(again.mismatch(0).slope_sigma, written.surface.mismatch(0).slope_sigma);
  EXPECT_EQ(again.mismatch(1).sigma_m, written.surface.mismatch(1).sigma_m);
  for (const double x_m : {0.5, 3.7, 8.9})
    EXPECT_EQ(again.at(x_m, 4.0, 1).z_m, written.surface.at(x_m, 4.0, 1).z_m);
  EXPECT_NE(complaint<ConfigError>("{type: floors, floors: []}").find("has 0 floors"), std::string::npos);
  EXPECT_NE(complaint<ConfigError>(
                "{type: floors, floors: [{name: 'a,b', surface: {type: plane, z_m: 0, normal: [0, 0, "
                "1]}}]}")
                .find("is not a valid name"),
            std::string::npos);
}

}  // namespace
}  // namespace groma::io
