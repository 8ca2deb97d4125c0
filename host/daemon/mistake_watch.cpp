#include "host/daemon/mistake_watch.hpp"

#include <fmt/format.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <ctime>
#include <limits>
#include <utility>

#include "host/diagnosis/diagnose.hpp"
#include "host/diagnosis/thinning.hpp"

namespace groma::daemon {
namespace {

constexpr double kNever_s = -std::numeric_limits<double>::infinity();
// By hand: what dead reckoning needs, and what a search looks at.
constexpr double kOdometryPeriod_s = 0.05;
constexpr double kMostRanges_hz = 100.0;
constexpr double kLongestHold_s = 0.5;

// What the calling thread has used of a processor, s.
double thread_time_s() noexcept {
  timespec used{};
  ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &used);
  return static_cast<double>(used.tv_sec) + 1e-9 * static_cast<double>(used.tv_nsec);
}

bool names(const std::vector<diagnosis::Finding>& findings, const diagnosis::Finding& other) {
  return std::any_of(findings.begin(), findings.end(), [&](const diagnosis::Finding& finding) {
    return finding.cause == other.cause && finding.of == other.of;
  });
}

}  // namespace

MistakeWatch::MistakeWatch(Setup setup)
    : setup_(std::move(setup)),
      odometry_(static_cast<std::size_t>(1.1 * kKept_s / kOdometryPeriod_s)),
      ranges_(static_cast<std::size_t>(1.2 * kKept_s * kMostRanges_hz)),
      begin_s_(kNever_s),
      newest_s_(kNever_s),
      second_s_(kNever_s) {}

void MistakeWatch::use(model::Calibration calibration, std::vector<model::Tag> tags) {
  calibration_ = std::move(calibration);
  tags_ = std::move(tags);
  forget();
}

void MistakeWatch::forget() {
  is_void_ = search_.valid();
  before_.clear();
  findings_.clear();
}

// A sample holds until the next one.
void MistakeWatch::on_odometry(const model::OdometrySample& sample) {
  constexpr double kLargest = 1e6;  // larger values are no speeds in any unit
  if (!(std::abs(sample.vx_mps) < kLargest && std::abs(sample.vy_mps) < kLargest &&
        std::abs(sample.omega_radps) < kLargest))
    return;
  if (begin_s_ == kNever_s) begin_s_ = sample.t_s;
  newest_s_ = std::max(newest_s_, sample.t_s);
  if (held_) {
    const double held_s = std::clamp(sample.t_s - held_->t_s, 0.0, kLongestHold_s);
    if (mean_over_s_ == 0.0) mean_ = {.t_s = held_->t_s};
    mean_.vx_mps += held_->vx_mps * held_s;
    mean_.vy_mps += held_->vy_mps * held_s;
    mean_.omega_radps += held_->omega_radps * held_s;
    mean_over_s_ += held_s;
    moved_m_ += std::hypot(held_->vx_mps, held_->vy_mps) * held_s;
    if (mean_over_s_ >= kOdometryPeriod_s - 1e-6) {
      odometry_.push({mean_.t_s, mean_.vx_mps / mean_over_s_, mean_.vy_mps / mean_over_s_,
                      mean_.omega_radps / mean_over_s_});
      mean_over_s_ = 0.0;
    }
  }
  held_ = sample;
}

void MistakeWatch::on_range(const model::RangeSample& range) {
  if (range.t_s - second_s_ >= 1.0) {
    share_kept_ = kMostRanges_hz / std::max(kMostRanges_hz, static_cast<double>(ranges_this_second_));
    ranges_this_second_ = 0;
    second_s_ = range.t_s;
  }
  ++ranges_this_second_;
  if (diagnosis::is_kept(ranges_seen_++, share_kept_)) ranges_.push(range);
}

void MistakeWatch::on_clock_set() {
  odometry_.clear();
  ranges_.clear();
  held_.reset();
  mean_over_s_ = 0.0;
  begin_s_ = newest_s_ = second_s_ = kNever_s;
  moved_m_ = 0.0;
  forget();
}

bool MistakeWatch::is_due(double now_s) const noexcept {
  return calibration_ && now_s >= next_search_s_ && newest_s_ - begin_s_ >= kLeast_s &&
         moved_m_ >= kLeastMotion_m;
}

diagnosis::Data MistakeWatch::data() const {
  return {.poses = {},
          .odometry = odometry_.since(newest_s_ - kKept_s),
          .ranges = ranges_.since(newest_s_ - kKept_s),
          .dropped_ranges = {},
          .tags = tags_,
          .anchors = {},
          .priors = setup_.priors,
          .surface = setup_.surface};
}

void MistakeWatch::service(double now_s) {
  if (search_.valid()) {
    if (search_.wait_for(std::chrono::seconds(0)) != std::future_status::ready) return;
    Search search = search_.get();
    next_search_s_ = now_s + std::max(kPeriod_s, kRest * search.took_s);
    if (!std::exchange(is_void_, false)) take(std::move(search));
  }
  if (!is_due(now_s)) return;
  moved_m_ = 0.0;
  search_ = std::async(std::launch::async, [data = data(), calibration = *calibration_,
                                            niceness = setup_.search_niceness]() mutable {
    // On Linux this sets the priority of the calling thread only.
    ::setpriority(PRIO_PROCESS, static_cast<id_t>(::gettid()), niceness);
    const auto by_time = [](const auto& a, const auto& b) { return a.t_s < b.t_s; };
    std::stable_sort(data.ranges.begin(), data.ranges.end(), by_time);
    std::stable_sort(data.odometry.begin(), data.odometry.end(), by_time);
    Search search{.findings = diagnosis::diagnose(std::move(data), calibration), .took_s = 0.0};
    search.took_s = thread_time_s();
    return search;
  });
}

void MistakeWatch::take(Search search) {
  if (setup_.learns) {
    std::erase_if(search.findings,
                  [](const diagnosis::Finding& finding) { return finding.cause == "unknown-anchor"; });
  }
  const std::vector<diagnosis::Finding> before = std::exchange(before_, search.findings);
  findings_ = std::move(search.findings);
  // Once may be by chance.
  std::erase_if(findings_, [&](const diagnosis::Finding& finding) { return !names(before, finding); });
}

std::vector<std::string> MistakeWatch::take_news() {
  std::vector<std::string> lines;
  std::vector<std::string_view> causes;
  for (const diagnosis::Finding& finding : findings_) {
    causes.push_back(finding.cause);
    if (std::find(news_.begin(), news_.end(), finding.cause) != news_.end()) continue;
    lines.push_back(fmt::format("{}: {}; {}", finding.cause, finding.evidence, finding.remedy));
  }
  news_ = std::move(causes);
  return lines;
}

}  // namespace groma::daemon
