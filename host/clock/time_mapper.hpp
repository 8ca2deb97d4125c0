// From the counter of another clock to this host's time, over a link that delays.
//
// Each message carries the counter's value when it was sent and arrives after a delay that is never negative:
// the transmission time, which the caller knows, and jitter, which nobody does. The points (counter, arrival)
// therefore lie on or above the line that relates the two clocks, and the mapper fits that line from below:
// of all lines under all points of a sliding window it takes the one with the least sum of distances (Moon,
// Skelly and Towsley, "Estimation and removal of clock skew from network delay measurements", 1999), its
// slope within kMaxSkew. Delays of any size above the line cost nothing. What no such fit can see is a delay
// that all messages share: it stays in the result as an offset.
//
// Requests the other way tell of it. One that left the host at a known time was there when the counter showed
// a known value: that point lies on or below the line of the two clocks. The least distance between those
// points and the line from above is what both ways together delay at least. Half of it is taken off (as NTP
// does, at the least round trip): right where both ways delay alike, off by half of what they differ by, and
// by no more than that half itself.
//
// A message below the line by more than its fluctuation is early: no delay makes that. One early message has
// a wrong counter; it is left out and moves nothing. Only some in a row that agree with each other show that
// a clock was set.
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
  double sigma_s =
      0.0;  // of the fit and, where requests have told of it, of the delay that all messages share
};

struct TimeMapperCounters {
  std::uint32_t observations = 0;
  std::uint32_t counter_restarts = 0;  // the counter fell back: the other side was restarted
  std::uint32_t host_jumps = 0;        // arrivals no longer fit the counter: one of the clocks was set
  std::uint32_t early = 0;             // left out
};

// What became of a message.
enum class Observation : std::uint8_t {
  kTaken,
  kEarly,      // left out: its counter is ahead of the line
  kRestarted,  // the fit starts again with it
};

// Memory is fixed, nothing is allocated, no clock is read. Deterministic.
class TimeMapper {
 public:
  static constexpr double kMaxSkew = 100e-6;      // two crystals of 50 ppm
  static constexpr double kBinWidth_s = 0.125;    // one point is kept for each: that with the least delay
  static constexpr std::size_t kBins = 240;       // a window of 30 s
  static constexpr double kDelayPrior_s = 0.010;  // mean jitter assumed before there is any to see
  static constexpr double kSigmaFloor_s = 20e-6;  // reading a byte is not stamped better
  static constexpr double kJumpDelay_s = 0.020;   // arrivals later than this ...
  static constexpr double kJumpDuration_s = 2.0;  // ... all of them, for so long, are a jump and no jitter
  static constexpr std::uint32_t kJumpMessages = 8;
  static constexpr double kAgree_s = 0.010;         // early messages of one set clock differ by no more
  static constexpr std::size_t kRequests = 32;      // the last ones count ...
  static constexpr double kRequestWindow_s = 60.0;  // ... for so long

  // ticks_per_second: the counter's nominal rate.
  explicit TimeMapper(double ticks_per_second) noexcept : ticks_per_second_(ticks_per_second) {}

  // A message that was handed to the link at `ticks` has arrived at `arrival_s` of the host's clock, of which
  // its transmission took `transmission_s`. A counter that falls back, and arrivals that no longer fit, start
  // the fit again. kJumpMessages early ones in a row that agree do so, fewer while fewer were taken; or early
  // ones alone for kJumpDuration_s.
  Observation observe(std::int64_t ticks, double arrival_s, double transmission_s) noexcept;

  // A request that had left this host, its transmission included, at `sent_s` was there when the counter
  // showed `ticks`. Without effect before the first message.
  void observe_request(std::int64_t ticks, double sent_s) noexcept;

  // What both ways together delay at least, transmission aside; nothing before a request. Half of it is taken
  // off each instant, and bounds its error from delays that differ.
  [[nodiscard]] std::optional<double> round_trip_s() const noexcept { return round_trip_s_; }

  // Host time of a value of the counter; nothing before the first message. Where values come in rising order,
  // between two restarts, each result is no earlier than the one before less the sigma stated with that.
  [[nodiscard]] std::optional<HostInstant> to_host(std::int64_t ticks) noexcept;

  // The counter at a host time; nothing before the first message.
  [[nodiscard]] std::optional<std::int64_t> to_ticks(double host_s) const noexcept;

  // The counter's rate over its nominal one, by the host, less 1; 0 before the first message.
  [[nodiscard]] double skew() const noexcept { return 1.0 / (1.0 + slope_) - 1.0; }

  // Changes whenever the fit is started anew; instants of different epochs do not compare.
  [[nodiscard]] std::uint32_t epoch() const noexcept { return epoch_; }
  [[nodiscard]] const TimeMapperCounters& counters() const noexcept { return counters_; }

  // Starts anew, as when the link was opened again.
  void reset() noexcept;

 private:
  // x: seconds of the counter since reference_ticks_; y: arrival less transmission, less reference_s_, less
  // x.
  struct Point {
    double x_s = 0.0;
    double y_s = 0.0;
  };
  struct Stamp {
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

  std::array<Point, kBins> points_{};  // a ring, by x
  std::size_t first_ = 0;
  std::size_t size_ = 0;
  std::int64_t last_bin_ = 0;

  double centre_s_ = 0.0;  // mean of x
  double offset_s_ = 0.0;  // line at the centre
  double slope_ = 0.0;
  double fit_sigma_s_ = 0.0;

  std::array<Point, kRequests> requests_{};  // a ring
  std::size_t next_request_ = 0;
  std::size_t request_count_ = 0;
  std::optional<double> round_trip_s_;

  std::uint32_t late_messages_ = 0;  // in a row
  Point late_since_;

  std::uint32_t taken_ = 0;           // since the fit started
  std::uint32_t early_messages_ = 0;  // in a row
  std::uint32_t early_alike_ = 0;     // the last ones of these, which agree
  double early_by_s_ = 0.0;           // of the first of those
  double early_since_s_ = 0.0;        // host time, since reference_s_

  std::optional<Stamp> last_stamp_;
  std::uint32_t epoch_ = 0;
  TimeMapperCounters counters_;
};

}  // namespace groma::clock
