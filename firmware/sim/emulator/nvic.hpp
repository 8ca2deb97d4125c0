// The interrupt controller's state: pending, active and enabled exceptions, and their priorities.
// Exception numbers are those of the ARMv7-M Architecture Reference Manual (DDI 0403E), table B1-4.
#pragma once

#include <array>
#include <cstdint>

namespace groma::sim {

namespace exception {
inline constexpr unsigned kNmi = 2;
inline constexpr unsigned kHardFault = 3;
inline constexpr unsigned kMemManage = 4;
inline constexpr unsigned kBusFault = 5;
inline constexpr unsigned kUsageFault = 6;
inline constexpr unsigned kSvCall = 11;
inline constexpr unsigned kDebugMonitor = 12;
inline constexpr unsigned kPendSv = 14;
inline constexpr unsigned kSysTick = 15;
inline constexpr unsigned kFirstIrq = 16;
}  // namespace exception

// The mask registers' values.
struct ExceptionMasks {
  bool primask = false;
  bool faultmask = false;
  std::uint8_t basepri = 0;
};

class Nvic {
 public:
  static constexpr unsigned kExceptions = 64;  // 48 interrupts
  static constexpr int kThreadPriority = 256;

  void reset() noexcept;

  // A level-sensitive line (B3.4.1): pends while it is high and its handler is not active.
  void set_line(unsigned exception, bool level) noexcept;
  void pend(unsigned exception) noexcept { pending_ |= bit(exception); }
  // A line that is still high pends again.
  void clear_pending(unsigned exception) noexcept;
  void enable(unsigned exception, bool on) noexcept;
  void activate(unsigned exception) noexcept;
  void deactivate(unsigned exception) noexcept;
  void set_active(unsigned exception, bool on) noexcept;  // by a write to SHCSR

  [[nodiscard]] bool pending(unsigned exception) const noexcept { return (pending_ & bit(exception)) != 0; }
  [[nodiscard]] bool active(unsigned exception) const noexcept { return (active_ & bit(exception)) != 0; }
  [[nodiscard]] bool enabled(unsigned exception) const noexcept { return (enabled_ & bit(exception)) != 0; }
  [[nodiscard]] unsigned active_count() const noexcept;
  [[nodiscard]] bool interrupt_pending() const noexcept { return (pending_ >> exception::kFirstIrq) != 0; }
  [[nodiscard]] bool any_enabled_pending() const noexcept { return (pending_ & enabled_) != 0; }
  // For SCR.SEVONPEND, which needs newly pending exceptions.
  [[nodiscard]] std::uint64_t pending_bits() const noexcept { return pending_; }

  // Three bits are implemented (bits 7 to 5).
  void set_priority(unsigned exception, std::uint8_t value) noexcept { priority_[exception] = value & 0xE0; }
  [[nodiscard]] std::uint8_t priority_register(unsigned exception) const noexcept {
    return priority_[exception];
  }
  void set_priority_grouping(unsigned prigroup) noexcept { prigroup_ = prigroup; }
  [[nodiscard]] unsigned priority_grouping() const noexcept { return prigroup_; }

  // The enabled pending exception of the highest priority, 0 if there is none.
  [[nodiscard]] unsigned best_pending() const noexcept;
  // The priority for preemption: -2 for NMI, -1 for HardFault, else the priority without its subpriority.
  [[nodiscard]] int group_priority(unsigned exception) const noexcept;
  // B1.5.4, ExecutionPriority().
  [[nodiscard]] int execution_priority(const ExceptionMasks& masks) const noexcept;

 private:
  [[nodiscard]] static constexpr std::uint64_t bit(unsigned exception) noexcept { return 1ULL << exception; }
  [[nodiscard]] int priority(unsigned exception) const noexcept;
  [[nodiscard]] int group_of(int priority) const noexcept;

  std::uint64_t pending_ = 0;
  std::uint64_t active_ = 0;
  std::uint64_t enabled_ = 0;
  std::uint64_t line_ = 0;
  std::array<std::uint8_t, kExceptions> priority_{};
  unsigned prigroup_ = 0;
};

}  // namespace groma::sim
