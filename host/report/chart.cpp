#include "host/report/chart.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <limits>
#include <numbers>
#include <set>
#include <utility>

#include <Eigen/Eigenvalues>

#include "host/report/html.hpp"

namespace groma::report {

namespace {

using Eigen::Vector2d;
using Output = std::back_insert_iterator<std::string>;

constexpr double kLeft_px = 58.0;
constexpr double kRight_px = 14.0;
constexpr double kBottom_px = 44.0;
constexpr double kLegendLine_px = 22.0;
constexpr double kTitle_px = 24.0;
constexpr double kCharacter_px = 6.6;   // mean width at 12 px, for the layout of texts
constexpr double kChiSquare95 = 5.991;  // 2 degrees of freedom

std::string_view css_class(Ink ink) {
  constexpr std::array<std::string_view, 13> kClasses{
      "truth", "estimate", "path", "other", "wall", "anchor", "warn", "bad", "good", "s1", "s2", "s3", "s4"};
  return kClasses.at(static_cast<std::size_t>(ink));
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

struct Rectangle {
  double left, top, right, bottom;
  [[nodiscard]] double overlap(const Rectangle& other) const {
    const double width = std::min(right, other.right) - std::max(left, other.left);
    const double height = std::min(bottom, other.bottom) - std::max(top, other.top);
    return width > 0.0 && height > 0.0 ? width * height : 0.0;
  }
};

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

// The mapping from axes to pixels.
struct Chart::View {
  Box box;
  Rectangle frame{};  // of the axes
  double width_px = 0.0;
  double height_px = 0.0;

  [[nodiscard]] Vector2d scale() const {
    return {(frame.right - frame.left) / (box.high.x() - box.low.x()),
            (frame.bottom - frame.top) / (box.high.y() - box.low.y())};
  }
  [[nodiscard]] Vector2d operator()(const Vector2d& point) const {
    const Vector2d s = scale();
    return {frame.left + (point.x() - box.low.x()) * s.x(), frame.bottom - (point.y() - box.low.y()) * s.y()};
  }
};

void Chart::add_to_legend(Symbol symbol, Ink ink, const std::string& name) {
  const bool known = std::any_of(legend_.begin(), legend_.end(),
                                 [&](const LegendEntry& entry) { return entry.name == name; });
  if (!name.empty() && !known) legend_.push_back({symbol, ink, name});
}

void Chart::add_line(const std::string& name, Ink ink, std::vector<Vector2d> points, bool dashed) {
  add_to_legend(dashed ? Symbol::kDashes : Symbol::kLine, ink, name);
  lines_.push_back({ink, std::move(points), dashed});
}

void Chart::add_strokes(const std::string& name, Ink ink,
                        std::vector<std::pair<Vector2d, Vector2d>> strokes) {
  add_to_legend(Symbol::kStroke, ink, name);
  strokes_.push_back({ink, std::move(strokes)});
}

void Chart::add_marks(const std::string& name, Ink ink, std::vector<Mark> marks) {
  add_to_legend(Symbol::kMark, ink, name);
  marks_.push_back({ink, std::move(marks)});
}

void Chart::add_points(const std::string& name, Ink ink, std::vector<Vector2d> points) {
  add_to_legend(Symbol::kPoint, ink, name);
  points_.push_back({ink, std::move(points)});
}

void Chart::add_intervals(const std::string& name, Ink ink, std::vector<Vector2d> points,
                          std::vector<double> half_heights) {
  add_to_legend(Symbol::kInterval, ink, name);
  intervals_.push_back({ink, std::move(points), std::move(half_heights)});
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
  if (!x_names_.empty()) {
    box.include({-0.6, box.low.y()});
    box.include({static_cast<double>(x_names_.size()) - 0.4, box.low.y()});
  }
  if (!finite(box.low) || !finite(box.high)) box = {Vector2d::Zero(), Vector2d::Ones()};
  if (axes_.y_range) {
    box.low.y() = axes_.y_range->x();
    box.high.y() = axes_.y_range->y();
  }
  const Vector2d span = (box.high - box.low).cwiseMax(1e-9 * (1.0 + box.high.cwiseAbs().maxCoeff()));
  const bool margins_of_x = x_names_.empty() && axes_.same_scale;
  const Vector2d margin(margins_of_x ? 0.05 * span.x() : 0.0, axes_.y_range ? 0.0 : 0.06 * span.y());
  return {box.low - margin, box.low + span + margin};
}

Chart::View Chart::view(double enlarged) const {
  View view;
  view.box = extent(enlarged);
  view.width_px = axes_.width_px;
  // The top margin holds as many lines as the legend needs.
  double top_px = 10.0 + (axes_.title.empty() ? 0.0 : kTitle_px);
  if (axes_.legend && !legend_.empty()) {
    double x_px = kLeft_px;
    top_px += kLegendLine_px;
    for (const LegendEntry& entry : legend_) {
      const double width = 42.0 + kCharacter_px * static_cast<double>(entry.name.size());
      if (x_px + width > axes_.width_px && x_px > kLeft_px) {
        x_px = kLeft_px;
        top_px += kLegendLine_px;
      }
      x_px += width;
    }
  }
  const double inner_width = axes_.width_px - kLeft_px - kRight_px;
  double inner_height = axes_.height_px - kBottom_px - top_px;
  if (axes_.same_scale) {
    const Vector2d span = view.box.high - view.box.low;
    const double per_metre = std::min(inner_width / span.x(), inner_height / span.y());
    inner_height = std::clamp(per_metre * span.y(), 160.0, inner_height);
    // Extend the shorter axis to fill the frame.
    const Vector2d wanted(inner_width / per_metre, inner_height / per_metre);
    const Vector2d middle = 0.5 * (view.box.low + view.box.high);
    view.box = {middle - 0.5 * wanted, middle + 0.5 * wanted};
  }
  view.frame = {kLeft_px, top_px, kLeft_px + inner_width, top_px + inner_height};
  view.height_px = top_px + inner_height + kBottom_px;
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
  const auto middle = sizes_px.begin() + static_cast<std::ptrdiff_t>(sizes_px.size() / 2);
  std::nth_element(sizes_px.begin(), middle, sizes_px.end());
  constexpr double kVisible_px = 7.0;
  const double median_px = *middle;
  const double most = 0.15 * view.width_px / *std::max_element(sizes_px.begin(), sizes_px.end());
  double chosen = 1.0;
  for (const double factor : {2.0, 5.0, 10.0, 20.0, 50.0, 100.0}) {
    if (median_px * chosen < kVisible_px && factor <= most) chosen = factor;
  }
  return chosen;
}

namespace {

// Skips points closer than half a pixel to the last drawn one: they would only enlarge the file.
void draw_line(Output out, const std::vector<Vector2d>& points_px, std::string_view css, bool dashed) {
  std::string path;
  bool pen_down = false;
  Vector2d last = Vector2d::Zero();
  for (std::size_t i = 0; i < points_px.size(); ++i) {
    const Vector2d& point = points_px[i];
    if (!finite(point)) {
      pen_down = false;
      continue;
    }
    const bool ends = i + 1 == points_px.size() || !finite(points_px[i + 1]);
    if (pen_down && !ends && (point - last).squaredNorm() < 0.25) continue;
    path += fmt::format("{}{:.1f} {:.1f}", pen_down ? "L" : "M", point.x(), point.y());
    pen_down = true;
    last = point;
  }
  if (!path.empty()) {
    fmt::format_to(out, "<path class=\"line {}{}\" d=\"{}\"/>\n", css, dashed ? " dashed" : "", path);
  }
}

// All dots of one ink are one path of zero-length strokes; their round caps are the dots.
void draw_points(Output out, const std::vector<Vector2d>& points_px, std::string_view css) {
  constexpr double kSpot_px = 2.0;
  std::set<std::pair<int, int>> drawn;
  std::string path;
  for (const Vector2d& point : points_px) {
    if (!finite(point) || point.cwiseAbs().maxCoeff() > 1e5) continue;
    const std::pair spot(static_cast<int>(std::floor(point.x() / kSpot_px)),
                         static_cast<int>(std::floor(point.y() / kSpot_px)));
    if (drawn.insert(spot).second) path += fmt::format("M{:.0f} {:.0f}h0", point.x(), point.y());
  }
  if (!path.empty()) fmt::format_to(out, "<path class=\"points {}\" d=\"{}\"/>\n", css, path);
}

// An anchor's mark is a triangle around the point, any other a circle.
void draw_mark(Output out, const Vector2d& at, std::string_view css) {
  if (css == "anchor" || css == "warn" || css == "bad") {
    fmt::format_to(out, "<path class=\"mark {}\" d=\"M{:.1f} {:.1f}l5.2 9h-10.4z\"/>\n", css, at.x(),
                   at.y() - 6.0);
  } else {
    fmt::format_to(out, "<circle class=\"mark {}\" cx=\"{:.1f}\" cy=\"{:.1f}\" r=\"3.4\"/>\n", css, at.x(),
                   at.y());
  }
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

// Places a label beside its mark, where it overlaps the least area of earlier marks and labels.
void draw_label(Output out, const Mark& mark, const Vector2d& at, std::vector<Rectangle>& taken) {
  const double width = kCharacter_px * static_cast<double>(mark.label.size()) + 2.0;
  constexpr double kHeight = 13.0;
  const std::array<Vector2d, 8> corners{Vector2d(8.0, -16.0),          Vector2d(8.0, 3.0),
                                        Vector2d(-8.0 - width, -16.0), Vector2d(-8.0 - width, 3.0),
                                        Vector2d(9.0, -6.5),           Vector2d(-9.0 - width, -6.5),
                                        Vector2d(-0.5 * width, -22.0), Vector2d(-0.5 * width, 8.0)};
  Rectangle best{};
  double least = std::numeric_limits<double>::infinity();
  for (const Vector2d& corner : corners) {
    const Vector2d place = at + corner;
    const Rectangle rectangle{place.x(), place.y(), place.x() + width, place.y() + kHeight};
    double covered = 0.0;
    for (const Rectangle& other : taken) covered += rectangle.overlap(other);
    if (covered < least) {
      least = covered;
      best = rectangle;
    }
  }
  taken.push_back(best);
  fmt::format_to(out, "<text class=\"label\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>\n", best.left + 1.0,
                 best.bottom - 2.5, escaped(mark.label));
}

}  // namespace

std::string Chart::svg() const {
  const double enlarged = magnification(view(0.0));
  const View view = this->view(enlarged);
  const Rectangle& frame = view.frame;
  std::string text;
  const Output out(text);
  fmt::format_to(out, "<svg viewBox=\"0 0 {:.0f} {:.0f}\" role=\"img\" aria-label=\"{}\">\n", view.width_px,
                 view.height_px, escaped(axes_.title.empty() ? axes_.y_label : axes_.title));
  if (!axes_.title.empty()) {
    fmt::format_to(out, "<text class=\"title\" x=\"{:.1f}\" y=\"18\">{}</text>\n", kLeft_px,
                   escaped(axes_.title));
  }

  // Grid and axes.
  const Vector2d span = view.box.high - view.box.low;
  const double x_step = nice_step(span.x(), (frame.right - frame.left) / 75.0);
  const double y_step = axes_.same_scale ? x_step : nice_step(span.y(), (frame.bottom - frame.top) / 45.0);
  if (x_names_.empty()) {
    for (double x = std::ceil(view.box.low.x() / x_step) * x_step; x <= view.box.high.x() + 1e-9 * span.x();
         x += x_step) {
      const double at = view({x, 0.0}).x();
      fmt::format_to(out, "<path class=\"grid\" d=\"M{0:.1f} {1:.1f}V{2:.1f}\"/>", at, frame.top,
                     frame.bottom);
      fmt::format_to(out, "<text class=\"tick\" x=\"{:.1f}\" y=\"{:.1f}\" text-anchor=\"middle\">{}</text>\n",
                     at, frame.bottom + 16.0, tick_text(x, x_step));
    }
  }
  for (std::size_t i = 0; i < x_names_.size(); ++i) {
    fmt::format_to(out, "<text class=\"tick\" x=\"{:.1f}\" y=\"{:.1f}\" text-anchor=\"middle\">{}</text>\n",
                   view({static_cast<double>(i), 0.0}).x(), frame.bottom + 16.0, escaped(x_names_[i]));
  }
  for (double y = std::ceil(view.box.low.y() / y_step) * y_step; y <= view.box.high.y() + 1e-9 * span.y();
       y += y_step) {
    const double at = view({0.0, y}).y();
    const bool zero = std::abs(y) < 1e-9 * y_step && !axes_.same_scale;
    fmt::format_to(out, "<path class=\"grid{}\" d=\"M{:.1f} {:.1f}H{:.1f}\"/>", zero ? " zero" : "",
                   frame.left, at, frame.right);
    fmt::format_to(out, "<text class=\"tick\" x=\"{:.1f}\" y=\"{:.1f}\" text-anchor=\"end\">{}</text>\n",
                   frame.left - 7.0, at + 4.0, tick_text(y, y_step));
  }
  fmt::format_to(out, "<text class=\"axis\" x=\"{:.1f}\" y=\"{:.1f}\" text-anchor=\"middle\">{}</text>\n",
                 0.5 * (frame.left + frame.right), frame.bottom + 36.0, escaped(axes_.x_label));
  const double middle = 0.5 * (frame.top + frame.bottom);
  fmt::format_to(out,
                 "<text class=\"axis\" x=\"13\" y=\"{0:.1f}\" text-anchor=\"middle\" transform=\"rotate(-90 "
                 "13 {0:.1f})\">{1}</text>\n",
                 middle, escaped(axes_.y_label));

  // Clip to the axes. The id is derived from the shape, so that equal ids on one page have equal shapes.
  const std::string clip =
      fmt::format("clip-{:.0f}-{:.0f}-{:.0f}-{:.0f}", frame.left, frame.top, frame.right, frame.bottom);
  fmt::format_to(
      out,
      "<clipPath id=\"{}\"><rect x=\"{:.1f}\" y=\"{:.1f}\" width=\"{:.1f}\" height=\"{:.1f}\"/></clipPath>\n",
      clip, frame.left, frame.top, frame.right - frame.left, frame.bottom - frame.top);
  fmt::format_to(out, "<g clip-path=\"url(#{})\">\n", clip);
  for (const Strokes& strokes : strokes_) {
    for (const auto& [from, to] : strokes.strokes) {
      const Vector2d a = view(from);
      const Vector2d b = view(to);
      fmt::format_to(out, "<path class=\"stroke {}\" d=\"M{:.1f} {:.1f}L{:.1f} {:.1f}\"/>\n",
                     css_class(strokes.ink), a.x(), a.y(), b.x(), b.y());
    }
  }
  const auto placed = [&](const std::vector<Vector2d>& points) {
    std::vector<Vector2d> points_px;
    points_px.reserve(points.size());
    for (const Vector2d& point : points) points_px.push_back(view(point));
    return points_px;
  };
  for (const Points& points : points_) draw_points(out, placed(points.points), css_class(points.ink));
  for (const Line& line : lines_) draw_line(out, placed(line.points), css_class(line.ink), line.dashed);
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
      draw_mark(out, view(intervals.points[i]), css_class(intervals.ink));
    }
  }
  std::vector<Rectangle> taken;
  for (const Marks& marks : marks_) {
    for (const Mark& mark : marks.marks) {
      if (!finite(mark.at)) continue;
      const Vector2d at = view(mark.at);
      if (!mark.link.empty()) fmt::format_to(out, "<a href=\"#{}\">", escaped(mark.link));
      fmt::format_to(out, "<g>");
      if (!mark.hint.empty()) fmt::format_to(out, "<title>{}</title>", escaped(mark.hint));
      draw_mark(out, at, css_class(marks.ink));
      fmt::format_to(out, "</g>{}", mark.link.empty() ? "" : "</a>");
      taken.push_back({at.x() - 6.0, at.y() - 7.0, at.x() + 6.0, at.y() + 4.0});
    }
  }
  for (const Marks& marks : marks_) {
    for (const Mark& mark : marks.marks) {
      if (finite(mark.at) && !mark.label.empty()) draw_label(out, mark, view(mark.at), taken);
    }
  }
  fmt::format_to(
      out, "</g>\n<rect class=\"frame\" x=\"{:.1f}\" y=\"{:.1f}\" width=\"{:.1f}\" height=\"{:.1f}\"/>\n",
      frame.left, frame.top, frame.right - frame.left, frame.bottom - frame.top);

  if (axes_.legend) {
    double x_px = kLeft_px;
    double y_px = 10.0 + (axes_.title.empty() ? 0.0 : kTitle_px) + 8.0;
    for (const LegendEntry& entry : legend_) {
      std::string name = entry.name;
      if (entry.symbol == Symbol::kEllipse && enlarged > 1.0) name += fmt::format(" (× {:.0f})", enlarged);
      const double width = 42.0 + kCharacter_px * static_cast<double>(entry.name.size());
      if (x_px + width > axes_.width_px && x_px > kLeft_px) {
        x_px = kLeft_px;
        y_px += kLegendLine_px;
      }
      const std::string_view css = css_class(entry.ink);
      const Vector2d at(x_px + 10.0, y_px);
      switch (entry.symbol) {
        case Symbol::kLine:
        case Symbol::kDashes:
          draw_line(out, {at - Vector2d(10.0, 0.0), at + Vector2d(10.0, 0.0)}, css,
                    entry.symbol == Symbol::kDashes);
          break;
        case Symbol::kStroke:
          fmt::format_to(out, "<path class=\"stroke {}\" d=\"M{:.1f} {:.1f}h20\"/>\n", css, at.x() - 10.0,
                         at.y());
          break;
        case Symbol::kMark:
          draw_mark(out, at, css);
          break;
        case Symbol::kPoint:
          fmt::format_to(out, "<path class=\"points {}\" d=\"M{:.1f} {:.1f}h0\"/>\n", css, at.x() + 2.0,
                         at.y());
          break;
        case Symbol::kInterval:
          fmt::format_to(out, "<path class=\"interval {}\" d=\"M{:.1f} {:.1f}v12\"/>\n", css, at.x(),
                         at.y() - 6.0);
          draw_mark(out, at, css);
          break;
        case Symbol::kEllipse:
          fmt::format_to(out,
                         "<ellipse class=\"ellipse {}\" cx=\"{:.1f}\" cy=\"{:.1f}\" rx=\"10\" ry=\"5.5\"/>\n",
                         css, at.x(), at.y());
          break;
      }
      fmt::format_to(out, "<text class=\"legend\" x=\"{:.1f}\" y=\"{:.1f}\">{}</text>\n", x_px + 26.0,
                     y_px + 4.0, escaped(name));
      x_px += 42.0 + kCharacter_px * static_cast<double>(name.size());
    }
  }
  text += "</svg>\n";
  return text;
}

}  // namespace groma::report
