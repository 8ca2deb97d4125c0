// Charts as HTML and SVG: a map in metres or one quantity over another, with axes, grid and legend. They keep
// their text size at any width, and are complete without a script; report.js adds hover and zoom. Colours
// come from the style sheet (report.css), so that a chart follows the reader's light or dark theme.
#pragma once

#include <optional>
#include <string>
#include <utility>
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

// kBroad lies visibly under another line of the same course.
enum class Stroke { kThin, kDashed, kBroad };

// kByInk: a triangle for an anchor's inks, else a dot.
enum class Shape { kByInk, kArrow, kStart, kEnd };

struct Ellipse {
  Eigen::Vector2d center = Eigen::Vector2d::Zero();
  Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero();
};

struct Mark {
  Eigen::Vector2d at = Eigen::Vector2d::Zero();
  std::string label;      // drawn beside the mark; may be empty
  std::string hint{};     // tooltip
  std::string link{};     // id of the element on the page that a click leads to
  double turn_rad = 0.0;  // direction of an arrow: from x to y
};

// An interval of x.
struct Span {
  double from = 0.0;
  double to = 0.0;
  std::string hint;  // tooltip
};

struct Bar {
  double x = 0.0;
  double value = 0.0;
  std::string hint;  // tooltip
};

class Chart {
 public:
  struct Axes {
    std::string title{};
    std::string x_label{};
    std::string y_label{};     // empty: y has no meaning, and no numbers
    bool same_scale = false;   // a map: both axes have the same scale
    bool log_y = false;        // values that are not positive are omitted; the axis has at most four decades
    bool over_time = false;    // charts over time are zoomed together
    double width_px = 1040.0;  // at most; text keeps its size where there is less room
    double height_px = 320.0;  // upper bound for a map
    bool legend = true;
    std::optional<Eigen::Vector2d> y_range{};  // lower and upper end; none: fitted to the data
  };
  explicit Chart(Axes axes) : axes_(std::move(axes)) {}

  // All coordinates are in the axes' units. A name is listed once in the legend for each ink; an empty one is
  // not listed. Non-finite points are omitted; in a line they make a break.
  void add_line(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points,
                Stroke stroke = Stroke::kThin);
  // A line on a map with the time of each point (x, y, t_s), which the reader sees under the pointer.
  void add_path(const std::string& name, Ink ink, const std::vector<Eigen::Vector3d>& points,
                Stroke stroke = Stroke::kThin);
  // Separate strokes, such as walls.
  void add_strokes(const std::string& name, Ink ink,
                   std::vector<std::pair<Eigen::Vector2d, Eigen::Vector2d>> strokes);
  void add_marks(const std::string& name, Ink ink, std::vector<Mark> marks, Shape shape = Shape::kByInk);
  // Any number of dots: of those at the same pixel only the first is drawn.
  void add_points(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points);
  // A marked point with a vertical bar of half_heights above and below it. Not for log_y.
  void add_intervals(const std::string& name, Ink ink, std::vector<Eigen::Vector2d> points,
                     std::vector<double> half_heights);
  // Bars from zero. Not for log_y.
  void add_bars(const std::string& name, Ink ink, std::vector<Bar> bars, double width);
  // Coloured over the whole height.
  void add_bands(const std::string& name, Ink ink, std::vector<Span> spans);
  // 95 % ellipses. All ellipses of a chart are enlarged by the same factor of 1, 2, 5, 10 and so on until
  // they are visible; the legend states a factor above 1.
  void add_ellipses(const std::string& name, Ink ink, std::vector<Ellipse> ellipses);
  // Names instead of numbers along x, at 0, 1, 2 and so on.
  void name_x(std::vector<std::string> names) { x_names_ = std::move(names); }

  [[nodiscard]] std::string html() const;

 private:
  struct Line {
    std::string name;
    Ink ink;
    std::vector<Eigen::Vector2d> points;
    std::vector<double> times_s;  // of each point; empty: none
    Stroke stroke;
  };
  struct Strokes {
    Ink ink;
    std::vector<std::pair<Eigen::Vector2d, Eigen::Vector2d>> strokes;
  };
  struct Marks {
    Ink ink;
    Shape shape;
    std::vector<Mark> marks;
  };
  struct Points {
    std::string name;
    Ink ink;
    std::vector<Eigen::Vector2d> points;
  };
  struct Intervals {
    Ink ink;
    std::vector<Eigen::Vector2d> points;
    std::vector<double> half_heights;
  };
  struct Bars {
    Ink ink;
    std::vector<Bar> bars;
    double width;
  };
  struct Bands {
    std::string name;
    Ink ink;
    std::vector<Span> spans;
  };
  struct Ellipses {
    Ink ink;
    std::vector<Ellipse> ellipses;
  };
  enum class Symbol {
    kLine,
    kDashes,
    kBroad,
    kStroke,
    kMark,
    kArrow,
    kStart,
    kEnd,
    kPoint,
    kInterval,
    kBand,
    kEllipse
  };
  struct LegendEntry {
    Symbol symbol;
    Ink ink;
    std::string name;
  };
  struct Box;
  struct View;
  struct Tick;

  void add_to_legend(Symbol symbol, Ink ink, const std::string& name);
  // Axes' units to those that are drawn: the logarithm of y where the axis is logarithmic.
  [[nodiscard]] Eigen::Vector2d placed(const Eigen::Vector2d& point) const;
  [[nodiscard]] std::vector<Eigen::Vector2d> placed(std::vector<Eigen::Vector2d> points) const;
  // `enlarged`: the factor of the ellipses.
  [[nodiscard]] Box extent(double enlarged) const;
  [[nodiscard]] View view(double enlarged) const;
  [[nodiscard]] double magnification(const View& view) const;
  [[nodiscard]] std::vector<Tick> x_ticks(const View& view) const;
  [[nodiscard]] std::vector<Tick> y_ticks(const View& view) const;

  void write_legend(std::string& text, double enlarged) const;
  void write_grid(std::string& text, const View& view) const;
  void write_shapes(std::string& text, const View& view, double enlarged) const;
  void write_marks(std::string& text, const View& view) const;
  [[nodiscard]] std::vector<std::pair<Eigen::Vector2d, std::string>> labels_of(
      const std::vector<const Mark*>& marks, const View& view) const;

  Axes axes_;
  // In units that are drawn.
  std::vector<Line> lines_;
  std::vector<Strokes> strokes_;
  std::vector<Marks> marks_;
  std::vector<Points> points_;
  std::vector<Intervals> intervals_;
  std::vector<Bars> bars_;
  std::vector<Bands> bands_;
  std::vector<Ellipses> ellipses_;
  std::vector<LegendEntry> legend_;
  std::vector<std::string> x_names_;
};

}  // namespace groma::report
