#include "host/daemon/metrics_text.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <iterator>
#include <numeric>

namespace groma::daemon {

void LatencyHistogram::observe(double duration_s) noexcept {
  const auto bucket = std::lower_bound(kBounds_s.begin(), kBounds_s.end(), duration_s);
  ++counts_.at(static_cast<std::size_t>(bucket - kBounds_s.begin()));
  sum_s_ += duration_s;
}

std::uint64_t LatencyHistogram::count() const noexcept {
  return std::accumulate(counts_.begin(), counts_.end(), std::uint64_t{0});
}

std::optional<double> LatencyHistogram::quantile_s(double share) const noexcept {
  const double below = share * static_cast<double>(count());
  std::uint64_t up_to = 0;
  for (std::size_t i = 0; i < kBounds_s.size(); ++i) {
    up_to += counts_.at(i);
    if (up_to > 0 && static_cast<double>(up_to) >= below) return kBounds_s.at(i);
  }
  return std::nullopt;
}

void MetricsText::family(std::string_view name, std::string_view type, std::string_view help) {
  name_ = name;
  fmt::format_to(std::back_inserter(text_), "# HELP {0} {1}\n# TYPE {0} {2}\n", name, help, type);
}

void MetricsText::add(std::uint64_t value, std::string_view labels) {
  add_text("", fmt::format("{}", value), labels);
}

void MetricsText::add(double value, std::string_view labels) {
  add_text("", fmt::format("{}", value), labels);
}

void MetricsText::histogram(std::string_view name, std::string_view help, const LatencyHistogram& values) {
  family(name, "histogram", help);
  std::uint64_t up_to = 0;
  for (std::size_t i = 0; i < values.counts().size(); ++i) {
    up_to += values.counts().at(i);
    const bool last = i == LatencyHistogram::kBounds_s.size();
    const std::string bound = last ? "+Inf" : fmt::format("{}", LatencyHistogram::kBounds_s.at(i));
    add_text("_bucket", fmt::format("{}", up_to), label("le", bound));
  }
  add_text("_sum", fmt::format("{}", values.sum_s()), {});
  add_text("_count", fmt::format("{}", up_to), {});
}

std::string MetricsText::label(std::string_view name, std::string_view value) {
  std::string text = fmt::format("{}=\"", name);
  for (const char c : value) {
    if (c == '\\' || c == '"') text += '\\';
    if (c == '\n') {
      text += "\\n";
    } else {
      text += c;
    }
  }
  return text + '"';
}

void MetricsText::add_text(std::string_view suffix, std::string_view value, std::string_view labels) {
  text_ += name_;
  text_ += suffix;
  if (!labels.empty()) fmt::format_to(std::back_inserter(text_), "{{{}}}", labels);
  fmt::format_to(std::back_inserter(text_), " {}\n", value);
}

}  // namespace groma::daemon
