// A report in a browser: hover, wheel and drag, and its layout on a narrow screen. Needs chromium
// (scripts/setup browser).
#include <gtest/gtest.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <string>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/report/drive_report.hpp"
#include "host/report/page.hpp"
#include "test/support/child_process.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::report {
namespace {

using nlohmann::json;

// Helpers of the scripts below; done() ends one.
constexpr const char* kHelpers = R"js(
const chart = (title) => [...document.querySelectorAll(".chart")].find((c) => (c.querySelector("h3") || {}).textContent === title);
const position = chart("Position error"), map = document.querySelector(".chart[data-map]");
const area = (c) => c.querySelector(".area"), box = (c) => c.querySelector(".data").getAttribute("viewBox").split(" ").map(Number);
const tip = () => document.querySelector(".tip").hidden ? "" : document.querySelector(".tip").textContent;
function send(c, Type, type, u, v, more) {
  const b = area(c).getBoundingClientRect();
  area(c).dispatchEvent(new Type(type, {clientX: b.left + u * b.width, clientY: b.top + v * b.height, bubbles: true,
                                        cancelable: true, button: 0, pointerId: 1, pointerType: "mouse", ...more}));
}
for (const one of document.querySelectorAll(".area")) one.setPointerCapture = () => {};
// A browser without a screen may draw no frame.
window.requestAnimationFrame = (draw) => setTimeout(draw, 0);
const frames = () => new Promise((resolve) => setTimeout(resolve, 50));
const done = (result) => { document.body.dataset.result = JSON.stringify(result); };
)js";

std::string chromium() {
  const test::ChildResult found = test::run_child({"/bin/sh", "-c", "command -v chromium"});
  return found.out.substr(0, found.out.find('\n'));
}

class BrowserTest : public testing::Test {
 protected:
  void SetUp() override {
    if (!chromium().empty()) return;
    const char* const message = "no chromium: run scripts/setup browser";
    if (std::getenv("GROMA_REQUIRE_BROWSER") != nullptr) FAIL() << message;
    GTEST_SKIP() << message;
  }

  // A circle of 10 m; the estimate is 0.1 m outside of the truth.
  static std::string page() {
    std::vector<model::PlanarEstimate> rows;
    std::vector<model::PoseSample> truth;
    DriveView view;
    for (int i = 0; i <= 1000; ++i) {
      const double t_s = 0.1 * i;
      const double turn = 0.05 * t_s;
      rows.push_back(
          {t_s, 10.1 * std::cos(turn), 10.1 * std::sin(turn), turn, 0.01 * Eigen::Matrix3d::Identity()});
      truth.push_back(
          {.t_s = t_s, .x_m = 10.0 * std::cos(turn), .y_m = 10.0 * std::sin(turn), .yaw_rad = turn});
      view.ranges.push_back(
          {.t_s = t_s, .tag_id = 1, .anchor_id = 4, .innovation_m = 0.05, .sigma_m = 0.1, .weight = 1.0});
    }
    view.rows = rows;
    view.truth = truth;
    view.states = {{0.0, 40.0, "CONVERGING", ""}, {40.0, 100.0, "TRACKING", ""}};
    Page page("A circle", "");
    add_drive(page, view);
    return page.html();
  }

  // Twelve anchors within a metre of a site of 100 m.
  static std::string page_of_close_anchors() {
    Chart map({.x_label = "x (m)", .y_label = "y (m)", .same_scale = true, .height_px = 600.0});
    std::vector<Mark> marks;
    marks.reserve(12);
    for (int row = 0; row < 3; ++row)
      for (int i = 0; i < 4; ++i)
        marks.push_back(
            {.at = {50.0 + 0.3 * i, 30.0 + 0.3 * row}, .label = std::to_string(100 + 4 * row + i)});
    map.add_line("drive", Ink::kPath, {{0.0, 0.0}, {100.0, 60.0}});
    map.add_marks("anchor", Ink::kAnchor, marks);
    Page page("Close anchors", "");
    page.add_chart(map, "");
    return page.html();
  }

  // What the script gives to done().
  static json run(const std::string& script, int width_px = 1400, std::string html = page()) {
    const test::ScratchFolder folder;
    html.insert(html.rfind("</body>"), std::string("<script>") + kHelpers + script + "</script>\n");
    folder.write("report.html", html);
    const test::ChildResult result = test::run_child(
        {chromium(), "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=5000",
         "--dump-dom", "--window-size=" + std::to_string(width_px) + ",900",
         "--user-data-dir=" + (folder / "profile").string(), "file://" + (folder / "report.html").string()});
    const std::string mark = "data-result=\"";
    const std::size_t at = result.out.find(mark);
    if (at == std::string::npos) {
      ADD_FAILURE() << "the script has not ended: " << result.err;
      return {};
    }
    const std::size_t from = at + mark.size();
    std::string text = result.out.substr(from, result.out.find('"', from) - from);
    for (std::size_t quote = 0; (quote = text.find("&quot;")) != std::string::npos;)
      text.replace(quote, 6, "\"");
    return json::parse(text);
  }
};

