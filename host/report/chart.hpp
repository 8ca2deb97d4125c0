// Charts as SVG: a map in metres or one quantity over another, with axes, grid and legend. Colours come from
// the style sheet (page.hpp), so that a chart follows the reader's light or dark theme.
#pragma once

#include <optional>
#include <string>
#include <vector>

#include <Eigen/Core>

namespace groma::report {

// The role of an element, which determines its colour.
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

// The ink of the n-th of several equivalent series, from 0.
[[nodiscard]] Ink series_ink(std::size_t n);

struct Ellipse {
  Eigen::Vector2d center = Eigen::Vector2d::Zero();
  Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero();
};

struct Mark {
  Eigen::Vector2d at = Eigen::Vector2d::Zero();
  std::string label;   // drawn beside the mark; may be empty
  std::string hint{};  // tooltip
  std::string link{};  // id of the element on the page that a click leads to
};

class Chart {
 public:
  struct Axes {
    std::string title{};
    std::string x_label{};
    std::string y_label{};
    bool same_scale = false;  // a map: both axes have the same scale
    double width_px = 1040.0;
    double height_px = 320.0;  // upper bound for a map
    bool legend = true;
    std::optional<Eigen::Vector2d> y_range{};  // lower and upper end; none: fitted to the data
  };
  explicit Chart(Axes axes) : axes_(std::move(axes)) {}

  // All coordinates are in the axes' units. A name is listed once in the legend; an empty one is not listed.
  // Non-finite points are omitted; in a line they make a break.
  void add_line(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points, bool dashed = false);
  // Separate strokes, such as walls.
  void add_strokes(const std::string& name, Ink ink,
                   std::vector<std::pair<Eigen::Vector2d, Eigen::Vector2d>> strokes);
  void add_marks(const std::string& name, Ink ink, std::vector<Mark> marks);
  // Any number of dots: of those at the same pixel only the first is drawn.
  void add_points(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points);
  // A marked point with a vertical bar of half_heights above and below it.
  void add_intervals(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points,
                     std::vector<double> half_heights);
  // 95 % ellipses. All ellipses of a chart are enlarged by the same factor of 1, 2, 5, 10 and so on until
  // they are visible; the legend states a factor above 1.
  void add_ellipses(const std::string& name, Ink ink, std::vector<Ellipse> ellipses);
  // Names instead of numbers along x, at 0, 1, 2 and so on.
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
  // `enlarged`: the factor of the ellipses.
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
