#include "firmware/sim/emulator/unicorn_engine.hpp"

#include <string>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {
namespace {

constexpr std::uint32_t kThumb = 1U << 24;
constexpr std::uint32_t kExceptionNumber = 0x1FF;
constexpr std::uint32_t kUnprivileged = 1U << 0;  // CONTROL
constexpr std::uint32_t kProcessStack = 1U << 1;
constexpr std::uint32_t kFloatingPoint = 1U << 2;

void check(uc_err error, const char* what) {
  if (error != UC_ERR_OK) {
    throw SimulationError(std::string("processor emulator: ") + what + ": " + uc_strerror(error));
  }
}

}  // namespace

UnicornEngine::UnicornEngine() {
  // Not UC_MODE_MCLASS: with it Unicorn always emulates a Cortex-M33.
  check(uc_open(UC_ARCH_ARM, UC_MODE_THUMB, &engine_), "open");
  try {
    check(uc_ctl_set_cpu_model(engine_, UC_CPU_ARM_CORTEX_M4), "model");
    // Without an end address Unicorn keeps its translated code when a run ends.
    check(uc_ctl_exits_enable(engine_), "exits");
  } catch (...) {
    uc_close(engine_);
    throw;
  }
}

UnicornEngine::~UnicornEngine() {
  uc_close(engine_);
}

void UnicornEngine::map_read_only(std::uint32_t address, std::span<std::uint8_t> memory,
                                  unsigned permissions) {
  check(uc_mem_map_ptr(engine_, address, memory.size(), UC_PROT_ALL, memory.data()), "memory");
  check(uc_mem_protect(engine_, address, memory.size(), UC_PROT_READ | permissions), "memory");
}

void UnicornEngine::map_io(std::uint32_t address, std::size_t bytes, uc_cb_mmio_read_t on_read,
                           uc_cb_mmio_write_t on_write, void* user) {
  check(uc_mmio_map(engine_, address, bytes, on_read, user, on_write, user), "I/O");
}

void UnicornEngine::add_hook(int type, void* callback, void* user, std::uint64_t begin, std::uint64_t end) {
  uc_hook hook = 0;
  check(uc_hook_add(engine_, &hook, type, callback, user, begin, end), "hook");
}

void UnicornEngine::drop_code(std::uint32_t begin, std::uint32_t end) {
  check(uc_ctl_remove_cache(engine_, static_cast<std::uint64_t>(begin), static_cast<std::uint64_t>(end)),
        "code cache");
}

std::uint32_t UnicornEngine::read(int which) const {
  std::uint32_t value = 0;
  uc_reg_read(engine_, which, &value);
  return value;
}

void UnicornEngine::write(int which, std::uint32_t value) {
  uc_reg_write(engine_, which, &value);
}

std::array<std::uint32_t, 16> UnicornEngine::core_registers() const {
  std::array<std::uint32_t, 16> values{};
  for (int i = 0; i <= 12; ++i) values[static_cast<std::size_t>(i)] = read(UC_ARM_REG_R0 + i);
  values[13] = read(UC_ARM_REG_R13);
  values[14] = read(UC_ARM_REG_R14);
  values[15] = read(UC_ARM_REG_R15);
  return values;
}

void UnicornEngine::set_xpsr(std::uint32_t value) {
  write(UC_ARM_REG_XPSR_NZCVQG, value);
  // For the side effect: it updates the translator's state to the new mode.
  write(UC_ARM_REG_APSR_NZCV, value & 0xF0000000U);
}

bool UnicornEngine::unprivileged() const {
  return (read(UC_ARM_REG_CONTROL) & kUnprivileged) != 0 && (xpsr() & kExceptionNumber) == 0;
}

ExceptionMasks UnicornEngine::masks() {
  // In unprivileged mode these registers read as zero, for Unicorn's API too.
  const bool lift = unprivileged();
  const std::uint32_t saved = lift ? xpsr() : 0;
  if (lift) write(UC_ARM_REG_XPSR_NZCVQG, saved | exception::kHardFault);
  const ExceptionMasks masks{.primask = read(UC_ARM_REG_PRIMASK) != 0,
                             .faultmask = read(UC_ARM_REG_FAULTMASK) != 0,
                             .basepri = static_cast<std::uint8_t>(read(UC_ARM_REG_BASEPRI))};
  if (lift) write(UC_ARM_REG_XPSR_NZCVQG, saved);
  return masks;
}

void UnicornEngine::enter_handler(unsigned exception, bool thumb) {
  const std::uint32_t state = exception | (thumb ? kThumb : 0U);
  const std::uint32_t control = read(UC_ARM_REG_CONTROL);
  const bool thread = (xpsr() & kExceptionNumber) == 0;
  if (thread) {
    // SPSEL can only be written in privileged thread mode, and only handler mode can grant the privilege.
    write(UC_ARM_REG_XPSR_NZCVQG, state);
    write(UC_ARM_REG_CONTROL, control & ~kUnprivileged);
    write(UC_ARM_REG_XPSR_NZCVQG, kThumb);
    write(UC_ARM_REG_CONTROL, control & ~(kUnprivileged | kProcessStack));
  }
  set_xpsr(state);
  write(UC_ARM_REG_CONTROL, control & kUnprivileged);
}

void UnicornEngine::leave_to_thread(bool process_stack, bool floating_point) {
  const std::uint32_t control = read(UC_ARM_REG_CONTROL);
  write(UC_ARM_REG_CONTROL, control & ~kUnprivileged);
  write(UC_ARM_REG_XPSR_NZCVQG, kThumb);
  write(UC_ARM_REG_CONTROL, (control & kUnprivileged) | (process_stack ? kProcessStack : 0U) |
                                (floating_point ? kFloatingPoint : 0U));
}

void UnicornEngine::set_floating_point_active(bool on) {
  const std::uint32_t control = read(UC_ARM_REG_CONTROL);
  write(UC_ARM_REG_CONTROL, on ? control | kFloatingPoint : control & ~kFloatingPoint);
}

void UnicornEngine::reset() {
  enter_handler(exception::kHardFault, true);
  write(UC_ARM_REG_CONTROL, 0);
  leave_to_thread(false, false);
  for (const int mask : {UC_ARM_REG_PRIMASK, UC_ARM_REG_BASEPRI, UC_ARM_REG_FAULTMASK}) write(mask, 0);
  for (int i = 0; i <= 12; ++i) write(UC_ARM_REG_R0 + i, 0);
  for (int i = 0; i < 32; ++i) write(UC_ARM_REG_S0 + i, 0);
  write(UC_ARM_REG_FPSCR, 0);
  write(UC_ARM_REG_MSP, 0);
  write(UC_ARM_REG_PSP, 0);
  write(UC_ARM_REG_LR, 0xFFFFFFFF);
  set_xpsr(kThumb);
}

}  // namespace groma::sim
