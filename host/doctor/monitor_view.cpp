#include "host/doctor/monitor_view.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <iterator>
#include <map>
#include <utility>

#include "host/doctor/advice.hpp"

namespace groma::doctor {
namespace {

using Json = nlohmann::json;

constexpr std::size_t kAnchorColumns = 36;  // of the table on the left
constexpr double kDegrees = 180.0 / 3.14159265358979323846;

// The stream may come from anywhere: nothing of it reaches the terminal but printable characters.
std::string printable(std::string text) {
  std::replace_if(
      text.begin(), text.end(), [](char c) { return c < ' ' || c > '~'; }, '?');
  return text;
}

const Json& member(const Json& object, std::string_view key) {
  static const Json none;
  if (!object.is_object()) return none;
  const auto found = object.find(key);
  return found == object.end() ? none : *found;
}

std::string text_of(const Json& value) {
  return value.is_string() ? printable(value.get<std::string>()) : std::string();
}

double number_of(const Json& value) {
  return value.is_number() ? value.get<double>() : std::nan("");
}

int integer_of(const Json& value) {
  return value.is_number_integer() ? value.get<int>() : 0;
}

std::string number(double value, int decimals) {
  return std::isfinite(value) ? fmt::format("{:.{}f}", value, decimals) : "-";
}

std::size_t width(const Line& line) {
  std::size_t columns = 0;
  for (const Span& span : line) columns += span.text.size();
  return columns;
}

Line cut(Line line, std::size_t columns) {
  std::size_t left = columns;
  for (Span& span : line) {
    span.text.resize(std::min(span.text.size(), left));
    left -= span.text.size();
  }
  return line;
}

// In that many columns; a longer one ends in "..".
std::string fitted(const std::string& text, std::size_t columns) {
  return text.size() <= columns ? text : ".." + text.substr(text.size() - columns + 2);
}

Style style_of_state(std::string_view state) {
  if (state == "TRACKING") return Style::kGood;
  if (state == "DEGRADED" || state == "LOST" || state == "ODOMETRY_TIMES_WRONG") return Style::kBad;
  return Style::kWarning;
}

Style style_of_verdict(std::string_view verdict) {
  if (verdict == "ok" || verdict.empty()) return Style::kPlain;
  return verdict == "weak-z" || verdict == "weak" ? Style::kWarning : Style::kBad;
}

Style style_of_share(double used) {
  if (used < 0.0) return Style::kDim;
  return used >= 0.8 ? Style::kGood : used >= 0.5 ? Style::kWarning : Style::kBad;
}

std::string percent(double share) {
  return share < 0.0 ? "-" : fmt::format("{:.0f} %", 100.0 * share);
}

double sigma(const Json& covariance, std::size_t i) {
  if (!covariance.is_array() || covariance.size() != 36) return std::nan("");
  return std::sqrt(number_of(covariance[i]));
}

Line link_line(const Json& link, double frames_hz, double bad_hz, double ranges_hz) {
  const bool open = member(link, "open") == Json(true);
  Line line{{fmt::format("{:<30}", fitted(text_of(member(link, "link")), 30))},
            {fmt::format(" {:<7}", open ? "open" : "closed"), open ? Style::kGood : Style::kBad}};
  if (!open) {
    line.push_back({text_of(member(link, "error")), Style::kBad});
    return line;
  }
  const Json& node = member(link, "node");
  if (!node.is_object()) return line;
  const std::string id =
      member(node, "id").is_number() ? fmt::format("{}", integer_of(member(node, "id"))) : "-";
  const double round_trip_ms = 1e3 * number_of(member(link, "round_trip_s"));
  line.push_back({fmt::format("{:>5} {:>9} {:>9} ", id, number(frames_hz, 1), number(ranges_hz, 1))});
  line.push_back({fmt::format("{:>7}", number(bad_hz, 1)), bad_hz > 0.0 ? Style::kWarning : Style::kPlain});
  line.push_back({fmt::format(" {:>7}", number(round_trip_ms, 2))});
  return line;
}

// The first `rows` of them; the last one says how many more there are.
void shorten(std::vector<Line>& lines, std::size_t rows) {
  if (lines.size() <= rows) return;
  const std::size_t hidden = lines.size() - rows + 1;
  lines.resize(rows);
  if (rows > 0) lines.back() = {{fmt::format(".. {} more", hidden), Style::kDim}};
}

}  // namespace

void MonitorView::take(const Json& message, double now_s) {
  const std::string name = text_of(member(message, "class"));
  if (name == "VERSION") version_ = message;
  if (name == "CALIBRATION") calibration_ = message;
  if (name == "POSE") {
    pose_ = message;
    ++poses_;
  }
  if (name != "STATUS") return;
  problem_.clear();
  before_ = std::exchange(status_, message);
  before_s_ = std::exchange(status_s_, now_s);
  const auto poses = static_cast<double>(std::exchange(poses_, 0));
  poses_hz_ = is_complete() ? poses / std::max(status_s_ - before_s_, 1e-3) : std::nan("");
}

void MonitorView::lost(std::string problem) {
  *this = MonitorView(address_);
  problem_ = printable(std::move(problem));
}

double MonitorView::rate_hz(const std::string& pointer) const {
  const Json::json_pointer at(pointer);
  if (!status_.contains(at) || !before_.contains(at)) return std::nan("");
  return (number_of(status_.at(at)) - number_of(before_.at(at))) / std::max(status_s_ - before_s_, 1e-3);
}

std::vector<MonitorView::Pair> MonitorView::pairs() const {
  std::map<std::pair<int, int>, Json> earlier;
  const auto key_of = [](const Json& pair) {
    return std::pair(integer_of(member(pair, "tag")), integer_of(member(pair, "anchor")));
  };
  if (member(before_, "pairs").is_array()) {
    for (const Json& pair : member(before_, "pairs")) earlier[key_of(pair)] = pair;
  }
  std::vector<Pair> out;
  if (!member(status_, "pairs").is_array()) return out;
  for (const Json& pair : member(status_, "pairs")) {
    const auto growth = [&](const char* key) {
      const double old = number_of(member(earlier[key_of(pair)], key));
      return number_of(member(pair, key)) - (std::isfinite(old) ? old : 0.0);
    };
    const auto [tag, anchor] = key_of(pair);
    const double judged = growth("used") + growth("gated");
    const double residual_m = number_of(member(pair, "innovation_m"));
    out.push_back(
        {.tag = tag,
         .anchor = anchor,
         .ranges_hz = is_complete() ? growth("ranges") / std::max(status_s_ - before_s_, 1e-3) : std::nan(""),
         .used = judged > 0.0 ? growth("used") / judged : -1.0,
         .residual_m = std::isfinite(residual_m) ? residual_m : -1.0});
  }
  std::stable_sort(out.begin(), out.end(), [](const Pair& a, const Pair& b) {
    return std::pair(a.used, -a.residual_m) < std::pair(b.used, -b.residual_m);
  });
  return out;
}

std::vector<Line> MonitorView::draw(const ScreenSize& size) const {
  std::vector<Line> lines{title(size.columns)};
  if (status_.is_null()) {
    lines.push_back({{problem_, Style::kWarning}});
  } else {
    append_state(lines);
    append_pose(lines);
    append_rates(lines);
    append_links(lines);
    if (lines.size() + 3 < size.rows) append_tables(lines, size.rows - lines.size() - 1);
  }
  if (lines.size() > size.rows) lines.resize(size.rows);
  for (Line& line : lines) line = cut(std::move(line), size.columns);
  return lines;
}

Line MonitorView::title(std::size_t columns) const {
  const std::string version = text_of(member(version_, "version"));
  std::string left = fmt::format("gromad {}  {}", version, address_);
  const std::string right = "q: quit";
  const std::size_t space = columns > left.size() + right.size() ? columns - left.size() - right.size() : 1;
  return {{left + std::string(std::min<std::size_t>(space, 200), ' ') + right, Style::kTitle}};
}

void MonitorView::append_state(std::vector<Line>& lines) const {
  const std::string state = text_of(member(status_, "state"));
  const bool is_of_pose = text_of(member(pose_, "state")) == state;
  const std::string reason = is_of_pose ? text_of(member(pose_, "reason")) : std::string();
  lines.push_back({{state, style_of_state(state)}, {reason.empty() ? "" : "  " + reason}});
  std::string remedy(advice_on(state, reason));
  const Json& diagnosis = member(status_, "diagnosis");
  if (diagnosis.is_array() && !diagnosis.empty()) {
    const Json& first = diagnosis.front();
    lines.push_back(
        {{text_of(member(first, "cause")), Style::kBad}, {"  " + text_of(member(first, "evidence"))}});
    remedy = text_of(member(first, "remedy"));
  }
  lines.push_back({{remedy.empty() ? "" : "-> " + remedy}});
}

void MonitorView::append_pose(std::vector<Line>& lines) const {
  if (pose_.is_null()) {
    lines.push_back({{"no pose yet", Style::kDim}});
    lines.push_back({});
    return;
  }
  const Style style = poses_hz_ == 0.0 ? Style::kDim : Style::kPlain;  // an old one is dim
  const Json& covariance = member(pose_, "covariance");
  const Json& twist = member(pose_, "twist");
  const auto value = [&](const char* key) { return number_of(member(pose_, key)); };
  lines.push_back(
      {{fmt::format("x {:>9} +-{} m   y {:>9} +-{} m   yaw {:>6} +-{} deg", number(value("x_m"), 3),
                    number(sigma(covariance, 0), 3), number(value("y_m"), 3), number(sigma(covariance, 7), 3),
                    number(kDegrees * value("yaw_rad"), 1), number(kDegrees * sigma(covariance, 35), 1)),
        style}});
  const std::string floor = text_of(member(pose_, "floor"));
  lines.push_back({{fmt::format("z {:>9} m   {:>5} m/s   {:>6} rad/s   t_s {}   {}{}",
                                number(value("z_m"), 3), number(number_of(member(twist, "vx_mps")), 2),
                                number(number_of(member(twist, "omega_radps")), 2), number(value("t_s"), 2),
                                text_of(member(pose_, "frame")), floor.empty() ? "" : "   floor " + floor),
                    style}});
}

void MonitorView::append_rates(std::vector<Line>& lines) const {
  const Json& latency = member(status_, "pose_latency_s");
  lines.push_back(
      {{fmt::format("poses {}/s   odometry {}/s   ranges {}/s   dropped {}/s   lost {}/s",
                    number(poses_hz_, 1), number(rate_hz("/odometry"), 1), number(rate_hz("/ranges"), 1),
                    number(rate_hz("/dropped"), 1), number(rate_hz("/frames_lost"), 1))}});
  lines.push_back({{fmt::format("latency: half below {} ms, 99 % below {} ms",
                                number(1e3 * number_of(member(latency, "p50")), 2),
                                number(1e3 * number_of(member(latency, "p99")), 2))}});
}

void MonitorView::append_links(std::vector<Line>& lines) const {
  lines.push_back({});
  lines.push_back({{fmt::format("{:<30} {:<7}{:>5} {:>9} {:>9} {:>7} {:>7}", "LINK", "STATE", "NODE",
                                "FRAMES/S", "RANGES/S", "BAD/S", "TRIP ms"),
                    Style::kDim}});
  const Json& links = member(status_, "links");
  for (std::size_t i = 0; links.is_array() && i < links.size(); ++i) {
    const auto rate = [&](const char* key) { return rate_hz(fmt::format("/links/{}/{}", i, key)); };
    lines.push_back(link_line(links.at(i), rate("frames"), rate("frames_dropped") + rate("bytes_discarded"),
                              rate("ranges")));
  }
  lines.push_back(link_line(member(status_, "robot"), 0.0, 0.0, 0.0));
}

std::vector<Line> MonitorView::anchor_lines(const std::vector<Pair>& pairs) const {
  struct Row {
    std::string verdict;
    double ranges_hz = 0.0;
  };
  std::map<int, Row> rows;
  for (const Json* list : {&member(status_, "anchors"), &member(calibration_, "anchors")}) {
    if (!list->is_array()) continue;
    for (const Json& anchor : *list) {
      const std::string state = text_of(member(anchor, "state"));
      const bool is_new = state == "learning" || state == "moved";
      rows[integer_of(member(anchor, "id"))].verdict = is_new ? state : text_of(member(anchor, "verdict"));
    }
  }
  for (const Pair& pair : pairs) {
    Row& row = rows.try_emplace(pair.anchor, Row{.verdict = "unknown"}).first->second;
    row.ranges_hz += pair.ranges_hz;
  }
  std::vector<Line> lines;
  lines.reserve(rows.size());
  for (const auto& [id, row] : rows) {
    lines.push_back({{fmt::format("{:>6} ", id)},
                     {fmt::format("{:<15}", row.verdict), style_of_verdict(row.verdict)},
                     {fmt::format("{:>9}", number(row.ranges_hz, 1))}});
  }
  return lines;
}

std::vector<Line> MonitorView::pair_lines(const std::vector<Pair>& pairs) {
  std::vector<Line> lines;
  lines.reserve(pairs.size());
  for (const Pair& pair : pairs) {
    lines.push_back({{fmt::format("{:<11} {:>9} ", fmt::format("{}-{}", pair.tag, pair.anchor),
                                  number(pair.ranges_hz, 1))},
                     {fmt::format("{:>7}", percent(pair.used)), style_of_share(pair.used)},
                     {fmt::format(" {:>10}", pair.residual_m < 0.0 ? "-" : number(pair.residual_m, 2))}});
  }
  return lines;
}

void MonitorView::append_tables(std::vector<Line>& lines, std::size_t rows) const {
  const std::vector<Pair> sorted = pairs();
  std::vector<Line> left = anchor_lines(sorted);
  std::vector<Line> right = pair_lines(sorted);
  shorten(left, rows - 1);
  shorten(right, rows - 1);
  lines.push_back({});
  lines.push_back({{fmt::format("{:<{}}{:<11} {:>9} {:>7} {:>10}",
                                fmt::format("{:>6} {:<15}{:>9}", "ANCHOR", "VERDICT", "RANGES/S"),
                                kAnchorColumns, "TAG-ANCHOR", "RANGES/S", "USED", "RESIDUAL m"),
                    Style::kDim}});
  for (std::size_t i = 0; i < std::max(left.size(), right.size()); ++i) {
    Line line = i < left.size() ? left.at(i) : Line{};
    if (i < right.size()) {
      line.push_back({std::string(kAnchorColumns - std::min(kAnchorColumns, width(line)), ' ')});
      line.insert(line.end(), right.at(i).begin(), right.at(i).end());
    }
    lines.push_back(std::move(line));
  }
}

std::string rendered(const Line& line, bool colour) {
  // In the order of Style.
  constexpr std::array<std::string_view, 6> kCodes{"", "7", "32", "33", "31", "2"};
  std::string text;
  for (const Span& span : line) {
    const std::string_view code = kCodes.at(static_cast<std::size_t>(span.style));
    if (!colour || code.empty() || span.text.empty()) {
      text += span.text;
    } else {
      text += fmt::format("\x1b[{}m{}\x1b[0m", code, span.text);
    }
  }
  text.erase(text.find_last_not_of(' ') + 1);
  return text;
}

}  // namespace groma::doctor
