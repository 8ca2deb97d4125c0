#include "firmware/sim/emulator/system_control.hpp"

namespace groma::sim {
namespace {

// Offsets.
constexpr std::uint32_t kIctr = 0x004;
constexpr std::uint32_t kActlr = 0x008;
constexpr std::uint32_t kSystCsr = 0x010;
constexpr std::uint32_t kSystRvr = 0x014;
constexpr std::uint32_t kSystCvr = 0x018;
constexpr std::uint32_t kSystCalib = 0x01C;
constexpr std::uint32_t kIser = 0x100;
constexpr std::uint32_t kIcer = 0x180;
constexpr std::uint32_t kIspr = 0x200;
constexpr std::uint32_t kIcpr = 0x280;
constexpr std::uint32_t kIabr = 0x300;
constexpr std::uint32_t kIpr = 0x400;
constexpr std::uint32_t kCpuid = 0xD00;
constexpr std::uint32_t kIcsr = 0xD04;
constexpr std::uint32_t kVtor = 0xD08;
constexpr std::uint32_t kAircr = 0xD0C;
constexpr std::uint32_t kScr = 0xD10;
constexpr std::uint32_t kCcr = 0xD14;
constexpr std::uint32_t kShpr = 0xD18;
constexpr std::uint32_t kShprEnd = 0xD24;
constexpr std::uint32_t kShcsr = 0xD24;
constexpr std::uint32_t kCfsr = 0xD28;
constexpr std::uint32_t kHfsr = 0xD2C;
constexpr std::uint32_t kDfsr = 0xD30;
constexpr std::uint32_t kMmfar = 0xD34;
constexpr std::uint32_t kBfar = 0xD38;
constexpr std::uint32_t kAfsr = 0xD3C;
constexpr std::uint32_t kCpacr = 0xD88;
constexpr std::uint32_t kMpuType = 0xD90;
constexpr std::uint32_t kDhcsr = 0xDF0;
constexpr std::uint32_t kStir = 0xF00;
constexpr std::uint32_t kFpccr = 0xF34;
constexpr std::uint32_t kFpcar = 0xF38;
constexpr std::uint32_t kFpdscr = 0xF3C;
constexpr std::uint32_t kMvfr0 = 0xF40;
constexpr std::uint32_t kMvfr1 = 0xF44;

constexpr std::uint32_t kCortexM4 = 0x410FC241;  // r0p1
constexpr std::uint32_t kVectKey = 0x05FA;
constexpr std::uint32_t kVectKeyRead = 0xFA05;
constexpr std::uint32_t kCcrModelled = 1U << 0 | 1U << 1 | 1U << 4 | 1U << 9;
constexpr std::uint32_t kCcrReset = 1U << 9;  // STKALIGN
constexpr std::uint32_t kFpccrReset = 3U << 30;
constexpr std::uint32_t kAutomaticFpState = 1U << 31;  // FPCCR.ASPEN
constexpr unsigned kInterrupts = Nvic::kExceptions - exception::kFirstIrq;
constexpr unsigned kInterruptWords = (kInterrupts + 31) / 32;

struct HandlerBit {
  unsigned exception;
  unsigned active;  // SHCSR bits; 32: none
  unsigned pending;
  unsigned enable;
};
constexpr HandlerBit kHandlers[] = {
    {exception::kMemManage, 0, 13, 16},  {exception::kBusFault, 1, 14, 17},
    {exception::kUsageFault, 3, 12, 18}, {exception::kSvCall, 7, 15, 32},
    {exception::kPendSv, 10, 32, 32},    {exception::kSysTick, 11, 32, 32},
};

constexpr bool within(std::uint32_t offset, std::uint32_t first, std::uint32_t end) noexcept {
  return offset >= first && offset < end;
}

// Calls visit(exception, position) for each interrupt of a word of ISER or a similar register.
template <typename Visit>
void for_each_of_word(std::uint32_t word, Visit visit) {
  for (unsigned position = 0; position < 32 && 32 * word + position < kInterrupts; ++position) {
    visit(exception::kFirstIrq + 32 * word + position, position);
  }
}

}  // namespace

void SystemControl::reset() noexcept {
  current_exception_ = 0;
  vtor_ = 0;
  scr_ = 0;
  ccr_ = kCcrReset;
  cfsr_ = 0;
  hfsr_ = 0;
  dfsr_ = 0;
  mmfar_ = 0;
  bfar_ = 0;
  cpacr_ = 0;
  fpccr_ = kFpccrReset;
  fpcar_ = 0;
  reset_requested_ = false;
}

void SystemControl::record_bus_address(std::uint32_t address) noexcept {
  bfar_ = address;
  cfsr_ |= fault_status::kBusAddressValid;
}

bool SystemControl::read(std::uint32_t offset, unsigned bytes, SimTime now, std::uint32_t& value) noexcept {
  const std::uint32_t mask = bytes == 4 ? ~0U : (1U << 8 * bytes) - 1;
  if (within(offset, kIpr, kIpr + kInterrupts) || within(offset, kShpr, kShprEnd)) {
    const unsigned first = offset < kShpr ? exception::kFirstIrq + (offset - kIpr) : 4 + (offset - kShpr);
    value = 0;
    for (unsigned i = 0; i < bytes; ++i) {
      value |= static_cast<std::uint32_t>(nvic_.priority_register(first + i)) << 8 * i;
    }
    return true;
  }
  // The fault status registers are bytes and half-words of one word.
  const std::uint32_t aligned = offset & ~3U;
  if (bytes != 4 && aligned != kCfsr) return false;
  if (!read_word(aligned, now, value)) return false;
  value = value >> 8 * (offset - aligned) & mask;
  return true;
}

bool SystemControl::write(std::uint32_t offset, unsigned bytes, SimTime now, std::uint32_t value) noexcept {
  if (within(offset, kIpr, kIpr + kInterrupts) || within(offset, kShpr, kShprEnd)) {
    const unsigned first = offset < kShpr ? exception::kFirstIrq + (offset - kIpr) : 4 + (offset - kShpr);
    for (unsigned i = 0; i < bytes; ++i) {
      nvic_.set_priority(first + i, static_cast<std::uint8_t>(value >> 8 * i));
    }
    return true;
  }
  const std::uint32_t aligned = offset & ~3U;
  if (bytes != 4 && aligned != kCfsr) return false;
  return write_word(aligned, now, value << 8 * (offset - aligned));
}

bool SystemControl::read_word(std::uint32_t offset, SimTime now, std::uint32_t& value) noexcept {
  value = 0;
  for (const std::uint32_t bank : {kIser, kIcer, kIspr, kIcpr, kIabr}) {
    if (!within(offset, bank, bank + 4 * kInterruptWords)) continue;
    for_each_of_word((offset - bank) / 4, [&](unsigned exception, unsigned position) {
      const bool set = bank == kIabr                    ? nvic_.active(exception)
                       : bank == kIser || bank == kIcer ? nvic_.enabled(exception)
                                                        : nvic_.pending(exception);
      value |= static_cast<std::uint32_t>(set) << position;
    });
    return true;
  }
  switch (offset) {
    case kIctr:
      value = kInterruptWords - 1;
      return true;
    case kActlr:
    case kAfsr:
    case kMpuType:
    case kDhcsr:
    case kFpdscr:
      return true;
    case kSystCsr:
      value = sys_tick_.read_control(now);
      return true;
    case kSystRvr:
      value = sys_tick_.reload();
      return true;
    case kSystCvr:
      value = sys_tick_.current(now);
      return true;
    case kSystCalib:
      value = 3U << 30;
      return true;  // no reference clock, no calibration
    case kCpuid:
      value = kCortexM4;
      return true;
    case kIcsr:
      value = interrupt_state();
      return true;
    case kVtor:
      value = vtor_;
      return true;
    case kAircr:
      value = kVectKeyRead << 16 | nvic_.priority_grouping() << 8;
      return true;
    case kScr:
      value = scr_;
      return true;
    case kCcr:
      value = ccr_;
      return true;
    case kShcsr:
      value = handler_state();
      return true;
    case kCfsr:
      value = cfsr_;
      return true;
    case kHfsr:
      value = hfsr_;
      return true;
    case kDfsr:
      value = dfsr_;
      return true;
    case kMmfar:
      value = mmfar_;
      return true;
    case kBfar:
      value = bfar_;
      return true;
    case kCpacr:
      value = cpacr_;
      return true;
    case kFpccr:
      value = fpccr_;
      return true;
    case kFpcar:
      value = fpcar_;
      return true;
    case kMvfr0:
      value = 0x10110021;
      return true;
    case kMvfr1:
      value = 0x11000011;
      return true;
    default:
      return false;
  }
}

bool SystemControl::write_word(std::uint32_t offset, SimTime now, std::uint32_t value) noexcept {
  for (const std::uint32_t bank : {kIser, kIcer, kIspr, kIcpr}) {
    if (!within(offset, bank, bank + 4 * kInterruptWords)) continue;
    for_each_of_word((offset - bank) / 4, [&](unsigned exception, unsigned position) {
      if ((value >> position & 1U) == 0) return;
      switch (bank) {
        case kIser:
          nvic_.enable(exception, true);
          break;
        case kIcer:
          nvic_.enable(exception, false);
          break;
        case kIspr:
          nvic_.pend(exception);
          break;
        default:
          nvic_.clear_pending(exception);
          break;
      }
    });
    return true;
  }
  switch (offset) {
    case kActlr:
      return value == 0;
    case kSystCsr:
      sys_tick_.write_control(now, value);
      return true;
    case kSystRvr:
      sys_tick_.write_reload(value);
      return true;
    case kSystCvr:
      sys_tick_.clear_current(now);
      return true;
    case kIcsr:
      write_interrupt_control(value);
      return true;
    case kVtor:
      vtor_ = value & ~0x7FU;
      return true;
    case kAircr:
      return write_reset_control(value);
    case kScr:
      scr_ = value & 0x16U;
      return true;
    case kCcr:
      ccr_ = value;
      return (value & ~kCcrModelled) == 0;
    case kShcsr:
      write_handler_state(value);
      return true;
    case kCfsr:
      cfsr_ &= ~value;
      return true;
    case kHfsr:
      hfsr_ &= ~value;
      return true;
    case kDfsr:
      dfsr_ &= ~value;
      return true;
    case kMmfar:
      mmfar_ = value;
      return true;
    case kBfar:
      bfar_ = value;
      return true;
    case kAfsr:
      return true;
    case kCpacr:
      cpacr_ = value & 0xFU << 20;
      return true;
    case kStir: {
      const std::uint32_t irq = value & 0x1FF;
      if (irq < kInterrupts) nvic_.pend(exception::kFirstIrq + irq);
      return true;
    }
    case kFpccr:
      fpccr_ = value & kFpccrReset;
      return (value & kAutomaticFpState) != 0;
    case kFpcar:
      fpcar_ = value & ~7U;
      return true;
    case kFpdscr:
      return value == 0;
    default:
      return false;
  }
}

std::uint32_t SystemControl::interrupt_state() const noexcept {
  const bool one_level = nvic_.active_count() <= 1;
  return current_exception_ | (one_level ? 1U << 11 : 0U) | nvic_.best_pending() << 12 |
         (nvic_.interrupt_pending() ? 1U << 22 : 0U) | (nvic_.pending(exception::kSysTick) ? 1U << 26 : 0U) |
         (nvic_.pending(exception::kPendSv) ? 1U << 28 : 0U) |
         (nvic_.pending(exception::kNmi) ? 1U << 31 : 0U);
}

void SystemControl::write_interrupt_control(std::uint32_t value) noexcept {
  if ((value & 1U << 31) != 0) nvic_.pend(exception::kNmi);
  if ((value & 1U << 28) != 0) nvic_.pend(exception::kPendSv);
  if ((value & 1U << 27) != 0) nvic_.clear_pending(exception::kPendSv);
  if ((value & 1U << 26) != 0) nvic_.pend(exception::kSysTick);
  if ((value & 1U << 25) != 0) nvic_.clear_pending(exception::kSysTick);
}

bool SystemControl::write_reset_control(std::uint32_t value) noexcept {
  if (value >> 16 != kVectKey) return true;  // ignored without the key (B3.2.6)
  nvic_.set_priority_grouping(value >> 8 & 7U);
  if ((value & 1U << 2) != 0) reset_requested_ = true;
  return (value & 3U) == 0;  // VECTRESET and VECTCLRACTIVE are for debuggers
}

std::uint32_t SystemControl::handler_state() const noexcept {
  std::uint32_t value = 0;
  for (const HandlerBit& handler : kHandlers) {
    if (nvic_.active(handler.exception)) value |= 1U << handler.active;
    if (handler.pending < 32 && nvic_.pending(handler.exception)) value |= 1U << handler.pending;
    if (handler.enable < 32 && nvic_.enabled(handler.exception)) value |= 1U << handler.enable;
  }
  return value;
}

void SystemControl::write_handler_state(std::uint32_t value) noexcept {
  for (const HandlerBit& handler : kHandlers) {
    nvic_.set_active(handler.exception, (value >> handler.active & 1U) != 0);
    if (handler.pending < 32) {
      if ((value >> handler.pending & 1U) != 0) {
        nvic_.pend(handler.exception);
      } else {
        nvic_.clear_pending(handler.exception);
      }
    }
    if (handler.enable < 32) nvic_.enable(handler.exception, (value >> handler.enable & 1U) != 0);
  }
}

}  // namespace groma::sim
