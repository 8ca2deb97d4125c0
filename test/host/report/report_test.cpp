#include <fmt/format.h>
#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <limits>
#include <numbers>
#include <regex>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "host/report/chart.hpp"
#include "host/report/drive_report.hpp"
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

// The shares that data-p holds, of its first series.
std::vector<unsigned> samples_of(const std::string& html) {
  std::smatch match;
  std::vector<unsigned> shares;
  if (!std::regex_search(html, match, std::regex("data-p=\"([^\"]*)\""))) return shares;
  const std::string digits = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  std::vector<unsigned> bytes;
  unsigned bits = 0;
  int held = 0;
  for (const char c : match[1].str()) {
    if (c == '=') break;
    bits = (bits << 6U) | static_cast<unsigned>(digits.find(c));
    held += 6;
    if (held < 8) continue;
    held -= 8;
    bytes.push_back((bits >> static_cast<unsigned>(held)) & 255U);
  }
  for (std::size_t i = 0; i + 1 < bytes.size(); i += 2) shares.push_back(bytes[i] + 256U * bytes[i + 1]);
  return shares;
}

TEST(ChartTest, BothAxesOfAMapHaveTheSameScale) {
  Chart map = make_map();
  map.add_line("way", Ink::kPath, {{0.0, 0.0}, {10.0, 0.0}, {10.0, 10.0}});
  const std::vector<double> p = numbers(
      map.html(),
      "class=\"line path\"[^>]* d=\"M([-0-9.]+) ([-0-9.]+)L([-0-9.]+) ([-0-9.]+)L([-0-9.]+) ([-0-9.]+)\"");
  ASSERT_EQ(p.size(), 6U);
  EXPECT_GT(p[2] - p[0], 100.0);
  EXPECT_NEAR(p[2] - p[0], p[3] - p[5], 0.21) << "x to the right, y up";
  EXPECT_NEAR(p[1], p[3], 0.11);
}

TEST(ChartTest, ALineBreaksAtNonFinitePoints) {
  constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
  Chart map = make_map();
  map.add_line("", Ink::kPath, {{0.0, 0.0}, {5.0, 5.0}, {kNone, kNone}, {7.0, 2.0}, {9.0, 1.0}});
  const std::string svg = map.html();
  const std::size_t at = svg.find(" d=\"", svg.find("class=\"line path\""));
  const std::string line = svg.substr(at, svg.find("/>", at) - at);
  EXPECT_EQ(count(line, "M"), 2U);
  EXPECT_EQ(count(line, "L"), 2U);
  const std::vector<unsigned> samples = samples_of(svg);
  ASSERT_EQ(samples.size(), 10U);
  EXPECT_EQ(samples[4], 65535U);
  EXPECT_EQ(samples[5], 65535U);
  EXPECT_EQ(svg.find("nan"), std::string::npos);
}

