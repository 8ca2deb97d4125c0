// The screen of groma monitor, from what gromad's pose stream says. Reads no clock and no terminal.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include <nlohmann/json.hpp>

namespace groma::doctor {

enum class Style : std::uint8_t { kPlain, kTitle, kGood, kWarning, kBad, kDim };

struct Span {
  std::string text;  // printable ASCII
  Style style = Style::kPlain;
};
using Line = std::vector<Span>;

struct ScreenSize {
  std::size_t rows = 24;
  std::size_t columns = 80;
};

class MonitorView {
 public:
  explicit MonitorView(std::string address) : address_(std::move(address)) {}

  // A message of the pose stream that arrived at now_s, of any monotonic clock.
  void take(const nlohmann::json& message, double now_s);
  // There is no connection, for that reason; forgets what was said.
  void lost(std::string problem);
  // Two statuses have come, so that there are rates.
  [[nodiscard]] bool is_complete() const noexcept { return !before_.is_null(); }

  // At most size.rows lines, none longer than size.columns.
  [[nodiscard]] std::vector<Line> draw(const ScreenSize& size) const;

 private:
  struct Pair {
    int tag = 0;
    int anchor = 0;
    double ranges_hz = 0.0;
    double used = -1.0;  // share; negative: not known
    double residual_m = -1.0;
  };

  [[nodiscard]] double rate_hz(const std::string& pointer) const;
  [[nodiscard]] std::vector<Pair> pairs() const;  // the worst first
  [[nodiscard]] Line title(std::size_t columns) const;
  void append_state(std::vector<Line>& lines) const;
  void append_pose(std::vector<Line>& lines) const;
  void append_rates(std::vector<Line>& lines) const;
  void append_links(std::vector<Line>& lines) const;
  // Anchors on the left, pairs on the right, in that many lines.
  void append_tables(std::vector<Line>& lines, std::size_t rows) const;
  [[nodiscard]] std::vector<Line> anchor_lines(const std::vector<Pair>& pairs) const;
  [[nodiscard]] static std::vector<Line> pair_lines(const std::vector<Pair>& pairs);

  std::string address_;
  std::string problem_ = "waits for gromad";
  nlohmann::json version_;
  nlohmann::json pose_;
  nlohmann::json calibration_;
  nlohmann::json status_;  // the last one, and the one before
  nlohmann::json before_;
  double status_s_ = 0.0;
  double before_s_ = 0.0;
  std::size_t poses_ = 0;  // since the last status
  double poses_hz_ = 0.0;
};

// As it is sent to a terminal; `colour`: with the codes of ECMA-48.
[[nodiscard]] std::string rendered(const Line& line, bool colour);

}  // namespace groma::doctor