TEST_F(BrowserTest, HoverShowsValuesAndTheSameTimeElsewhere) {
  const json result = run(R"js(
send(position, PointerEvent, "pointermove", 0.5, 0.5);
const over_time = tip();
const dot = map.querySelector(".dot");
const shown = [dot.getAttribute("visibility"), parseFloat(dot.getAttribute("cx"))];
send(position, PointerEvent, "pointerleave", 0.5, 0.5);
done({over_time, shown, after: tip()});
)js");
  EXPECT_EQ(result["over_time"].get<std::string>().substr(0, 7), "50.00 s");
  EXPECT_NE(result["over_time"].get<std::string>().find("error: 0.1"), std::string::npos) << result;
  EXPECT_EQ(result["shown"][0], "visible");
  EXPECT_LT(result["shown"][1].get<double>(), 50.0) << "after 50 s the circle is left of its middle";
  EXPECT_EQ(result["after"], "");
}

TEST_F(BrowserTest, WheelAndDragZoomAllChartsOverTime) {
  const json result = run(R"js(
(async () => {
  const before = box(position);
  send(position, WheelEvent, "wheel", 0.5, 0.5, {deltaY: -200});
  await frames();
  const wheel = box(position);
  send(position, PointerEvent, "dblclick", 0.5, 0.5);
  await frames();
  const again = box(position);
  send(position, PointerEvent, "pointerdown", 0.25, 0.5);
  send(position, PointerEvent, "pointermove", 0.5, 0.5);
  send(position, PointerEvent, "pointerup", 0.5, 0.5);
  await frames();
  const ticks = [...position.querySelectorAll(".ticks .x")].map((tick) => Number(tick.textContent));
  done({before, wheel, again, drag: box(position), other: box(chart("NEES")), state: box(chart("State")), ticks,
        button: !position.querySelector(".all").hidden});
})();
)js");
  const double width = result["before"][2].get<double>();
  EXPECT_NEAR(result["wheel"][2].get<double>(), std::exp(-0.4) * width, 1.0);
  EXPECT_NEAR(result["again"][0].get<double>(), 0.0, 0.01);
  EXPECT_NEAR(result["again"][2].get<double>(), width, 0.01);
  EXPECT_NEAR(result["drag"][0].get<double>(), 0.25 * width, 2.0);
  EXPECT_NEAR(result["drag"][2].get<double>(), 0.25 * width, 2.0);
  EXPECT_NEAR(result["other"][2].get<double>(), result["drag"][2].get<double>(), 1.0);
  EXPECT_NEAR(result["state"][0].get<double>(), result["drag"][0].get<double>(), 1.0);
  EXPECT_GE(result["ticks"][0].get<double>(), 24.9);
  EXPECT_LE(result["ticks"].back().get<double>(), 50.1);
  EXPECT_GT(result["ticks"].size(), 3U);
  EXPECT_TRUE(result["button"].get<bool>());
}

TEST_F(BrowserTest, AMapKeepsItsProportions) {
  const json result = run(R"js(
(async () => {
  send(map, WheelEvent, "wheel", 0.5, 0.5, {deltaY: -200});
  await frames();
  const wheel = box(map);
  done({full: map.dataset.size.split(" ").map(Number), wheel});
})();
)js");
  EXPECT_NEAR(result["wheel"][2].get<double>() / result["wheel"][3].get<double>(),
              result["full"][0].get<double>() / result["full"][1].get<double>(), 0.01);
}

// No text beyond the screen, none over another, at any width; a page is never wider than the screen.
TEST_F(BrowserTest, TextIsNeitherClippedNorOverlapping) {
  for (const int width_px : {1400, 800, 500}) {
    const json result = run(R"js(
const faults = [];
for (const kind of [".x", ".y"]) {
  for (const one of document.querySelectorAll(".chart")) {
    const boxes = [...one.querySelectorAll(".ticks " + kind)].map((tick) => [tick.getBoundingClientRect(), tick.textContent])
                                                            .filter(([b]) => b.width > 0);
    for (const [b, text] of boxes) if (b.left < 0 || b.right > innerWidth) faults.push(`clipped ${text}`);
    boxes.forEach(([b, text], i) => {
      for (const [c, other] of boxes.slice(i + 1))
        if (b.left < c.right && c.left < b.right && b.top < c.bottom && c.top < b.bottom) faults.push(`${text} over ${other}`);
    });
  }
}
done({faults, page: document.documentElement.scrollWidth, screen: innerWidth});
)js",
                            width_px);
    EXPECT_EQ(result["faults"], json::array()) << width_px;
    EXPECT_LE(result["page"].get<double>(), result["screen"].get<double>()) << width_px;
  }
}

TEST_F(BrowserTest, LabelsOfCloseAnchorsAreApart) {
  for (const int width_px : {1400, 800, 500}) {
    const json result = run(R"js(
const faults = [];
const boxes = [...document.querySelectorAll(".label")].map((label) => [label.getBoundingClientRect(), label.textContent])
                                                      .filter(([b]) => b.width > 0);
boxes.forEach(([b, text], i) => {
  if (b.left < 0 || b.right > innerWidth) faults.push(`clipped ${text}`);
  for (const [c, other] of boxes.slice(i + 1))
    if (b.left < c.right - 1 && c.left < b.right - 1 && b.top < c.bottom - 4 && c.top < b.bottom - 4) faults.push(`${text} over ${other}`);
});
done({faults, labels: boxes.length});
)js",
                            width_px, page_of_close_anchors());
    EXPECT_EQ(result["faults"], json::array()) << width_px;
    EXPECT_EQ(result["labels"], 12) << width_px << ": each once";
  }
}

}  // namespace
}  // namespace groma::report
