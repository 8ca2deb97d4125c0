#include "host/report/chart.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <map>
#include <numbers>
#include <set>
#include <string_view>
#include <utility>

#include <Eigen/Eigenvalues>

#include "host/model/median.hpp"
#include "host/report/html.hpp"
#include "host/report/labels.hpp"
#include "host/report/samples.hpp"
#include "host/report/series.hpp"

namespace groma::report {

namespace {

using Eigen::Vector2d;
using Output = std::back_insert_iterator<std::string>;

// Room for the numbers along y, and at the right: as in report.css.
constexpr double kAside_px = 66.0;
constexpr double kMostDecades = 4.0;
// Samples for the script are thinned to this part of a pixel at full view.
constexpr double kFine_px = 1.0 / 16.0;

std::string_view css_class(Ink ink) {
  constexpr std::array<std::string_view, 13> kClasses{
      "truth", "estimate", "path", "other", "wall", "anchor", "warn", "bad", "good", "s1", "s2", "s3", "s4"};
  return kClasses.at(static_cast<std::size_t>(ink));
}

std::string_view css_class(Stroke stroke) {
  constexpr std::array<std::string_view, 3> kClasses{"", " dashed", " broad"};
  return kClasses.at(static_cast<std::size_t>(stroke));
}

bool finite(const Vector2d& point) {
  return std::isfinite(point.x()) && std::isfinite(point.y());
}

// 1, 2 or 5 times a power of ten, such that about `wanted` steps fit into the span.
double nice_step(double span, double wanted) {
  const double raw = span / wanted;
  const double power = std::pow(10.0, std::floor(std::log10(raw)));
  for (const double factor : {1.0, 2.0, 5.0}) {
    if (raw <= factor * power * 1.0001) return factor * power;
  }
  return 10.0 * power;
}

std::string tick_text(double value, double step) {
  const int digits = std::max(0, static_cast<int>(std::ceil(-std::log10(step) - 1e-9)));
  const std::string text = fmt::format("{:.{}f}", value, digits);
  // "0", not "-0".
  return text.find_first_of("123456789") == std::string::npos && text.front() == '-' ? text.substr(1) : text;
}

}  // namespace

Ink series_ink(std::size_t n) {
  constexpr std::array kInks{Ink::kSeries1, Ink::kSeries2, Ink::kSeries3, Ink::kSeries4};
  return kInks.at(n % kInks.size());
}

// The part of the plane that is drawn.
struct Chart::Box {
  Vector2d low = Vector2d::Constant(std::numeric_limits<double>::infinity());
  Vector2d high = Vector2d::Constant(-std::numeric_limits<double>::infinity());

  void include(const Vector2d& point) {
    if (!finite(point)) return;
    low = low.cwiseMin(point);
    high = high.cwiseMax(point);
  }
};

// The mapping from what is drawn to pixels, at the full width.
struct Chart::View {
  Box box;
  Vector2d size_px = Vector2d::Ones();

