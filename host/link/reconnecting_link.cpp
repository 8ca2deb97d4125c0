#include "host/link/reconnecting_link.hpp"

#include <algorithm>

namespace groma::link {

bool ReconnectingLink::service(double now_s) {
  if (link_ || now_s < next_attempt_s_) return false;
  OpenedLink opened = open_();
  if (opened.link) {
    link_ = std::move(opened.link);
    last_error_ = {};
    ++counters_.opened;
    return true;
  }
  last_error_ = std::move(opened.error);
  if (opened.pending) {
    next_attempt_s_ = now_s + kPendingWait_s;
    return false;
  }
  ++counters_.attempts_failed;
  next_attempt_s_ = now_s + wait_s_;
  wait_s_ = std::min(2.0 * wait_s_, kLongestWait_s);
  return false;
}

ReadResult ReconnectingLink::read(std::span<std::uint8_t> out, double now_s) {
  if (!link_) return {};
  const ReadResult result = link_->read(out);
  if (result.bytes > 0) wait_s_ = kFirstWait_s;
  if (result.gone) {
    can_before_ = can_counters();
    link_.reset();
    ++counters_.lost;
    next_attempt_s_ = now_s + wait_s_;
    wait_s_ = std::min(2.0 * wait_s_, kLongestWait_s);
  }
  return result;
}

std::optional<CanCounters> ReconnectingLink::can_counters() const {
  const CanCounters* const now = link_ ? link_->can_counters() : nullptr;
  if (now == nullptr) return can_before_;
  CanCounters sum = can_before_.value_or(CanCounters{});
  return sum += *now;
}

}  // namespace groma::link