TEST(ChartTest, IndistinguishablePointsAreOmitted) {
  std::vector<Vector2d> points;
  for (int i = 0; i <= 100'000; ++i) points.emplace_back(i * 1e-4, std::sin(i * 1e-4));
  Chart chart({.x_label = "t (s)", .y_label = "v"});
  chart.add_line("v", Ink::kSeries1, points);
  EXPECT_LT(chart.html().size(), 200'000U);
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
  const std::string svg = map.html();
  const std::vector<double> e = numbers(
      svg,
      "rx=\"([0-9.]+)\" ry=\"([0-9.]+)\" transform=\"translate\\(([0-9.]+) ([0-9.]+)\\) rotate\\(([-0-9.]+)");
  ASSERT_EQ(e.size(), 5U);
  EXPECT_NEAR(e[0] / e[1], 5.0, 0.1);
  EXPECT_NEAR(std::remainder(e[4] + 30.0, 180.0), 0.0, 0.1) << "SVG turns clockwise";
  const std::vector<double> line = numbers(svg, " d=\"M([-0-9.]+) ([-0-9.]+)L([-0-9.]+) ([-0-9.]+)\"");
  ASSERT_EQ(line.size(), 4U);
  const double px_per_m = (line[2] - line[0]) / 20.0;
  EXPECT_NEAR(e[0], std::sqrt(5.991) * px_per_m, 0.2) << "large enough to be drawn without enlargement";
  EXPECT_EQ(svg.find("×"), std::string::npos);
}

TEST(ChartTest, EllipsesTooSmallToSeeAreEnlargedAndLabelled) {
  Chart map = make_map();
  map.add_line("", Ink::kPath, {{0.0, 0.0}, {100.0, 50.0}});
  map.add_ellipses("95 % ellipse", Ink::kAnchor, {{{50.0, 25.0}, 4e-4 * Eigen::Matrix2d::Identity()}});
  const std::string svg = map.html();
  EXPECT_NE(svg.find("95 % ellipse (× 20)"), std::string::npos);
}

TEST(ChartTest, DrawsOnlyDistinguishableDots) {
  std::vector<Vector2d> points{{0.0, 0.0}, {1.0, 1.0}};
  for (int i = 0; i < 100'000; ++i) points.emplace_back(0.5, 0.5);
  Chart chart({.x_label = "x", .y_label = "y"});
  chart.add_points("dots", Ink::kSeries1, points);
  const std::string svg = chart.html();
  const std::size_t at = svg.find("class=\"points s1\"");
  ASSERT_NE(at, std::string::npos);
  EXPECT_EQ(samples_of(svg).size(), 6U);
  EXPECT_EQ(count(svg.substr(at, svg.find("/>", at) - at), "h0"), 3U);
}

// The samples of the script reproduce the values to a 65534th of their range.
TEST(ChartTest, SamplesAreSharesOfTheirBounds) {
  Chart map = make_map();
  map.add_path("way", Ink::kPath, {{0.0, 0.0, 10.0}, {4.0, 2.0, 20.0}, {8.0, 1.0, 30.0}});
  const std::string html = map.html();
  EXPECT_NE(html.find("data-n=\"way\" data-b=\"0 8 0 2 10 30\""), std::string::npos);
  EXPECT_EQ(samples_of(html), (std::vector<unsigned>{0, 0, 0, 32767, 65534, 32767, 65534, 32767, 65534}));
}

TEST(ChartTest, ALogarithmicAxisHasDecades) {
  Chart chart({.x_label = "time (s)", .y_label = "error (m)", .log_y = true});
  chart.add_line("error", Ink::kSeries1, {{0.0, 0.01}, {1.0, 0.1}, {2.0, 0.0}, {3.0, 1.0}, {4.0, 10.0}});
  const std::string html = chart.html();
  for (const char* const text : {"0.01", "0.1", "1", "10"})
    EXPECT_NE(html.find(std::string("%\">") + text + "</i>"), std::string::npos) << text;
  const std::vector<double> line =
      numbers(html, " d=\"M[0-9.]+ ([0-9.]+)L[0-9.]+ ([0-9.]+)M[0-9.]+ ([0-9.]+)L[0-9.]+ ([0-9.]+)\"");
  ASSERT_EQ(line.size(), 4U) << "zero is a break";
  EXPECT_NEAR(line[0] - line[1], line[2] - line[3], 0.15);
  EXPECT_NEAR(line[0] - line[2], 2.0 * (line[2] - line[3]), 0.15);
}

// Values beyond a given range must not be drawn over other parts: the area clips them, and a line of text has
// its own place outside of it.
TEST(ChartTest, ValuesBeyondTheRangeKeepTheResolutionOfTheOthers) {
  Chart chart({.x_label = "t (s)", .y_label = "residual (m)", .y_range = Vector2d(-1.0, 1.0)});
  chart.add_points("dots", Ink::kSeries1, {{0.0, 0.0}, {1.0, 0.5}, {2.0, 50.0}});
  const std::vector<double> bounds =
      numbers(chart.html(), "data-b=\"([-0-9.]+) ([-0-9.]+) ([-0-9.]+) ([-0-9.]+)\"");
  ASSERT_EQ(bounds.size(), 4U);
  EXPECT_EQ(bounds[3], 9.0) << "four times the range above it";
}

TEST(ChartTest, EllipsesOfEachInkAreInTheLegend) {
  Chart map = make_map();
  for (const Ink ink : {Ink::kEstimate, Ink::kAnchor})
    map.add_ellipses("95 % ellipse", ink,
                     {{{1.0, 1.0}, Eigen::Matrix2d::Identity()}, {{9.0, 4.0}, Eigen::Matrix2d::Identity()}});
  const std::string html = map.html();
  const std::string legend = html.substr(html.find("<ul"), html.find("</ul>") - html.find("<ul"));
  EXPECT_EQ(count(legend, "class=\"ellipse estimate\""), 1U);
  EXPECT_EQ(count(legend, "class=\"ellipse anchor\""), 1U);
}

TEST(ChartTest, AnArrowPointsWhereItSays) {
  Chart map = make_map();
  map.add_line("", Ink::kPath, {{0.0, 0.0}, {10.0, 10.0}});
  map.add_marks("direction", Ink::kEstimate,
                {{.at = {5.0, 5.0}, .label = "", .turn_rad = 0.5 * std::numbers::pi}}, Shape::kArrow);
  const std::string html = map.html();
  EXPECT_NE(html.find("rotate(-90)"), std::string::npos) << "up the page";
}

TEST(ChartTest, AChartMayHaveNoPointOrOne) {
  for (const std::vector<Vector2d>& points : {std::vector<Vector2d>{}, std::vector<Vector2d>{{1e9, -1e9}},
                                              std::vector<Vector2d>{{3.0, 3.0}, {3.0, 3.0}}}) {
    Chart map = make_map();
    map.add_line("way", Ink::kPath, points);
    Chart chart({.x_label = "x", .y_label = "y"});
    chart.add_line("way", Ink::kPath, points);
    chart.add_points("dots", Ink::kPath, points);
    for (const std::string& svg : {map.html(), chart.html()}) {
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
  EXPECT_EQ(count(html, "<script"), 1U) << "the page's own";
  EXPECT_GT(count(html, escaped(evil)), 10U);
  EXPECT_EQ(escaped("<a b=\"c\">&"), "&lt;a b=&quot;c&quot;&gt;&amp;");
}

// The labels that a chart shows at this width of its area, as boxes: left, top, right, bottom.
std::vector<std::array<double, 4>> label_boxes(const std::string& html, const std::string& css,
                                               double width_px, double height_px) {
  std::vector<std::array<double, 4>> boxes;
  const std::regex at("<svg class=\"at\" x=\"([-.0-9]+)%\" y=\"([-.0-9]+)%\"[^>]*>(.*)</svg>");
  const std::regex group("<g class=\"([^\"]*)\">(.*?)</g>");
  const std::regex text("<text class=\"label\" x=\"([-.0-9]+)\" y=\"([-.0-9]+)\">([^<]*)<");
  std::istringstream lines(html);
  for (std::string line; std::getline(lines, line);) {
    std::smatch place;
    if (!std::regex_search(line, place, at)) continue;
    const std::string content = place[3];
    for (std::sregex_iterator of(content.begin(), content.end(), group), end; of != end; ++of) {
      std::smatch label;
      const std::string inside = (*of)[2];
      if (!css.empty() && (*of)[1].str().find(css) == std::string::npos) continue;
      if (!std::regex_search(inside, label, text)) continue;
      const double left = std::stod(place[1]) / 100.0 * width_px + std::stod(label[1]);
      const double base = std::stod(place[2]) / 100.0 * height_px + std::stod(label[2]);
      boxes.push_back({left, base - 9.0, left + 6.8 * static_cast<double>(label[3].length()), base});
    }
  }
  return boxes;
}

TEST(ChartTest, LabelsOfCloseMarksDoNotOverlapAtAnyWidth) {
  Chart map = make_map();
  map.add_line("drive", Ink::kPath, {{0.0, 0.0}, {100.0, 60.0}});
  std::vector<Mark> marks;
  marks.reserve(24);
  // Apart on a wide screen, where one is beside the other; close on a narrow one.
  for (int i = 0; i < 6; ++i)
    marks.push_back({.at = {20.0 + 5.0 * i, 50.0}, .label = fmt::format("{}", 200 + i)});
  for (int row = 0; row < 3; ++row)  // within a metre, some 10 px
    for (int i = 0; i < 4; ++i)
      marks.push_back(
          {.at = {50.0 + 0.3 * i, 30.0 + 0.3 * row}, .label = fmt::format("{}", 100 + 4 * row + i)});
  for (int i = 0; i < 6; ++i) marks.push_back({.at = {0.0, 10.0 * i}, .label = fmt::format("{}", 10 + i)});
  map.add_marks("anchor", Ink::kAnchor, marks);
  const std::string html = map.html();
  const std::vector<double> size_px = numbers(html, "data-size=\"([0-9]+) ([0-9]+)\"");
  ASSERT_EQ(size_px.size(), 2U);
  for (const auto& [css, at_px] :
       {std::pair("w360", 256.0), std::pair("w360", 370.0), std::pair("w480", 376.0),
        std::pair("w640", 509.0), std::pair("w900", 768.0), std::pair("w900", 974.0)}) {
    const auto boxes = label_boxes(html, css, at_px, size_px[1] * at_px / size_px[0]);
    ASSERT_EQ(boxes.size(), marks.size()) << css;
    for (std::size_t i = 0; i < boxes.size(); ++i) {
      EXPECT_GT(boxes[i][0], -8.0) << css;
      EXPECT_LT(boxes[i][2], at_px + 14.0) << css;
      for (std::size_t k = 0; k < i; ++k) {
        const bool is_apart = boxes[i][0] >= boxes[k][2] || boxes[k][0] >= boxes[i][2] ||
                              boxes[i][1] >= boxes[k][3] || boxes[k][1] >= boxes[i][3];
        EXPECT_TRUE(is_apart) << css << " at " << at_px << ": " << i << " and " << k;
      }
    }
  }
  EXPECT_GT(count(html, "class=\"lead\""), 0U) << "a line leads from a far label to its mark";
}

TEST(PageTest, TheFootHasCommandAndDate) {
  Page page("title", "subtitle");
  page.set_provenance(
      {.command = "groma replay a<b", .date = "2026-11-27 12:00 UTC", .versions = {{"input", "hall"}}});
  const std::string html = page.html();
  const std::string foot = html.substr(html.find("<footer>"));
  EXPECT_NE(foot.find("<code>groma replay a&lt;b</code>"), std::string::npos);
  EXPECT_NE(foot.find("2026-11-27 12:00 UTC"), std::string::npos);
  EXPECT_NE(foot.find("<dt>input</dt><dd><span>hall</span></dd>"), std::string::npos);
  EXPECT_EQ(html.find("<script"), std::string::npos) << "a page without charts needs none";
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
  for (const std::string element :
       {"svg",     "g",      "a",     "title", "ul",   "li", "i",    "h3",     "footer",
        "dl",      "script", "style", "table", "tr",   "td", "th",   "figure", "details",
        "summary", "div",    "main",  "body",  "text", "p",  "span", "b"}) {
    EXPECT_EQ(count(html, "<" + element + ">") + count(html, "<" + element + " "),
              count(html, "</" + element + ">"))
        << element;
  }
}

// A drive along x at 1 m/s, whose truth is 0.1 m to the left.
struct StraightDrive {
  std::vector<model::PlanarEstimate> rows;
  std::vector<model::PoseSample> truth;
  std::vector<RangeRow> ranges;
  StraightDrive() {
    for (int i = 0; i <= 400; ++i) {
      const double t_s = 0.05 * i;
      rows.push_back({t_s, t_s, 0.0, 0.0, 0.01 * Eigen::Matrix3d::Identity()});
      truth.push_back({.t_s = t_s, .x_m = t_s, .y_m = 0.1});
      ranges.push_back({.t_s = t_s,
                        .tag_id = 1,
                        .anchor_id = static_cast<model::NodeId>(4 + i % 2),
                        .range_m = 5.0,
                        .innovation_m = i % 2 == 0 ? 0.05 : 0.4,
                        .sigma_m = 0.1,
                        .weight = i % 2 == 0 ? 1.0 : 0.0,
                        .correction = {i % 2 == 0 ? 0.001 : 0.0, 0.0, 0.0}});
    }
  }
};

TEST(DriveReportTest, HasTheFiguresOfTheDrive) {
  const StraightDrive drive;
  Page page("drive", "");
  add_drive(page, {.rows = drive.rows,
                   .truth = drive.truth,
                   .states = {{0.0, 5.0, "CONVERGING", ""}, {5.0, 20.0, "DEGRADED", "no-ranges"}},
                   .ranges = drive.ranges});
  const std::string html = page.html();
  for (const char* const text :
       {"<b class=\"\">0.100 m</b><span>mean position error</span>",
        "<b class=\"badly\">0 %</b><span>of the time TRACKING</span>",
        "<b class=\"\">50 %</b><span>of 401 ranges used</span>",
        "<b class=\"\">20 m</b><span>driven in 20 s</span>", "DEGRADED (no-ranges) from 5.0 to 20.0 s",
        "anchor 4: corrections of 0.20 m together, net 0.20 m",
        "<b class=\"\">0.33</b><span>mean NEES / 3; 1 is consistent</span>", ">start<", ">end<", "Anchor 5"})
    EXPECT_NE(html.find(text), std::string::npos) << text;
  EXPECT_EQ(html.find("nan"), std::string::npos);
}

TEST(DriveReportTest, WithoutTruthItShowsTheUncertainty) {
  const StraightDrive drive;
  Page page("drive", "");
  add_drive(page, {.rows = drive.rows});
  const std::string html = page.html();
  EXPECT_NE(html.find("95 % radius of the estimate"), std::string::npos);
  EXPECT_EQ(html.find("mean position error"), std::string::npos);
}

// A line over time keeps the largest error of a long drive.
TEST(DriveReportTest, APeakOfALongDriveIsKept) {
  StraightDrive drive;
  drive.rows.clear();
  drive.truth.clear();
  for (int i = 0; i < 100'000; ++i) {
    const double t_s = 0.05 * i;
    drive.rows.push_back({t_s, i == 54'321 ? 3.0 : 0.1, 0.0, 0.0, Eigen::Matrix3d::Identity()});
    drive.truth.push_back({.t_s = t_s});
  }
  Page page("drive", "");
  add_drive(page, {.rows = drive.rows, .truth = drive.truth});
  EXPECT_NE(page.html().find(fmt::format("{:.9g}\" data-p", std::log10(3.0))), std::string::npos);
}

TEST(MomentReportTest, HasThePoseAndEachRange) {
  const StraightDrive drive;
  model::Calibration calibration;
  Page page("moment", "");
  add_moment(page, {.at_s = 10.0,
                    .rows = drive.rows,
                    .states = {{0.0, 20.0, "TRACKING", ""}},
                    .calibration = &calibration,
                    .ranges = drive.ranges});
  const std::string html = page.html();
  for (const char* const text :
       {"<b class=\"\">TRACKING</b>", "201 of 401", "anchor 4: +20.10 cm", "x 10.000 m"})
    EXPECT_NE(html.find(text), std::string::npos) << text;
}

}  // namespace
}  // namespace groma::report
