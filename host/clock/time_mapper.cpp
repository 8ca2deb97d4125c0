#include "host/clock/time_mapper.hpp"

#include <algorithm>
#include <cmath>

namespace groma::clock {
namespace {

// A message is early if it lies below the line by more than this many sigmas plus this margin.
constexpr double kEarlySigmas = 5.0;
constexpr double kEarlyMargin_s = 0.005;

// With exponential jitter of mean s in n bins the least delay is about s/n. The factor is larger than 1
// because the line touches two such points and is used at the end of its window, not in the middle.
constexpr double kFitFactor = 6.0;

// Weight of the jitter prior, in bins.
constexpr double kDelayPriorBins = 2.0;

}  // namespace

double TimeMapper::seconds_since_reference(std::int64_t ticks) const noexcept {
  return static_cast<double>(ticks - reference_ticks_) / ticks_per_second_;
}

Observation TimeMapper::observe(std::int64_t ticks, double arrival_s, double transmission_s) noexcept {
  ++counters_.observations;
  const double sent_s = arrival_s - transmission_s;
  if (size_ == 0) {
    start(ticks, sent_s);
    return Observation::kTaken;
  }
  if (ticks < last_ticks_) {
    ++counters_.counter_restarts;
    start(ticks, sent_s);
    return Observation::kRestarted;
  }
  const double x_s = seconds_since_reference(ticks);
  const Point added{x_s, sent_s - reference_s_ - x_s};
  const bool early = is_early(added);
  if (early && !completes_early_run(added)) {
    ++counters_.early;
    return Observation::kEarly;
  }
  if (early || arrives_late_for_long(added)) {
    ++counters_.host_jumps;
    start(ticks, sent_s);
    taken_ = early ? std::min(early_alike_, kJumpMessages) : kJumpMessages;
    return Observation::kRestarted;
  }
  early_messages_ = 0;
  last_ticks_ = ticks;
  taken_ = std::min(taken_ + 1, kJumpMessages);
  insert(added);
  fit();
  measure_round_trip();
  return Observation::kTaken;
}

bool TimeMapper::is_early(const Point& added) const noexcept {
  const double delay_s = added.y_s - line_at(added.x_s);
  return delay_s < -(kEarlySigmas * sigma_at(added.x_s) + kEarlyMargin_s);
}

bool TimeMapper::completes_early_run(const Point& added) noexcept {
  const double by_s = line_at(added.x_s) - added.y_s;
  const double host_s = added.x_s + added.y_s;
  if (early_messages_++ == 0) early_since_s_ = host_s;
  if (early_messages_ == 1 || std::abs(by_s - early_by_s_) > kAgree_s) {
    early_by_s_ = by_s;
    early_alike_ = 0;
  }
  ++early_alike_;
  // If few messages were taken before, those may be the wrong ones.
  return early_alike_ >= taken_ ||
         (early_messages_ >= kJumpMessages && host_s - early_since_s_ >= kJumpDuration_s);
}

void TimeMapper::observe_request(std::int64_t ticks, double sent_s) noexcept {
  if (size_ == 0) return;
  const double x_s = seconds_since_reference(ticks);
  requests_[next_request_] = {x_s, sent_s - reference_s_ - x_s};
  next_request_ = (next_request_ + 1) % kRequests;
  request_count_ = std::min(request_count_ + 1, kRequests);
  measure_round_trip();
}

void TimeMapper::measure_round_trip() noexcept {
  round_trip_s_.reset();
  for (std::size_t i = 0; i < request_count_; ++i) {
    const Point& request = requests_[(next_request_ + kRequests - 1 - i) % kRequests];
    if (point(size_ - 1).x_s - request.x_s > kRequestWindow_s) break;
    // The line has an error, but a round trip cannot be negative.
    const double both_s = std::max(line_at(request.x_s) - request.y_s, 0.0);
    round_trip_s_ = std::min(both_s, round_trip_s_.value_or(both_s));
  }
}

std::optional<HostInstant> TimeMapper::to_host(std::int64_t ticks) noexcept {
  if (size_ == 0) return std::nullopt;
  const double x_s = seconds_since_reference(ticks);
  HostInstant instant{reference_s_ + x_s + line_at(x_s) - shared_delay_s(),
                      // Uniform within half of the round trip either way: unequal delays.
                      std::hypot(sigma_at(x_s), shared_delay_s() / std::sqrt(3.0))};
  if (last_converted_ && ticks >= last_converted_->ticks) {
    const double earliest_s = last_converted_->instant.t_s - last_converted_->instant.sigma_s;
    if (instant.t_s < earliest_s) {
      instant.sigma_s += earliest_s - instant.t_s;
      instant.t_s = earliest_s;
    }
  }
  last_converted_ = Converted{ticks, instant};
  return instant;
}

std::optional<std::int64_t> TimeMapper::to_ticks(double host_s) const noexcept {
  if (size_ == 0) return std::nullopt;
  // host = reference + x + offset + slope (x - centre)
  const double x_s =
      (host_s + shared_delay_s() - reference_s_ - offset_s_ + slope_ * centre_s_) / (1.0 + slope_);
  return reference_ticks_ + std::llround(x_s * ticks_per_second_);
}

void TimeMapper::reset() noexcept {
  size_ = 0;
  slope_ = 0.0;
  last_converted_.reset();
  request_count_ = 0;
  round_trip_s_.reset();
}

void TimeMapper::start(std::int64_t ticks, double sent_s) noexcept {
  reference_ticks_ = ticks;
  reference_s_ = sent_s;
  last_ticks_ = ticks;
  first_ = 0;
  size_ = 0;
  late_messages_ = 0;
  early_messages_ = 0;
  taken_ = 1;
  last_converted_.reset();
  request_count_ = 0;
  round_trip_s_.reset();
  ++epoch_;
  insert(Point{});
  fit();
}

void TimeMapper::insert(const Point& added) noexcept {
  const auto bin = static_cast<std::int64_t>(std::floor(added.x_s / kBinWidth_s));
  // After a pause, points from another temperature of the crystal must not remain.
  while (size_ > 0 && added.x_s - point(0).x_s > kBinWidth_s * static_cast<double>(kBins)) {
    first_ = (first_ + 1) % kBins;
    --size_;
  }
  if (size_ > 0 && bin == last_bin_) {
    Point& last = points_[(first_ + size_ - 1) % kBins];
    // Keep the smaller delay above the line.
    if (added.y_s - line_at(added.x_s) <= last.y_s - line_at(last.x_s)) last = added;
    return;
  }
  last_bin_ = bin;
  if (size_ == kBins) {
    first_ = (first_ + 1) % kBins;
    --size_;
  }
  points_[(first_ + size_) % kBins] = added;
  ++size_;
}

void TimeMapper::fit() noexcept {
  // Lower convex hull of the points, which are sorted by x.
  std::array<std::size_t, kBins> hull{};
  std::size_t corners = 0;
  double sum_x_s = 0.0;
  for (std::size_t i = 0; i < size_; ++i) {
    const Point& p = point(i);
    sum_x_s += p.x_s;
    while (corners >= 2) {
      const Point& a = point(hull[corners - 2]);
      const Point& b = point(hull[corners - 1]);
      if ((b.x_s - a.x_s) * (p.y_s - a.y_s) - (b.y_s - a.y_s) * (p.x_s - a.x_s) > 0.0) break;
      --corners;
    }
    hull[corners++] = i;
  }
  centre_s_ = sum_x_s / static_cast<double>(size_);

  // The line under all points with the least sum of distances is the highest one at the mean of x: that of
  // the hull's edge there. If its slope is out of bounds, the nearest bound is the best.
  slope_ = 0.0;
  for (std::size_t i = 1; i < corners; ++i) {
    const Point& a = point(hull[i - 1]);
    const Point& b = point(hull[i]);
    if (b.x_s >= centre_s_) {
      slope_ = std::clamp((b.y_s - a.y_s) / (b.x_s - a.x_s), -kMaxSkew, kMaxSkew);
      break;
    }
  }
  offset_s_ = point(hull[0]).y_s + slope_ * (centre_s_ - point(hull[0]).x_s);
  for (std::size_t i = 1; i < corners; ++i) {
    const Point& p = point(hull[i]);
    offset_s_ = std::min(offset_s_, p.y_s + slope_ * (centre_s_ - p.x_s));
  }

  double sum_delay_s = kDelayPriorBins * kDelayPrior_s;
  for (std::size_t i = 0; i < size_; ++i) sum_delay_s += point(i).y_s - line_at(point(i).x_s);
  const double bins = static_cast<double>(size_);
  fit_sigma_s_ = kFitFactor * sum_delay_s / ((bins + kDelayPriorBins) * bins);
}

double TimeMapper::sigma_at(double x_s) const noexcept {
  const double oldest_s = point(0).x_s;
  const double newest_s = point(size_ - 1).x_s;
  const double span_s = newest_s - oldest_s;
  const double skew_sigma = 2.0 * fit_sigma_s_ < kMaxSkew * span_s ? 2.0 * fit_sigma_s_ / span_s : kMaxSkew;
  const double outside_s = std::max({0.0, x_s - newest_s, oldest_s - x_s});
  return std::hypot(kSigmaFloor_s, fit_sigma_s_, skew_sigma * outside_s);
}

bool TimeMapper::arrives_late_for_long(const Point& added) noexcept {
  if (added.y_s - line_at(added.x_s) < kJumpDelay_s + kEarlySigmas * sigma_at(added.x_s)) {
    late_messages_ = 0;
    return false;
  }
  if (late_messages_++ == 0) late_since_ = added;
  // The duration must have passed on both clocks: messages piled up for a stalled reader span seconds of the
  // counter, but arrive at once.
  const double device_s = added.x_s - late_since_.x_s;
  const double host_s = device_s + added.y_s - late_since_.y_s;
  return late_messages_ >= kJumpMessages && device_s >= kJumpDuration_s && host_s >= kJumpDuration_s;
}

}  // namespace groma::clock
