// Charts as SVG: a map in metres or a quantity over another, with axes, grid and legend. Colours are the
// style sheet's (page.hpp), so that a chart follows the reader's light or dark theme.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace groma::report {

// What a thing is drawn in.
enum class Ink {
  kTruth,
  kEstimate,
  kPath,
  kOther,
  kWall,
  kAnchor,
  kWarning,
  kBad,
  kGood,
  kSeries1,
  kSeries2,
  kSeries3,
  kSeries4
};

// The ink of the n-th of several equal series, from 0.
[[nodiscard]] Ink series_ink(std::size_t n);

struct Ellipse {
  Eigen::Vector2d center = Eigen::Vector2d::Zero();
  Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero();
};

struct Mark {
  Eigen::Vector2d at = Eigen::Vector2d::Zero();
  std::string label;   // beside it; may be empty
  std::string hint{};  // shown where the pointer rests on it
  std::string link{};  // id of the place on the page that it leads to
};

class Chart {
 public:
  struct Axes {
    std::string title{};
    std::string x_label{};
    std::string y_label{};
    bool same_scale = false;  // a map: one metre is as long on both axes
    double width_px = 1040.0;
    double height_px = 320.0;  // of a map: at most
    bool legend = true;
    std::optional<Eigen::Vector2d> y_range{};  // lower and upper end; none: what is drawn
  };
  explicit Chart(Axes axes) : axes_(std::move(axes)) {}

  // All coordinates are the axes' own. A name goes into the legend, once; an empty one does not. What is not
  // finite is left out; in a line it makes a break.
  void add_line(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points, bool dashed = false);
  // Separate strokes, such as walls.
  void add_strokes(const std::string& name, Ink ink,
                   std::vector<std::pair<Eigen::Vector2d, Eigen::Vector2d>> strokes);
  void add_marks(const std::string& name, Ink ink, std::vector<Mark> marks);
  // Dots, however many: of those that fall on one spot the first is drawn.
  void add_points(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points);
  // A vertical bar from low to high at each point, which is marked too.
  void add_intervals(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points,
                     std::vector<double> half_heights);
  // 95 % ellipses. Those of a chart are enlarged alike by 1, 2, 5, 10 and so on until they can be seen; the
  // legend then says so.
  void add_ellipses(const std::string& name, Ink ink, std::vector<Ellipse> ellipses);
  // Names in the place of numbers along x, at 0, 1, 2 and so on.
  void name_x(std::vector<std::string> names) { x_names_ = std::move(names); }

  [[nodiscard]] std::string svg() const;

 private:
  struct Line {
    Ink ink;
    std::vector<Eigen::Vector2d> points;
    bool dashed;
  };
  struct Strokes {
    Ink ink;
    std::vector<std::pair<Eigen::Vector2d, Eigen::Vector2d>> strokes;
  };
  struct Marks {
    Ink ink;
    std::vector<Mark> marks;
  };
  struct Points {
    Ink ink;
    std::vector<Eigen::Vector2d> points;
  };
  struct Intervals {
    Ink ink;
    std::vector<Eigen::Vector2d> points;
    std::vector<double> half_heights;
  };
  struct Ellipses {
    Ink ink;
    std::vector<Ellipse> ellipses;
  };
  enum class Symbol { kLine, kDashes, kStroke, kMark, kPoint, kInterval, kEllipse };
  struct LegendEntry {
    Symbol symbol;
    Ink ink;
    std::string name;
  };
  struct Box;
  struct View;

  void add_to_legend(Symbol symbol, Ink ink, const std::string& name);
  // Ellipses are `enlarged` so many times.
  [[nodiscard]] Box extent(double enlarged) const;
  [[nodiscard]] View view(double enlarged) const;
  [[nodiscard]] double magnification(const View& view) const;

  Axes axes_;
  std::vector<Line> lines_;
  std::vector<Strokes> strokes_;
  std::vector<Marks> marks_;
  std::vector<Points> points_;
  std::vector<Intervals> intervals_;
  std::vector<Ellipses> ellipses_;
  std::vector<LegendEntry> legend_;
  std::vector<std::string> x_names_;
};

}  // namespace groma::report
