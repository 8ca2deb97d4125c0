#include "host/report/labels.hpp"

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <numbers>

namespace groma::report {

namespace {

using Eigen::Vector2d;

constexpr double kCharacter_px = 6.9;  // mean width at 12 px, semibold
constexpr double kHeight_px = 13.0;
// A label beyond this distance from its mark gets a line to it.
constexpr double kNear_px = 12.0;

struct Rectangle {
  Vector2d low = Vector2d::Zero();
  Vector2d high = Vector2d::Zero();

  [[nodiscard]] double overlap(const Rectangle& other) const {
    const Vector2d size = high.cwiseMin(other.high) - low.cwiseMax(other.low);
    return size.x() > 0.0 && size.y() > 0.0 ? size.prod() : 0.0;
  }
  [[nodiscard]] Vector2d nearest(const Vector2d& point) const { return point.cwiseMax(low).cwiseMin(high); }
  [[nodiscard]] double area() const { return (high - low).prod(); }
};

// Whether the segment from a to b passes through the rectangle (Liang and Barsky).
bool crosses(const Rectangle& rectangle, const Vector2d& a, const Vector2d& b) {
  double from = 0.0;
  double to = 1.0;
  const Vector2d along = b - a;
  for (Eigen::Index k = 0; k < 2; ++k) {
    if (along(k) == 0.0) {
      if (a(k) <= rectangle.low(k) || a(k) >= rectangle.high(k)) return false;
      continue;
    }
    const double first = (rectangle.low(k) - a(k)) / along(k);
    const double second = (rectangle.high(k) - a(k)) / along(k);
    from = std::max(from, std::min(first, second));
    to = std::min(to, std::max(first, second));
  }
  return from < to;
}

Rectangle rectangle_of_mark(const Vector2d& at) {
  return {at + Vector2d(-6.0, -7.0), at + Vector2d(6.0, 4.0)};
}

// Centres of a label of this size, from its mark, nearest first.
std::vector<Vector2d> candidates(const Vector2d& size) {
  const Vector2d beside(8.0 + 0.5 * size.x(), 0.0);
  const std::array<Vector2d, 8> near{Vector2d(beside.x(), -9.5),
                                     Vector2d(beside.x(), 9.5),
                                     Vector2d(-beside.x(), -9.5),
                                     Vector2d(-beside.x(), 9.5),
                                     Vector2d(beside.x() + 1.0, 0.0),
                                     Vector2d(-beside.x() - 1.0, 0.0),
                                     Vector2d(0.0, -15.5),
                                     Vector2d(0.0, 14.5)};
  std::vector<Vector2d> out(near.begin(), near.end());
  constexpr int kRings = 10;
  constexpr int kDirections = 16;
  for (int ring = 1; ring <= kRings; ++ring) {
    for (int i = 0; i < kDirections; ++i) {
      const double turn = 2.0 * std::numbers::pi * i / kDirections;
      const double reach_px = 14.0 + 11.0 * ring;
      out.emplace_back((reach_px + 0.5 * size.x()) * std::cos(turn), reach_px * std::sin(turn));
    }
  }
  return out;
}

}  // namespace

std::vector<LabelPlace> place_labels(std::span<const Label> labels, std::span<const Vector2d> marks_px,
                                     const Vector2d& size_px) {
  std::vector<Rectangle> taken;
  for (const Vector2d& mark : marks_px) taken.push_back(rectangle_of_mark(mark));
  std::vector<std::pair<Vector2d, Vector2d>> leads;
  const Rectangle area{Vector2d(-6.0, -6.0), size_px + Vector2d(12.0, 6.0)};
  std::vector<LabelPlace> out;
  for (const Label& label : labels) {
    const Vector2d size(kCharacter_px * static_cast<double>(label.text.size()) + 2.0, kHeight_px);
    const auto cost = [&](const Rectangle& place, const Vector2d& lead) {
      double covered = place.area() - place.overlap(area);
      for (const Rectangle& other : taken) covered += place.overlap(other);
      constexpr double kCrossing = 20.0;  // of a line and a text; by hand
      for (const auto& [from, to] : leads)
        if (crosses(place, from, to)) covered += kCrossing;
      if (lead == label.at_px) return covered;
      for (std::size_t i = marks_px.size(); i < taken.size(); ++i)
        if (crosses(taken[i], label.at_px, lead)) covered += kCrossing;
      return covered;
    };
    Rectangle best;
    Vector2d best_lead = label.at_px;
    double least = std::numeric_limits<double>::infinity();
    for (const Vector2d& middle : candidates(size)) {
      const Rectangle place{label.at_px + middle - 0.5 * size, label.at_px + middle + 0.5 * size};
      const Vector2d nearest = place.nearest(label.at_px);
      const bool is_near = (nearest - label.at_px).norm() < kNear_px;
      const Vector2d lead = is_near ? label.at_px : nearest;
      const double covered = cost(place, lead);
      if (covered >= least) continue;
      least = covered;
      best = place;
      best_lead = lead;
      if (covered == 0.0) break;
    }
    taken.push_back(best);
    if (best_lead != label.at_px) leads.emplace_back(label.at_px, best_lead);
    out.push_back({Vector2d(best.low.x() + 1.0, best.high.y() - 2.5) - label.at_px, best_lead - label.at_px});
  }
  return out;
}

}  // namespace groma::report
