#include "host/daemon/anchor_learner.hpp"

#include <fmt/format.h>
#include <sys/resource.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <limits>
#include <set>
#include <utility>

#include "host/calibration/verdict.hpp"
#include "host/daemon/sample_digest.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
namespace {

// Of the solver's thread; localization has priority.
constexpr int kNiceness = 10;

double sigma_xy_m(const model::AnchorCalibration& anchor) {
  return std::sqrt(std::max(anchor.covariance(0, 0), anchor.covariance(1, 1)));
}

calibration::LearningStep learn_with_digest(const calibration::LearningInput& input) {
  calibration::LearningStep step = calibration::learn(input);
  if (step.calibrated) {
    step.calibrated->calibration.input_sha256 = sample_digest(step.samples.ranges, step.samples.poses);
  }
  return step;
}

calibration::LearningStep learn_in_background(const calibration::LearningInput& input) {
  // On Linux this sets the priority of the calling thread only.
  ::setpriority(PRIO_PROCESS, static_cast<id_t>(::gettid()), kNiceness);
  return learn_with_digest(input);
}

}  // namespace

std::string_view state_word(AnchorState state) noexcept {
  switch (state) {
    case AnchorState::kKnown:
      return "known";
    case AnchorState::kLearning:
      return "learning";
    case AnchorState::kLive:
      return "live";
    case AnchorState::kMoved:
      return "moved";
  }
  return "";
}

AnchorLearner::AnchorLearner(Setup setup) : setup_(std::move(setup)), store_(setup_.limits) {
  std::erase_if(setup_.earlier.anchors, [](const auto& anchor) { return !model::has_position(anchor); });
  live_ = setup_.earlier;
}

void AnchorLearner::on_range(const model::RangeSample& range) {
  store_.add(range);
}

void AnchorLearner::on_pose_prior(const model::PoseSample& pose) {
  if (setup_.poses == Poses::kPriors) store_.add(pose);
}

void AnchorLearner::on_filter_pose(const model::PoseSample& pose) {
  if (setup_.poses == Poses::kFilter) store_.add(pose);
}

void AnchorLearner::on_clock_set() {
  store_.clear();
  suspicion_.clear();
  solved_segments_ = 0;
  next_step_s_ = -std::numeric_limits<double>::infinity();
  next_places_s_ = next_step_s_;
  begin_s_ = std::numeric_limits<double>::quiet_NaN();
}

calibration::LearningInput AnchorLearner::input(bool all_places) const {
  return {.places = all_places ? std::optional(store_.places()) : std::nullopt,
          .recent = store_.recent(),
          .live = live_,
          .tags = setup_.tags,
          .surface = setup_.surface,
          .priors = setup_.priors};
}

bool AnchorLearner::service() {
  bool changed = false;
  if (solving_.valid()) {
    if (solving_.wait_for(std::chrono::seconds(0)) != std::future_status::ready) return false;
    changed = take(solving_.get(), false);
  }
  if (store_.closed() == solved_segments_ || store_.last_s() < next_step_s_) return changed;
  solved_segments_ = store_.closed();
  next_step_s_ = store_.last_s() + setup_.step_s;
  const bool all_places = store_.last_s() >= next_places_s_;
  if (all_places) {
    if (std::isnan(begin_s_)) begin_s_ = store_.last_s();
    next_places_s_ = store_.last_s() + std::clamp(kLongerShare * (store_.last_s() - begin_s_), setup_.step_s,
                                                  std::max(setup_.step_s, kMaxBetween_s));
  }
  if (!setup_.threaded) return take(learn_with_digest(input(all_places)), false) || changed;
  solving_ =
      std::async(std::launch::async, [input = input(all_places)] { return learn_in_background(input); });
  return changed;
}

bool AnchorLearner::finish() {
  bool changed = false;
  if (solving_.valid()) changed = take(solving_.get(), false);
  store_.close();
  return take(learn_with_digest(input(true)), true) || changed;
}

bool AnchorLearner::take(calibration::LearningStep step, bool last) {
  ++steps_;
  const bool solved = step.calibrated.has_value();
  if (solved) calibrated_ = std::move(*step.calibrated);
  const bool moved = remove_moved(step.rechecked);
  for (const model::AnchorCalibration& anchor : calibrated_.calibration.anchors) {
    // The anchor moved before it was good enough to be used: discard its ranges from the former position.
    if (anchor.verdict == model::AnchorVerdict::kMoved && model::find_anchor(live_, anchor.id) == nullptr) {
      store_.forget(anchor.id, store_.last_s() - setup_.limits.segment_s *
                                                     static_cast<double>(setup_.limits.recent_segments));
    }
  }
  const bool adopted = solved && adopt_calibrated(last);
  if (moved || adopted) live_.verdict = calibration::judge_site(live_.anchors);
  return moved || adopted;
}

