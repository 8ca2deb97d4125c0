#include "firmware/sim/emulator/nvic.hpp"

#include <algorithm>
#include <bit>

namespace groma::sim {
namespace {

// Exceptions that no register disables.
constexpr std::uint64_t kAlwaysEnabled = 1ULL << exception::kNmi | 1ULL << exception::kHardFault |
                                         1ULL << exception::kSvCall | 1ULL << exception::kPendSv |
                                         1ULL << exception::kSysTick;

}  // namespace

void Nvic::reset() noexcept {
  const std::uint64_t line = line_;
  *this = Nvic{};
  enabled_ = kAlwaysEnabled;
  line_ = line;
  pending_ = line;
}

void Nvic::set_line(unsigned exception, bool level) noexcept {
  if (level && (line_ & bit(exception)) == 0) pending_ |= bit(exception);
  line_ = level ? line_ | bit(exception) : line_ & ~bit(exception);
}

void Nvic::clear_pending(unsigned exception) noexcept {
  pending_ &= ~bit(exception);
  pending_ |= line_ & ~active_ & bit(exception);
}

void Nvic::enable(unsigned exception, bool on) noexcept {
  enabled_ = on ? enabled_ | bit(exception) : enabled_ & ~bit(exception);
}

void Nvic::activate(unsigned exception) noexcept {
  pending_ &= ~bit(exception);
  active_ |= bit(exception);
}

void Nvic::deactivate(unsigned exception) noexcept {
  active_ &= ~bit(exception);
  pending_ |= line_ & bit(exception);
}

void Nvic::set_active(unsigned exception, bool on) noexcept {
  active_ = on ? active_ | bit(exception) : active_ & ~bit(exception);
}

unsigned Nvic::active_count() const noexcept {
  return static_cast<unsigned>(std::popcount(active_));
}

int Nvic::priority(unsigned exception) const noexcept {
  if (exception == exception::kNmi) return -2;
  if (exception == exception::kHardFault) return -1;
  return priority_[exception];
}

int Nvic::group_of(int priority) const noexcept {
  return priority < 0 ? priority : priority & ~((2 << prigroup_) - 1);
}

int Nvic::group_priority(unsigned exception) const noexcept {
  return group_of(priority(exception));
}

unsigned Nvic::best_pending() const noexcept {
  unsigned best = 0;
  for (std::uint64_t left = pending_ & enabled_; left != 0; left &= left - 1) {
    const auto candidate = static_cast<unsigned>(std::countr_zero(left));
    if (best == 0 || priority(candidate) < priority(best)) best = candidate;
  }
  return best;
}

int Nvic::execution_priority(const ExceptionMasks& masks) const noexcept {
  int highest = kThreadPriority;
  for (std::uint64_t left = active_; left != 0; left &= left - 1) {
    highest = std::min(highest, priority(static_cast<unsigned>(std::countr_zero(left))));
  }
  if (highest < kThreadPriority) highest = group_of(highest);
  int boosted = kThreadPriority;
  if (masks.basepri != 0) boosted = group_of(masks.basepri & 0xE0);
  if (masks.primask) boosted = 0;
  if (masks.faultmask) boosted = -1;
  return std::min(highest, boosted);
}

}  // namespace groma::sim