  [[nodiscard]] Vector2d scale() const { return size_px.cwiseQuotient(box.high - box.low); }
  [[nodiscard]] Vector2d operator()(const Vector2d& point) const {
    const Vector2d from_corner = (point - box.low).cwiseProduct(scale());
    return {from_corner.x(), size_px.y() - from_corner.y()};
  }
  // Shares of the area, %.
  [[nodiscard]] Vector2d percent(const Vector2d& point) const {
    return 100.0 * (*this)(point).cwiseQuotient(size_px);
  }
};

struct Chart::Tick {
  double at = 0.0;    // as drawn
  std::string text;   // empty: a line of the grid without a number
  bool fine = false;  // omitted where the chart is narrow
};

void Chart::add_to_legend(Symbol symbol, Ink ink, const std::string& name) {
  const bool known = std::any_of(legend_.begin(), legend_.end(), [&](const LegendEntry& entry) {
    return entry.name == name && entry.ink == ink;
  });
  if (!name.empty() && !known) legend_.push_back({symbol, ink, name});
}

Vector2d Chart::placed(const Vector2d& point) const {
  if (!axes_.log_y) return point;
  return {point.x(), point.y() > 0.0 ? std::log10(point.y()) : kNone};
}

std::vector<Vector2d> Chart::placed(std::vector<Vector2d> points) const {
  for (Vector2d& point : points) point = placed(point);
  return points;
}

void Chart::add_line(const std::string& name, Ink ink, std::vector<Vector2d> points, Stroke stroke) {
  constexpr std::array kSymbols{Symbol::kLine, Symbol::kDashes, Symbol::kBroad};
  add_to_legend(kSymbols.at(static_cast<std::size_t>(stroke)), ink, name);
  lines_.push_back({name, ink, placed(std::move(points)), {}, stroke});
}

void Chart::add_path(const std::string& name, Ink ink, const std::vector<Eigen::Vector3d>& points,
                     Stroke stroke) {
  std::vector<Vector2d> places;
  std::vector<double> times_s;
  places.reserve(points.size());
  times_s.reserve(points.size());
  for (const Eigen::Vector3d& point : points) {
    places.emplace_back(point.head<2>());
    times_s.push_back(point.z());
  }
  add_line(name, ink, std::move(places), stroke);
  lines_.back().times_s = std::move(times_s);
}

void Chart::add_strokes(const std::string& name, Ink ink,
                        std::vector<std::pair<Vector2d, Vector2d>> strokes) {
  add_to_legend(Symbol::kStroke, ink, name);
  strokes_.push_back({ink, std::move(strokes)});
}

void Chart::add_marks(const std::string& name, Ink ink, std::vector<Mark> marks, Shape shape) {
  constexpr std::array kSymbols{Symbol::kMark, Symbol::kArrow, Symbol::kStart, Symbol::kEnd};
  add_to_legend(kSymbols.at(static_cast<std::size_t>(shape)), ink, name);
  for (Mark& mark : marks) mark.at = placed(mark.at);
  marks_.push_back({ink, shape, std::move(marks)});
}

void Chart::add_points(const std::string& name, Ink ink, std::vector<Vector2d> points) {
  add_to_legend(Symbol::kPoint, ink, name);
  points_.push_back({name, ink, placed(std::move(points))});
}

void Chart::add_intervals(const std::string& name, Ink ink, std::vector<Vector2d> points,
                          std::vector<double> half_heights) {
  add_to_legend(Symbol::kInterval, ink, name);
  intervals_.push_back({ink, std::move(points), std::move(half_heights)});
}

void Chart::add_bars(const std::string& name, Ink ink, std::vector<Bar> bars, double width) {
  add_to_legend(Symbol::kBand, ink, name);
  bars_.push_back({ink, std::move(bars), width});
}

void Chart::add_bands(const std::string& name, Ink ink, std::vector<Span> spans) {
  add_to_legend(Symbol::kBand, ink, name);
  bands_.push_back({name, ink, std::move(spans)});
}

void Chart::add_ellipses(const std::string& name, Ink ink, std::vector<Ellipse> ellipses) {
  add_to_legend(Symbol::kEllipse, ink, name);
  ellipses_.push_back({ink, std::move(ellipses)});
}

Chart::Box Chart::extent(double enlarged) const {
  Box box;
  for (const Line& line : lines_) {
    for (const Vector2d& point : line.points) box.include(point);
  }
  for (const Strokes& strokes : strokes_) {
    for (const auto& [from, to] : strokes.strokes) {
      box.include(from);
      box.include(to);
    }
  }
  for (const Marks& marks : marks_) {
    for (const Mark& mark : marks.marks) box.include(mark.at);
  }
  for (const Points& points : points_) {
    for (const Vector2d& point : points.points) box.include(point);
  }
  for (const Intervals& intervals : intervals_) {
    for (std::size_t i = 0; i < intervals.points.size(); ++i) {
      box.include(intervals.points[i] + Vector2d(0.0, intervals.half_heights[i]));
      box.include(intervals.points[i] - Vector2d(0.0, intervals.half_heights[i]));
    }
  }
  for (const Bars& bars : bars_) {
    for (const Bar& bar : bars.bars) {
      box.include({bar.x, 0.0});
      box.include({bar.x, bar.value});
    }
  }
  for (const Ellipses& ellipses : ellipses_) {
    for (const Ellipse& ellipse : ellipses.ellipses) box.include(ellipse.center);
  }
  // Ellipses count up to a limit, so that a large one does not shrink everything else.
  const Box points = box;
  for (const Ellipses& ellipses : ellipses_) {
    for (const Ellipse& ellipse : ellipses.ellipses) {
      const Vector2d reach = enlarged * (kChiSquare95 * ellipse.covariance.diagonal()).cwiseSqrt();
      const Vector2d most = 0.2 * (points.high - points.low);
      if (!finite(reach)) continue;
      box.include(ellipse.center - reach.cwiseMin(most));
      box.include(ellipse.center + reach.cwiseMin(most));
    }
  }
  // A chart of bands alone has no other y.
  const double y = std::isfinite(box.low.y()) ? box.low.y() : 0.0;
  for (const Bands& bands : bands_) {
    for (const Span& span : bands.spans) {
      box.include({span.from, y});
      box.include({span.to, y});
    }
  }
  if (!x_names_.empty()) {
    box.include({-0.6, y});
    box.include({static_cast<double>(x_names_.size()) - 0.4, y});
  }
  if (!finite(box.low) || !finite(box.high)) box = {Vector2d::Zero(), Vector2d::Ones()};
  if (axes_.y_range) {
    box.low.y() = placed(Vector2d(0.0, axes_.y_range->x())).y();
    box.high.y() = placed(Vector2d(0.0, axes_.y_range->y())).y();
  }
  if (axes_.log_y) box.low.y() = std::max(box.low.y(), box.high.y() - kMostDecades);
  Vector2d span = box.high - box.low;
  for (double& of : span) {
    const double size = 1.0 + box.high.cwiseAbs().maxCoeff();
    if (of < 1e-9 * size) of = 1e-2 * size;
  }
  const bool margins_of_x = x_names_.empty() && axes_.same_scale;
  const Vector2d margin(margins_of_x ? 0.05 * span.x() : 0.0, axes_.y_range ? 0.0 : 0.06 * span.y());
  return {box.low - margin, box.low + span + margin};
}

Chart::View Chart::view(double enlarged) const {
  View view{extent(enlarged), {axes_.width_px - kAside_px, axes_.height_px}};
  if (axes_.same_scale) {
    const Vector2d span = view.box.high - view.box.low;
    const double per_metre = view.size_px.cwiseQuotient(span).minCoeff();
    view.size_px.y() = std::clamp(per_metre * span.y(), std::min(160.0, axes_.height_px), axes_.height_px);
    // Extend the shorter axis to fill the area.
    const Vector2d wanted = view.size_px / per_metre;
    const Vector2d middle = 0.5 * (view.box.low + view.box.high);
    view.box = {middle - 0.5 * wanted, middle + 0.5 * wanted};
  }
  return view;
}

double Chart::magnification(const View& view) const {
  std::vector<double> sizes_px;
  for (const Ellipses& ellipses : ellipses_) {
    for (const Ellipse& ellipse : ellipses.ellipses) {
      const double trace = ellipse.covariance.trace();
      if (std::isfinite(trace) && trace > 0.0) {
        sizes_px.push_back(std::sqrt(kChiSquare95 * 0.5 * trace) * view.scale().mean());
      }
    }
  }
  if (sizes_px.empty()) return 1.0;
  constexpr double kVisible_px = 7.0;
  const double median_px = model::median(sizes_px);
  const double most = 0.15 * view.size_px.x() / *std::max_element(sizes_px.begin(), sizes_px.end());
  double chosen = 1.0;
  for (const double factor : {2.0, 5.0, 10.0, 20.0, 50.0, 100.0}) {
    if (median_px * chosen < kVisible_px && factor <= most) chosen = factor;
  }
  return chosen;
}

std::vector<Chart::Tick> Chart::x_ticks(const View& view) const {
  std::vector<Tick> ticks;
  for (std::size_t i = 0; i < x_names_.size(); ++i) ticks.push_back({static_cast<double>(i), x_names_[i]});
  if (!x_names_.empty()) return ticks;
  const double low = view.box.low.x();
  const double span = view.box.high.x() - low;
  const double step = nice_step(span, view.size_px.x() / 65.0);
  // At 640 px and less, where small charts are as wide as large ones.
  const double coarse = nice_step(span, std::min(view.size_px.x(), 280.0) / 65.0);
  for (double i = std::ceil(low / step); i * step <= low + span * (1.0 + 1e-9); ++i) {
    const double off = std::abs(std::remainder(i * step, coarse));
    ticks.push_back({i * step, tick_text(i * step, step), off > 1e-6 * coarse});
  }
  return ticks;
}

std::vector<Chart::Tick> Chart::y_ticks(const View& view) const {
  std::vector<Tick> ticks;
  if (axes_.y_label.empty()) return ticks;
  const double low = view.box.low.y();
  const double span = view.box.high.y() - low;
  const double wanted = view.size_px.y() / 45.0;
  if (!axes_.log_y) {
    const double step = axes_.same_scale ? nice_step(span, view.size_px.y() / 75.0) : nice_step(span, wanted);
    for (double i = std::ceil(low / step); i * step <= low + span * (1.0 + 1e-9); ++i)
      ticks.push_back({i * step, tick_text(i * step, step)});
    return ticks;
  }
  for (double decade = std::floor(low); decade <= low + span; ++decade) {
    for (int times = 1; times <= 9; ++times) {
      const double at = decade + std::log10(times);
      if (at < low || at > low + span) continue;
      const bool has_number = times == 1 || (span < 2.0 && (times == 2 || times == 5));
      const double power = std::pow(10.0, decade);
      ticks.push_back({at, has_number ? tick_text(times * power, power) : ""});
    }
  }
  return ticks;
}

namespace {

// Indices of the points that are drawn: a point closer than `least_px` to the last drawn one only enlarges
// the file. Non-finite points make a break, the ends of a piece are kept.
std::vector<std::size_t> thinned(const std::vector<Vector2d>& points_px, double least_px) {
  std::vector<std::size_t> kept;
  bool pen_down = false;
  Vector2d last = Vector2d::Zero();
  for (std::size_t i = 0; i < points_px.size(); ++i) {
    const Vector2d& point = points_px[i];
    if (!finite(point)) {
      if (pen_down) kept.push_back(i);
      pen_down = false;
      continue;
    }
    const bool ends = i + 1 == points_px.size() || !finite(points_px[i + 1]);
    if (pen_down && !ends && (point - last).squaredNorm() < least_px * least_px) continue;
    kept.push_back(i);
    pen_down = true;
    last = point;
  }
  return kept;
}

// Of the points within one square of `spot_px` only the first is kept.
std::vector<std::size_t> distinct(const std::vector<Vector2d>& points_px, double spot_px) {
  std::set<std::pair<long, long>> seen;
  std::vector<std::size_t> kept;
  for (std::size_t i = 0; i < points_px.size(); ++i) {
    const Vector2d& point = points_px[i];
    if (!finite(point) || point.cwiseAbs().maxCoeff() > 1e5) continue;
    if (seen.insert(
                {std::lround(std::floor(point.x() / spot_px)), std::lround(std::floor(point.y() / spot_px))})
            .second)
      kept.push_back(i);
  }
  return kept;
}

std::string path_of(const std::vector<Vector2d>& points_px, const std::vector<std::size_t>& kept) {
  std::string path;
  bool pen_down = false;
  for (const std::size_t i : kept) {
    const Vector2d& point = points_px[i];
    if (finite(point)) path += fmt::format("{}{:.1f} {:.1f}", pen_down ? "L" : "M", point.x(), point.y());
    pen_down = finite(point);
  }
  return path;
}

void draw_ellipse(Output out, const Vector2d& at, const Eigen::Matrix2d& covariance_px,
                  std::string_view css) {
  const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen(covariance_px);
  const Vector2d radii = (kChiSquare95 * eigen.eigenvalues().cwiseMax(0.0)).cwiseSqrt().cwiseMax(0.8);
  const Vector2d axis = eigen.eigenvectors().col(1);
  const double turn_deg = std::atan2(axis.y(), axis.x()) * 180.0 / std::numbers::pi;
  fmt::format_to(out,
                 "<ellipse class=\"ellipse {}\" rx=\"{:.1f}\" ry=\"{:.1f}\" "
                 "transform=\"translate({:.1f} {:.1f}) rotate({:.1f})\"/>\n",
                 css, radii.y(), radii.x(), at.x(), at.y(), turn_deg);
}

std::string symbol_of(std::string_view css, Shape shape, double turn_rad) {
  switch (shape) {
    case Shape::kArrow:
      return fmt::format("<path class=\"mark {}\" d=\"M9 0L-6 -6L-3 0L-6 6z\" transform=\"rotate({:.0f})\"/>",
                         css, -turn_rad * 180.0 / std::numbers::pi);
    case Shape::kStart:
      return fmt::format("<circle class=\"mark {} start\" r=\"6\"/>", css);
    case Shape::kEnd:
      return fmt::format("<rect class=\"mark {}\" x=\"-5\" y=\"-5\" width=\"10\" height=\"10\"/>", css);
    case Shape::kByInk:
      break;
  }
  if (css == "anchor" || css == "warn" || css == "bad")
    return fmt::format("<path class=\"mark {}\" d=\"M0 -6l5.2 9h-10.4z\"/>", css);
  return fmt::format("<circle class=\"mark {}\" r=\"3.4\"/>", css);
}

// The least widths of the area at which a chart of the page's width is drawn, each with the class of its
// labels in report.css: screens of 360, 480, 640 and 900 px, less what is around the area.
struct Layout {
  std::string_view css;
  double width_px = 0.0;
};
constexpr std::array kLayouts{Layout{"w360", 256.0}, Layout{"w480", 376.0}, Layout{"w640", 509.0},
                              Layout{"w900", 768.0}};
// Smaller charts are beside one another, where there is room; they have one layout.
constexpr double kLargest_px = 640.0;

// A label and the line to its mark.
std::string label_of(const std::string& text, const LabelPlace& place) {
  std::string lead;
  if (!place.lead_px.isZero())
    lead =
        fmt::format("<path class=\"lead\" d=\"M0 0L{:.1f} {:.1f}\"/>", place.lead_px.x(), place.lead_px.y());
  return fmt::format("{}<text class=\"label\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>", lead, place.text_px.x(),
                     place.text_px.y(), escaped(text));
}

}  // namespace

void Chart::write_legend(std::string& text, double enlarged) const {
  if (!axes_.legend || legend_.empty()) return;
  const Output out(text);
  text += "<ul class=\"legend\">\n";
  for (const LegendEntry& entry : legend_) {
    const std::string_view css = css_class(entry.ink);
    text += "<li><svg class=\"key\" viewBox=\"-12 -7 24 14\" width=\"24\" height=\"14\">";
    switch (entry.symbol) {
      case Symbol::kLine:
        fmt::format_to(out, "<path class=\"line {}\" d=\"M-11 0h22\"/>", css);
        break;
      case Symbol::kDashes:
        fmt::format_to(out, "<path class=\"line {} dashed\" d=\"M-11 0h22\"/>", css);
        break;
      case Symbol::kBroad:
        fmt::format_to(out, "<path class=\"line {} broad\" d=\"M-11 0h22\"/>", css);
        break;
      case Symbol::kStroke:
        fmt::format_to(out, "<path class=\"stroke {}\" d=\"M-10 0h20\"/>", css);
        break;
      case Symbol::kMark:
        text += symbol_of(css, Shape::kByInk, 0.0);
        break;
      case Symbol::kArrow:
        text += symbol_of(css, Shape::kArrow, 0.0);
        break;
      case Symbol::kStart:
        text += symbol_of(css, Shape::kStart, 0.0);
        break;
      case Symbol::kEnd:
        text += symbol_of(css, Shape::kEnd, 0.0);
        break;
      case Symbol::kPoint:
        fmt::format_to(out, "<circle class=\"mark {}\" r=\"3\"/>", css);
        break;
      case Symbol::kInterval:
        fmt::format_to(out, "<path class=\"interval {}\" d=\"M0 -6v12\"/>", css);
        text += symbol_of(css, Shape::kByInk, 0.0);
        break;
      case Symbol::kBand:
        fmt::format_to(out, "<rect class=\"band {}\" x=\"-10\" y=\"-6\" width=\"20\" height=\"12\"/>", css);
        break;
      case Symbol::kEllipse:
        fmt::format_to(out, "<ellipse class=\"ellipse {}\" rx=\"10\" ry=\"5.5\"/>", css);
        break;
    }
    const bool larger = entry.symbol == Symbol::kEllipse && enlarged > 1.0;
    fmt::format_to(out, "</svg>{}{}</li>\n", escaped(entry.name),
                   larger ? fmt::format(" (× {:.0f})", enlarged) : "");
  }
  text += "</ul>\n";
}

void Chart::write_grid(std::string& text, const View& view) const {
  const Output out(text);
  text += "<g class=\"grid\">";
  const Vector2d& low = view.box.low;
  if (x_names_.empty()) {
    for (const Tick& tick : x_ticks(view)) {
      fmt::format_to(out, "<line x1=\"{0:.2f}%\" x2=\"{0:.2f}%\" y1=\"0\" y2=\"100%\"/>",
                     view.percent({tick.at, low.y()}).x());
    }
  }
  for (const Tick& tick : y_ticks(view)) {
    const bool zero = !axes_.same_scale && !axes_.log_y && tick.at == 0.0;
    fmt::format_to(out, "<line{1} x1=\"0\" x2=\"100%\" y1=\"{0:.2f}%\" y2=\"{0:.2f}%\"/>",
                   view.percent({low.x(), tick.at}).y(),
                   zero                ? " class=\"zero\""
                   : tick.text.empty() ? " class=\"minor\""
                                       : "");
  }
  text += "</g>\n";
}

void Chart::write_shapes(std::string& text, const View& view, double enlarged) const {
  const Output out(text);
  const auto in_pixels = [&](const std::vector<Vector2d>& points) {
    std::vector<Vector2d> points_px;
    points_px.reserve(points.size());
    for (const Vector2d& point : points) points_px.push_back(view(point));
    return points_px;
  };
  // Attributes with the samples for the script. A far outlier is clamped, so that it costs no resolution: it
  // is out of view at any zoom.
  const auto samples = [&](const std::string& name, const std::vector<Vector2d>& points,
                           const std::vector<double>& times_s, const std::vector<std::size_t>& kept) {
    const Vector2d reach = 4.0 * (view.box.high - view.box.low);
    std::vector<std::vector<double>> columns(times_s.empty() ? 2 : 3);
    std::vector<Bounds> bounds(
        columns.size(), {std::numeric_limits<double>::infinity(), -std::numeric_limits<double>::infinity()});
    for (const std::size_t i : kept) {
      const Vector2d point = points[i].cwiseMax(view.box.low - reach).cwiseMin(view.box.high + reach);
      const bool is_break = !finite(points[i]);
      columns[0].push_back(is_break ? kNone : point.x());
      columns[1].push_back(is_break ? kNone : point.y());
      if (!times_s.empty()) columns[2].push_back(times_s[i]);
    }
    std::string ends;
    for (std::size_t k = 0; k < columns.size(); ++k) {
      for (const double value : columns[k]) {
        if (!std::isfinite(value)) continue;
        bounds[k] = {std::min(bounds[k].low, value), std::max(bounds[k].high, value)};
      }
      if (!(bounds[k].low <= bounds[k].high)) bounds[k] = {};
      ends += fmt::format("{}{:.9g} {:.9g}", k > 0 ? " " : "", bounds[k].low, bounds[k].high);
    }
    return fmt::format("data-n=\"{}\" data-b=\"{}\" data-p=\"{}\"", escaped(name), ends,
                       encode_samples(columns, bounds));
  };

  for (const Bands& bands : bands_) {
    for (const Span& span : bands.spans) {
      const double left = view({span.from, 0.0}).x();
      fmt::format_to(out,
                     "<rect class=\"band {}\" x=\"{:.2f}\" y=\"0\" width=\"{:.2f}\" height=\"{:.0f}\" "
                     "data-n=\"{}\" data-hint=\"{}\"><title>{}</title></rect>\n",
                     css_class(bands.ink), left, std::max(view({span.to, 0.0}).x() - left, 2.0),
                     view.size_px.y(), escaped(bands.name), escaped(span.hint), escaped(span.hint));
    }
  }
  for (const Bars& bars : bars_) {
    for (const Bar& bar : bars.bars) {
      if (!std::isfinite(bar.value)) continue;
      const Vector2d from = view({bar.x - 0.5 * bars.width, std::max(bar.value, 0.0)});
      const Vector2d to = view({bar.x + 0.5 * bars.width, std::min(bar.value, 0.0)});
      fmt::format_to(out,
                     "<rect class=\"bar {}\" x=\"{:.2f}\" y=\"{:.2f}\" width=\"{:.2f}\" height=\"{:.2f}\" "
                     "data-hint=\"{}\"><title>{}</title></rect>\n",
                     css_class(bars.ink), from.x(), from.y(), to.x() - from.x(), to.y() - from.y(),
                     escaped(bar.hint), escaped(bar.hint));
    }
  }
  for (const Strokes& strokes : strokes_) {
    std::string path;
    for (const auto& [from, to] : strokes.strokes) {
      const Vector2d a = view(from);
      const Vector2d b = view(to);
      if (finite(a) && finite(b))
        path += fmt::format("M{:.1f} {:.1f}L{:.1f} {:.1f}", a.x(), a.y(), b.x(), b.y());
    }
    if (!path.empty())
      fmt::format_to(out, "<path class=\"stroke {}\" d=\"{}\"/>\n", css_class(strokes.ink), path);
  }
  // All dots of one ink are one path of zero-length strokes; their round caps are the dots.
  for (const Points& points : points_) {
    const std::vector<Vector2d> points_px = in_pixels(points.points);
    std::string path;
    constexpr double kSpot_px = 2.0;
    for (const std::size_t i : distinct(points_px, kSpot_px))
      path += fmt::format("M{:.0f} {:.0f}h0", points_px[i].x(), points_px[i].y());
    if (path.empty()) continue;
    fmt::format_to(out, "<path class=\"points {}\" {} d=\"{}\"/>\n", css_class(points.ink),
                   samples(points.name, points.points, {}, distinct(points_px, 0.25 * kSpot_px)), path);
  }
  for (const Line& line : lines_) {
    const std::vector<Vector2d> points_px = in_pixels(line.points);
    constexpr double kLeast_px = 0.5;
    const std::string path = path_of(points_px, thinned(points_px, kLeast_px));
    if (path.empty()) continue;
    fmt::format_to(out, "<path class=\"line {}{}\" {} d=\"{}\"/>\n", css_class(line.ink),
                   css_class(line.stroke),
                   samples(line.name, line.points, line.times_s, thinned(points_px, kFine_px)), path);
  }
  const Vector2d scale = enlarged * Vector2d(view.scale().x(), -view.scale().y());
  for (const Ellipses& ellipses : ellipses_) {
    for (const Ellipse& ellipse : ellipses.ellipses) {
      const Eigen::Matrix2d covariance_px = scale.asDiagonal() * ellipse.covariance * scale.asDiagonal();
      if (finite(ellipse.center) && covariance_px.array().isFinite().all()) {
        draw_ellipse(out, view(ellipse.center), covariance_px, css_class(ellipses.ink));
      }
    }
  }
  for (const Intervals& intervals : intervals_) {
    for (std::size_t i = 0; i < intervals.points.size(); ++i) {
      const Vector2d low = view(intervals.points[i] - Vector2d(0.0, intervals.half_heights[i]));
      const Vector2d high = view(intervals.points[i] + Vector2d(0.0, intervals.half_heights[i]));
      if (!finite(low) || !finite(high)) continue;
      fmt::format_to(out, "<path class=\"interval {}\" d=\"M{:.1f} {:.1f}V{:.1f}\"/>\n",
                     css_class(intervals.ink), low.x(), low.y(), high.y());
    }
  }
}

void Chart::write_marks(std::string& text, const View& view) const {
  const Output out(text);
  // Labels may reach beyond the axes, marks may not be there.
  const auto is_seen = [&](const Vector2d& at) {
    return finite(at) && (at.array() >= view.box.low.array()).all() &&
           (at.array() <= view.box.high.array()).all();
  };
  // A nested element keeps its size, and its place by percentages, at any width.
  const auto begin_at = [&](const Vector2d& at) {
    const Vector2d share = view.percent(at);
    fmt::format_to(out, "<svg class=\"at\" x=\"{:.2f}%\" y=\"{:.2f}%\" data-at=\"{:.9g} {:.9g}\">", share.x(),
                   share.y(), at.x(), at.y());
  };
  std::vector<const Mark*> seen;
  text += "<g class=\"marks\">\n";
  for (const Intervals& intervals : intervals_) {
    for (std::size_t i = 0; i < intervals.points.size(); ++i) {
      if (!is_seen(intervals.points[i])) continue;
      const std::string hint =
          fmt::format("{:.4g} ± {:.2g}", intervals.points[i].y(), intervals.half_heights[i]);
      begin_at(intervals.points[i]);
      fmt::format_to(out, "<g data-hint=\"{0}\"><title>{0}</title>{1}</g></svg>\n", hint,
                     symbol_of(css_class(intervals.ink), Shape::kByInk, 0.0));
    }
  }
  for (const Marks& marks : marks_) {
    for (const Mark& mark : marks.marks) {
      if (!is_seen(mark.at)) continue;
      begin_at(mark.at);
      if (!mark.link.empty()) fmt::format_to(out, "<a href=\"#{}\">", escaped(mark.link));
      if (mark.hint.empty()) {
        text += "<g>";
      } else {
        fmt::format_to(out, "<g data-hint=\"{0}\"><title>{0}</title>", escaped(mark.hint));
      }
      text += symbol_of(css_class(marks.ink), marks.shape, mark.turn_rad);
      fmt::format_to(out, "</g>{}</svg>\n", mark.link.empty() ? "" : "</a>");
      seen.push_back(&mark);
    }
  }
  for (const auto& [at, label] : labels_of(seen, view)) {
    begin_at(at);
    text += label + "</svg>\n";
  }
  text += "</g>\n";
}

// Of each label its mark's place and the label itself: once, or once for each place that it has in the
// layouts.
std::vector<std::pair<Vector2d, std::string>> Chart::labels_of(const std::vector<const Mark*>& marks,
                                                               const View& view) const {
  const auto placed_in = [&](double width_px) {
    // A map shrinks as a whole, another chart keeps its height.
    const double share = width_px / view.size_px.x();
    const Vector2d shares(share, axes_.same_scale ? share : 1.0);
    std::vector<Label> labels;
    std::vector<Vector2d> marks_px;
    for (const Mark* mark : marks) {
      marks_px.emplace_back(view(mark->at).cwiseProduct(shares));
      if (!mark->label.empty()) labels.push_back({marks_px.back(), mark->label});
    }
    return place_labels(labels, marks_px, view.size_px.cwiseProduct(shares));
  };
  std::vector<std::pair<Vector2d, std::string>> out;
  const auto add = [&](const auto& text_of) {
    std::size_t i = 0;
    for (const Mark* mark : marks)
      if (!mark->label.empty()) out.emplace_back(mark->at, text_of(mark->label, i++));
  };
  if (axes_.width_px < kLargest_px) {
    const std::vector<LabelPlace> places = placed_in(view.size_px.x());
    add([&](const std::string& text, std::size_t i) { return label_of(text, places[i]); });
    return out;
  }
  std::vector<std::vector<LabelPlace>> places;
  places.reserve(kLayouts.size());
  for (const Layout& layout : kLayouts) places.push_back(placed_in(layout.width_px));
  add([&](const std::string& text, std::size_t i) {
    std::map<std::string, std::string> css_of;  // by label
    for (std::size_t k = 0; k < kLayouts.size(); ++k) {
      std::string& css = css_of[label_of(text, places[k][i])];
      css += (css.empty() ? "" : " ") + std::string(kLayouts[k].css);
    }
    std::string all;
    for (const auto& [label, css] : css_of) all += fmt::format("<g class=\"{}\">{}</g>", css, label);
    return all;
  });
  return out;
}

std::string Chart::html() const {
  const double enlarged = magnification(view(0.0));
  const View view = this->view(enlarged);
  const Box& box = view.box;
  std::string text;
  const Output out(text);
  fmt::format_to(out,
                 "<div class=\"chart\" data-box=\"{:.9g} {:.9g} {:.9g} {:.9g}\" data-size=\"{:.0f} {:.0f}\"",
                 box.low.x(), box.high.x(), box.low.y(), box.high.y(), view.size_px.x(), view.size_px.y());
  for (const auto& [is, name] : {std::pair{axes_.same_scale, "map"},
                                 {axes_.log_y, "log"},
                                 {axes_.over_time, "time"},
                                 {!x_names_.empty(), "named"}}) {
    if (is) fmt::format_to(out, " data-{}", name);
  }
  fmt::format_to(out, " data-labels=\"{}|{}\">\n", escaped(axes_.x_label), escaped(axes_.y_label));
  if (!axes_.title.empty()) fmt::format_to(out, "<h3>{}</h3>\n", escaped(axes_.title));
  write_legend(text, enlarged);
  fmt::format_to(out, "<div class=\"y-label\">{}</div>\n", escaped(axes_.y_label));
  const std::string size = axes_.same_scale
                               ? fmt::format("aspect-ratio:{:.0f}/{:.0f}", view.size_px.x(), view.size_px.y())
                               : fmt::format("height:{:.0f}px", view.size_px.y());
  fmt::format_to(out, "<div class=\"plot\" style=\"{}\">\n", size);
  fmt::format_to(out, "<svg class=\"area\" role=\"img\" aria-label=\"{}\">\n",
                 escaped(axes_.title.empty() ? axes_.y_label : axes_.title));
  write_grid(text, view);
  fmt::format_to(out, "<svg class=\"data\" viewBox=\"0 0 {:.0f} {:.0f}\" preserveAspectRatio=\"none\">\n",
                 view.size_px.x(), view.size_px.y());
  write_shapes(text, view, enlarged);
  text += "</svg>\n";
  write_marks(text, view);
  text += "</svg>\n<div class=\"ticks\">";
  for (const Tick& tick : x_ticks(view)) {
    fmt::format_to(out, "<i class=\"x{}\" style=\"left:{:.2f}%\">{}</i>", tick.fine ? " fine" : "",
                   view.percent({tick.at, box.low.y()}).x(), escaped(tick.text));
  }
  for (const Tick& tick : y_ticks(view)) {
    if (tick.text.empty()) continue;
    fmt::format_to(out, "<i class=\"y\" style=\"top:{:.2f}%\">{}</i>",
                   view.percent({box.low.x(), tick.at}).y(), tick.text);
  }
  fmt::format_to(out, "</div>\n</div>\n<div class=\"x-label\">{}</div>\n</div>\n", escaped(axes_.x_label));
  return text;
}

}  // namespace groma::report
