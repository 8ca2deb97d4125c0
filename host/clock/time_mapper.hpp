// Maps the counter of another clock to this host's time, over a link with delay.
//
// Each message carries the counter's value when it was sent and arrives after a delay that is never
// negative: the transmission time, which is known, plus unknown jitter. The points (counter, arrival)
// therefore lie on or above the line that relates the two clocks. The mapper fits that line from below: of
// all lines under all points of a sliding window it takes the one with the least sum of distances (Moon,
// Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements", 1999), with
// its slope within kMaxSkew. Delays of any size above the line do no harm. The fit cannot observe a delay
// common to all messages; that remains as an offset.
//
// Requests in the other direction make it observable. A request that left the host at a known time arrived
// when the counter showed a known value: that point lies on or below the line of the two clocks. The least
// distance between these points and the fitted line is the minimum round-trip delay. Half of it is
// subtracted (as NTP does, at the least round trip). That is exact if both ways delay equally; otherwise
// the error is half of their difference, at most half of the round trip.
//
// A message below the line by more than the fit's uncertainty is early: a delay cannot explain it. A single
// early message has a wrong counter; it is ignored. Only consecutive early messages that agree with each
// other show that a clock was set.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

namespace groma::clock {

// Nominal rate of the 64-bit device clock of a node: the DW1000's 63.8976 GHz.
inline constexpr double kDeviceTicksPerSecond = 63.8976e9;

struct HostInstant {
  double t_s = 0.0;
  double sigma_s = 0.0;  // of the fit and, once a request was observed, of the delay common to all messages
};

struct TimeMapperCounters {
  std::uint32_t observations = 0;
  std::uint32_t counter_restarts = 0;  // the counter fell back: the other side restarted
  std::uint32_t host_jumps = 0;        // arrivals no longer fit the counter: one of the clocks was set
  std::uint32_t early = 0;             // ignored
};

// The outcome of a message.
enum class Observation : std::uint8_t {
  kTaken,
  kEarly,      // ignored: its counter is ahead of the line
  kRestarted,  // the fit restarts with it
};

// Fixed memory, no allocation, reads no clock. Deterministic.
class TimeMapper {
 public:
  static constexpr double kMaxSkew = 100e-6;      // two crystals of 50 ppm
  static constexpr double kBinWidth_s = 0.125;    // each bin keeps the point with the least delay
  static constexpr std::size_t kBins = 240;       // a window of 30 s
  static constexpr double kDelayPrior_s = 0.010;  // prior of the mean jitter
  static constexpr double kSigmaFloor_s = 20e-6;  // accuracy of the arrival timestamps
  static constexpr double kJumpDelay_s = 0.020;   // if all arrivals are later than this ...
  static constexpr double kJumpDuration_s = 2.0;  // ... for this long, it is a clock jump, not jitter
  static constexpr std::uint32_t kJumpMessages = 8;
  static constexpr double kAgree_s = 0.010;         // early messages agree if they differ by at most this
  static constexpr std::size_t kRequests = 32;      // this many of the last requests are used ...
  static constexpr double kRequestWindow_s = 60.0;  // ... for this long

  // ticks_per_second: the counter's nominal rate.
  explicit TimeMapper(double ticks_per_second) noexcept : ticks_per_second_(ticks_per_second) {}

  // A message was handed to the link at `ticks` and arrived at `arrival_s` (host time); `transmission_s` of
  // that delay is its transmission. The fit restarts if the counter falls back or arrivals no longer fit:
  // they are late for kJumpDuration_s, or kJumpMessages consecutive early messages agree (fewer while the
  // fit has fewer), or all messages are early for kJumpDuration_s.
  Observation observe(std::int64_t ticks, double arrival_s, double transmission_s) noexcept;

  // A request left this host at `sent_s` (transmission included) and arrived when the counter showed
  // `ticks`. No effect before the first message.
  void observe_request(std::int64_t ticks, double sent_s) noexcept;

  // The minimum round-trip delay without transmission; nothing before a request. Half of it is subtracted
  // from each host time and bounds the error from unequal delays.
  [[nodiscard]] std::optional<double> round_trip_s() const noexcept { return round_trip_s_; }

  // The host time of a counter value; nothing before the first message. For increasing values between two
  // restarts, each result is no earlier than the previous one less that one's sigma.
  [[nodiscard]] std::optional<HostInstant> to_host(std::int64_t ticks) noexcept;

  // The counter at a host time; nothing before the first message.
  [[nodiscard]] std::optional<std::int64_t> to_ticks(double host_s) const noexcept;

  // The counter's rate by the host's clock over its nominal rate, less 1; 0 before the first message.
  [[nodiscard]] double skew() const noexcept { return 1.0 / (1.0 + slope_) - 1.0; }

  // Changes whenever the fit restarts; times of different epochs are not comparable.
  [[nodiscard]] std::uint32_t epoch() const noexcept { return epoch_; }
  [[nodiscard]] const TimeMapperCounters& counters() const noexcept { return counters_; }

  // Restarts without data, as after the link was reopened.
  void reset() noexcept;

 private:
  // x: seconds of the counter since reference_ticks_; y: arrival less transmission, less reference_s_, less
  // x.
  struct Point {
    double x_s = 0.0;
    double y_s = 0.0;
  };
  struct Converted {
    std::int64_t ticks = 0;
    HostInstant instant;
  };

  [[nodiscard]] double seconds_since_reference(std::int64_t ticks) const noexcept;
  [[nodiscard]] double line_at(double x_s) const noexcept { return offset_s_ + slope_ * (x_s - centre_s_); }
  [[nodiscard]] double sigma_at(double x_s) const noexcept;
  [[nodiscard]] const Point& point(std::size_t i) const noexcept { return points_[(first_ + i) % kBins]; }
  void start(std::int64_t ticks, double sent_s) noexcept;
  void insert(const Point& added) noexcept;
  void fit() noexcept;
  [[nodiscard]] bool is_early(const Point& added) const noexcept;
  // Whether the early message completes a run that shows a set clock.
  [[nodiscard]] bool completes_early_run(const Point& added) noexcept;
  [[nodiscard]] bool arrives_late_for_long(const Point& added) noexcept;
  void measure_round_trip() noexcept;
  [[nodiscard]] double shared_delay_s() const noexcept { return 0.5 * round_trip_s_.value_or(0.0); }

  double ticks_per_second_;
  std::int64_t reference_ticks_ = 0;
  double reference_s_ = 0.0;
  std::int64_t last_ticks_ = 0;

  std::array<Point, kBins> points_{};  // ring buffer, by x
  std::size_t first_ = 0;
  std::size_t size_ = 0;
  std::int64_t last_bin_ = 0;

  double centre_s_ = 0.0;  // mean of x
  double offset_s_ = 0.0;  // line at the centre
  double slope_ = 0.0;
  double fit_sigma_s_ = 0.0;

  std::array<Point, kRequests> requests_{};  // ring buffer
  std::size_t next_request_ = 0;
  std::size_t request_count_ = 0;
  std::optional<double> round_trip_s_;

  std::uint32_t late_messages_ = 0;  // in a row
  Point late_since_;

  std::uint32_t taken_ = 0;           // since the fit started, at most kJumpMessages
  std::uint32_t early_messages_ = 0;  // in a row
  std::uint32_t early_alike_ = 0;     // the last of these, which agree
  double early_by_s_ = 0.0;           // of the first that agrees
  double early_since_s_ = 0.0;        // host time, since reference_s_

  std::optional<Converted> last_converted_;
  std::uint32_t epoch_ = 0;
  TimeMapperCounters counters_;
};

}  // namespace groma::clock