bool AnchorLearner::remove_moved(const std::vector<calibration::AnchorChange>& rechecked) {
  bool changed = false;
  std::map<model::NodeId, int> suspicion;
  for (const calibration::AnchorChange& change : rechecked) {
    if (!change.moved || model::find_anchor(live_, change.id) == nullptr) continue;
    const int times = suspicion_[change.id] + 1;
    if (times < kMovedSteps) {
      suspicion[change.id] = times;
      continue;
    }
    std::erase_if(live_.anchors, [&](const auto& anchor) { return anchor.id == change.id; });
    std::erase_if(setup_.earlier.anchors, [&](const auto& anchor) { return anchor.id == change.id; });
    std::erase_if(calibrated_.calibration.anchors,
                  [&](const auto& anchor) { return anchor.id == change.id; });
    store_.forget(change.id, store_.last_s());
    moved_m_[change.id] = change.displacement_m.norm();
    news_.push_back(
        fmt::format("anchor {} moved by {:.2f} m; it is not used until its new position is calibrated",
                    change.id, moved_m_[change.id]));
    changed = true;
  }
  suspicion_ = std::move(suspicion);
  return changed;
}

bool AnchorLearner::is_earlier(model::NodeId id) const {
  return model::find_anchor(setup_.earlier, id) != nullptr;
}

// The calibrated anchors belong to one joint solution, so they are adopted together.
bool AnchorLearner::adopt_calibrated(bool last) {
  bool wanted = false;
  std::vector<model::AnchorCalibration> calibrated;
  for (const model::AnchorCalibration& anchor : calibrated_.calibration.anchors) {
    if (is_earlier(anchor.id) || !calibration::carries(anchor)) continue;
    calibrated.push_back(anchor);
    const model::AnchorCalibration* before = model::find_anchor(live_, anchor.id);
    if (before == nullptr) {
      news_.push_back(fmt::format("anchor {} is calibrated: verdict {}, {} ranges, sigma {:.2f} m", anchor.id,
                                  io::word(anchor.verdict), anchor.ranges_used, sigma_xy_m(anchor)));
      moved_m_.erase(anchor.id);
    }
    wanted = wanted || last || before == nullptr || sigma_xy_m(anchor) < kBetterShare * sigma_xy_m(*before);
  }
  if (!wanted) return false;
  const model::Calibration before = std::exchange(live_, setup_.earlier);
  if (setup_.earlier.anchors.empty()) {
    live_.common_frame_covariance = calibrated_.calibration.common_frame_covariance;
    live_.range_delay_s = calibrated_.calibration.range_delay_s;
    live_.range_delay_sigma_s = calibrated_.calibration.range_delay_sigma_s;
    live_.range_noise = calibrated_.calibration.range_noise;
    live_.tags = calibrated_.calibration.tags;
  } else {
    // The filter's poses share the frame error of the anchors that it tracks by.
    for (model::AnchorCalibration& anchor : calibrated) {
      model::add_common_frame(anchor, live_.common_frame_covariance);
    }
  }
  live_.input_sha256 = calibrated_.calibration.input_sha256;
  live_.program_version = io::program_version();
  live_.anchors.insert(live_.anchors.end(), calibrated.begin(), calibrated.end());
  // An anchor in use that this solution lacks stays unchanged.
  for (const model::AnchorCalibration& anchor : before.anchors) {
    if (model::find_anchor(live_, anchor.id) == nullptr) live_.anchors.push_back(anchor);
  }
  std::sort(live_.anchors.begin(), live_.anchors.end(),
            [](const auto& a, const auto& b) { return a.id < b.id; });
  return true;
}

std::vector<AnchorProgress> AnchorLearner::progress() const {
  std::set<model::NodeId> ids;
  for (const auto& anchor : live_.anchors) ids.insert(anchor.id);
  for (const auto& anchor : calibrated_.calibration.anchors) ids.insert(anchor.id);
  for (const auto& [id, distance_m] : moved_m_) ids.insert(id);
  std::vector<AnchorProgress> out;
  for (const model::NodeId id : ids) {
    const model::AnchorCalibration* live = model::find_anchor(live_, id);
    const model::AnchorCalibration* calibrated = model::find_anchor(calibrated_.calibration, id);
    const model::AnchorCalibration* anchor = live != nullptr ? live : calibrated;
    AnchorProgress& progress = out.emplace_back();
    progress.id = id;
    if (live != nullptr) {
      progress.state = is_earlier(id) ? AnchorState::kKnown : AnchorState::kLive;
    } else {
      progress.state = moved_m_.contains(id) ? AnchorState::kMoved : AnchorState::kLearning;
    }
    if (anchor == nullptr) {
      progress.advice = "drive past it to calibrate its new position";
      continue;
    }
    progress.coverage = live != nullptr ? 1.0 : calibration::coverage(*anchor);
    progress.verdict = anchor->verdict;
    progress.advice = anchor->advice;
    progress.drive_to_m = anchor->drive_to_m;
    progress.ranges_used = calibrated != nullptr ? calibrated->ranges_used : 0;
    if (model::has_position(*anchor)) progress.sigma_m = sigma_xy_m(*anchor);
  }
  return out;
}

std::vector<std::string> AnchorLearner::take_news() {
  return std::exchange(news_, {});
}

}  // namespace groma::daemon
