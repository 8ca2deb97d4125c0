// Counters as Prometheus reads them: its text exposition format, version 0.0.4.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <string>
#include <string_view>

namespace groma::daemon {

// Counts durations by their size.
class LatencyHistogram {
 public:
  // Upper bounds of the buckets; a last one has no bound.
  static constexpr std::array<double, 13> kBounds_s{20e-6, 50e-6, 100e-6, 200e-6, 500e-6, 1e-3, 2e-3,
                                                    5e-3,  10e-3, 20e-3,  50e-3,  100e-3, 1.0};

  void observe(double duration_s) noexcept;

  [[nodiscard]] std::uint64_t count() const noexcept;
  // The upper bound of the bucket with that share of the durations below it, from 0 to 1; nothing if there
  // are none, or the bucket has no bound.
  [[nodiscard]] std::optional<double> quantile_s(double share) const noexcept;
  [[nodiscard]] double sum_s() const noexcept { return sum_s_; }
  // Of one bucket alone; the last one is counts()[kBounds_s.size()].
  [[nodiscard]] const auto& counts() const noexcept { return counts_; }

 private:
  std::array<std::uint64_t, kBounds_s.size() + 1> counts_{};
  double sum_s_ = 0.0;
};

class MetricsText {
 public:
  // Begins a metric family of that type ("counter", "gauge"); the samples that follow are its.
  void family(std::string_view name, std::string_view type, std::string_view help);
  // labels: label() of each, separated by commas; may be empty.
  void add(std::uint64_t value, std::string_view labels = {});
  void add(double value, std::string_view labels = {});
  // A family with its samples.
  void histogram(std::string_view name, std::string_view help, const LatencyHistogram& values);

  [[nodiscard]] static std::string label(std::string_view name, std::string_view value);
  [[nodiscard]] const std::string& text() const noexcept { return text_; }

 private:
  void add_text(std::string_view suffix, std::string_view value, std::string_view labels);

  std::string name_;
  std::string text_;
};

}  // namespace groma::daemon
