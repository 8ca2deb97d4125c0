#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <numbers>
#include <regex>
#include <string>
#include <vector>

#include "host/report/chart.hpp"
#include "host/report/html.hpp"
#include "host/report/page.hpp"

namespace groma::report {
namespace {

using Eigen::Vector2d;

std::size_t count(const std::string& text, const std::string& part) {
  std::size_t found = 0;
  for (std::size_t at = text.find(part); at != std::string::npos; at = text.find(part, at + 1)) ++found;
  return found;
}

// The numbers that a pattern's groups catch at its first match.
std::vector<double> numbers(const std::string& text, const std::string& pattern) {
  std::vector<double> values;
  std::smatch match;
  if (std::regex_search(text, match, std::regex(pattern))) {
    for (std::size_t i = 1; i < match.size(); ++i) values.push_back(std::stod(match[i]));
  }
  return values;
}

Chart make_map() {
  return Chart({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 600.0});
}

TEST(ChartTest, BothAxesOfAMapHaveTheSameScale) {
  Chart map = make_map();
  map.add_line("way", Ink::kPath, {{0.0, 0.0}, {10.0, 0.0}, {10.0, 10.0}});
  const std::vector<double> p =
      numbers(map.svg(),
              "class=\"line path\" d=\"M([-0-9.]+) ([-0-9.]+)L([-0-9.]+) ([-0-9.]+)L([-0-9.]+) ([-0-9.]+)\"");
  ASSERT_EQ(p.size(), 6U);
  EXPECT_GT(p[2] - p[0], 100.0);
  EXPECT_NEAR(p[2] - p[0], p[3] - p[5], 0.21) << "x to the right, y up";
  EXPECT_NEAR(p[1], p[3], 0.11);
}

TEST(ChartTest, ALineBreaksAtNonFinitePoints) {
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  Chart map = make_map();
  map.add_line("", Ink::kPath, {{0.0, 0.0}, {5.0, 5.0}, {kNone, kNone}, {7.0, 2.0}, {9.0, 1.0}});
  const std::string svg = map.svg();
  const std::size_t at = svg.find("class=\"line path\"");
  const std::string line = svg.substr(at, svg.find("/>", at) - at);
  EXPECT_EQ(count(line, "M"), 2U);
  EXPECT_EQ(count(line, "L"), 2U);
  EXPECT_EQ(svg.find("nan"), std::string::npos);
}

TEST(ChartTest, IndistinguishablePointsAreOmitted) {
  std::vector<Vector2d> points;
  for (int i = 0; i <= 100'000; ++i) points.emplace_back(i * 1e-4, std::sin(i * 1e-4));
  Chart chart({.x_label = "t (s)", .y_label = "v"});
  chart.add_line("v", Ink::kSeries1, points);
  EXPECT_LT(chart.svg().size(), 60'000U);
}

// The long axis of an ellipse points up to the right where x and y grow together.
TEST(ChartTest, AnEllipseIsOrientedLikeItsCovariance) {
  Chart map = make_map();
  map.add_line("", Ink::kPath, {{0.0, 0.0}, {20.0, 10.0}});
  const double turn = std::numbers::pi / 6.0;
  Eigen::Matrix2d axes;
  axes << std::cos(turn), -std::sin(turn), std::sin(turn), std::cos(turn);
  const Eigen::Matrix2d covariance = axes * Vector2d(1.0, 0.04).asDiagonal() * axes.transpose();
  map.add_ellipses("95 % ellipse", Ink::kAnchor, {{{10.0, 5.0}, covariance}});
  const std::string svg = map.svg();
  const std::vector<double> e = numbers(
      svg,
      "rx=\"([0-9.]+)\" ry=\"([0-9.]+)\" transform=\"translate\\(([0-9.]+) ([0-9.]+)\\) rotate\\(([-0-9.]+)");
  ASSERT_EQ(e.size(), 5U);
  EXPECT_NEAR(e[0] / e[1], 5.0, 0.1);
  EXPECT_NEAR(std::remainder(e[4] + 30.0, 180.0), 0.0, 0.1) << "SVG turns clockwise";
  const std::vector<double> line = numbers(svg, "d=\"M([-0-9.]+) ([-0-9.]+)L([-0-9.]+) ([-0-9.]+)\"");
  ASSERT_EQ(line.size(), 4U);
  const double px_per_m = (line[2] - line[0]) / 20.0;
  EXPECT_NEAR(e[0], std::sqrt(5.991) * px_per_m, 0.2) << "large enough to be drawn without enlargement";
  EXPECT_EQ(svg.find("×"), std::string::npos);
}

TEST(ChartTest, EllipsesTooSmallToSeeAreEnlargedAndLabelled) {
  Chart map = make_map();
  map.add_line("", Ink::kPath, {{0.0, 0.0}, {100.0, 50.0}});
  map.add_ellipses("95 % ellipse", Ink::kAnchor, {{{50.0, 25.0}, 4e-4 * Eigen::Matrix2d::Identity()}});
  const std::string svg = map.svg();
  EXPECT_NE(svg.find("95 % ellipse (× 20)"), std::string::npos);
}

TEST(ChartTest, DrawsOnlyDistinguishableDots) {
  std::vector<Vector2d> points{{0.0, 0.0}, {1.0, 1.0}};
  for (int i = 0; i < 100'000; ++i) points.emplace_back(0.5, 0.5);
  Chart chart({.x_label = "x", .y_label = "y"});
  chart.add_points("dots", Ink::kSeries1, points);
  const std::string svg = chart.svg();
  const std::size_t at = svg.find("class=\"points s1\"");
  ASSERT_NE(at, std::string::npos);
  EXPECT_EQ(count(svg.substr(at, svg.find("/>", at) - at), "h0"), 3U);
}

TEST(ChartTest, AChartMayHaveNoPointOrOne) {
  for (const std::vector<Vector2d>& points : {std::vector<Vector2d>{}, std::vector<Vector2d>{{1e9, -1e9}},
                                              std::vector<Vector2d>{{3.0, 3.0}, {3.0, 3.0}}}) {
    Chart map = make_map();
    map.add_line("way", Ink::kPath, points);
    Chart chart({.x_label = "x", .y_label = "y"});
    chart.add_line("way", Ink::kPath, points);
    chart.add_points("dots", Ink::kPath, points);
    for (const std::string& svg : {map.svg(), chart.svg()}) {
      EXPECT_EQ(svg.find("nan"), std::string::npos);
      EXPECT_EQ(svg.find("inf"), std::string::npos);
      EXPECT_LT(svg.size(), 20'000U);
    }
  }
}

TEST(PageTest, TextIsEscapedEverywhere) {
  const std::string evil = "<script>alert(\"1\") & '2'</script>";
  Page page(evil, evil);
  page.add_facts({{evil, evil, Tone::kBad}});
  page.add_heading(evil);
  page.add_text(evil);
  page.add_notice(evil, evil, Tone::kBad);
  page.begin_part(evil, evil, evil, Tone::kGood, true);
  page.end_part();
  page.add_table({evil}, {{{evil, Tone::kWarning, true}}});
  Chart chart({.title = evil, .x_label = evil, .y_label = evil});
  chart.add_marks(evil, Ink::kAnchor, {{{0.0, 0.0}, evil, evil, evil}, {{1.0, 1.0}, ""}});
  page.add_chart(chart, evil);
  const std::string html = page.html();
  EXPECT_EQ(html.find("<script"), std::string::npos);
  EXPECT_GT(count(html, escaped(evil)), 10U);
}

TEST(PageTest, EveryOpenedElementIsClosed) {
  Page page("title", "subtitle");
  page.add_facts({{"1", "one"}});
  page.add_table({"a", "b"}, {{{"1"}, {"2"}}, {{"3"}, {"4"}}});
  Chart chart({.x_label = "x", .y_label = "y"});
  chart.add_intervals("i", Ink::kSeries1, {{0.0, 1.0}, {1.0, 2.0}}, {0.1, 0.2});
  chart.add_strokes("wall", Ink::kWall, {{{0.0, 0.0}, {1.0, 1.0}}});
  chart.add_marks("m", Ink::kAnchor, {{{0.0, 0.0}, "1", "hint", "place"}, {{1.0, 1.0}, "2"}});
  page.add_charts({chart, chart}, "two");
  page.begin_part("place", "part", "remark", Tone::kWarning, false);
  page.add_notice("it", "is so", Tone::kBad);
  page.end_part();
  const std::string html = page.html();
  for (const std::string element : {"svg", "g", "a", "title", "table", "tr", "td", "th", "figure", "details",
                                    "summary", "div", "main", "body", "text", "p", "span", "b"}) {
    EXPECT_EQ(count(html, "<" + element + ">") + count(html, "<" + element + " "),
              count(html, "</" + element + ">"))
        << element;
  }
}

}  // namespace
}  // namespace groma::report
