#include "firmware/sim/emulator/cortex_m4_core.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <limits>
#include <utility>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {
namespace {

constexpr std::uint32_t kRam = 0x20000000;
constexpr std::uint32_t kFactory = 0x10000000;  // FICR and UICR
constexpr std::uint32_t kFactoryBytes = 0x2000;
constexpr std::uint32_t kPeripherals = 0x40000000;
constexpr std::uint32_t kPeripheralBytes = 0x20000000;
constexpr std::uint32_t kPrivate = 0xE0000000;  // private peripheral bus
constexpr std::uint32_t kPrivateBytes = 0x100000;
constexpr std::uint32_t kSystemControl = 0xE000E000;
constexpr std::uint32_t kSystemControlBytes = 0x1000;
constexpr std::uint32_t kPage = 4096;

constexpr SimTime kStopNow = std::numeric_limits<SimTime>::min();
constexpr std::uint32_t kThumb = 1U << 24;

// Numbers that Unicorn passes to its interrupt callback.
constexpr int kSupervisorCall = 2;
constexpr int kPrefetchAbort = 3;  // a violation of the default memory map
constexpr int kBreakpoint = 7;
constexpr int kExceptionReturn = 8;
constexpr int kNoCoprocessor = 17;

// Execution from here is a MemManage fault, MPU or not (B3.1, table B3-1).
bool never_executable(std::uint32_t address) {
  return (address >= kPeripherals && address < 0x60000000) || address >= 0xA0000000;
}

std::uint32_t with_it_state(std::uint32_t xpsr, std::uint8_t it) {
  constexpr std::uint32_t kItBits = 3U << 25 | 0x3FU << 10;
  return (xpsr & ~kItBits) | (it & 3U) << 25 | static_cast<std::uint32_t>(it >> 2) << 10;
}

}  // namespace

CortexM4::Core::Core(std::span<std::uint8_t> flash, std::span<std::uint8_t> ram, Bus& bus,
                     const CpuTiming& timing)
    : instruction_time_(timing.instruction),
      flash_(flash),
      ram_(ram),
      bus_(bus),
      timing_(timing),
      sys_tick_(timing.cycle),
      control_(nvic_, sys_tick_) {
  facts_.resize(flash.size() / 2);
  if (flash.empty() || flash.size() % kPage != 0 || ram.empty() || ram.size() % kPage != 0) {
    throw SimulationError("processor emulator: flash and RAM are multiples of 4096 bytes");
  }
  engine_.map_read_only(0, flash, UC_PROT_EXEC);
  // A hook handles stores to RAM: Unicorn's own store checks for code there, which is four times as slow.
  engine_.map_read_only(kRam, ram, UC_PROT_NONE);
  engine_.map_io(kFactory, kFactoryBytes, &on_bus_read<kFactory>, &on_bus_write<kFactory>, this);
  engine_.map_io(kPeripherals, kPeripheralBytes, &on_bus_read<kPeripherals>, &on_bus_write<kPeripherals>,
                 this);
  engine_.map_io(kPrivate, kPrivateBytes, &on_private_read, &on_private_write, this);
  engine_.add_hook(UC_HOOK_BLOCK, reinterpret_cast<void*>(&on_block), this);
  engine_.add_hook(UC_HOOK_INTR, reinterpret_cast<void*>(&on_interrupt), this);
  engine_.add_hook(UC_HOOK_MEM_READ_UNMAPPED | UC_HOOK_MEM_WRITE_UNMAPPED,
                   reinterpret_cast<void*>(&on_unmapped), this);
  engine_.add_hook(UC_HOOK_MEM_WRITE_PROT, reinterpret_cast<void*>(&on_ram_store), this, kRam,
                   kRam + ram.size() - 1);
  engine_.add_hook(UC_HOOK_MEM_WRITE_PROT, reinterpret_cast<void*>(&on_flash_store), this, 0,
                   flash.size() - 1);
}

void CortexM4::Core::reset(SimTime t) {
  engine_.reset();
  nvic_.reset();
  sys_tick_.reset();
  control_.reset();
  flash_changed(0, flash_.size());
  now_ = t;
  stalled_until_ = t;
  sleep_ = Sleep::kAwake;
  idle_ = false;
  event_ = false;
  lockup_ = false;
  recheck_exceptions_ = true;
  pending_before_ = nvic_.pending_bits();
  std::uint32_t stack = 0;
  std::uint32_t entry = 0;
  if (!load_word(0, stack) || !load_word(4, entry))
    throw SimulationError("processor emulator: no flash at 0");
  engine_.write(UC_ARM_REG_MSP, stack & ~3U);
  engine_.set_xpsr((entry & 1U) != 0 ? kThumb : 0);
  next_pc_ = entry;
}

void CortexM4::Core::run(SimTime until) {
  until_ = until;
  while (now_ < until_ && !lockup_ && !control_.reset_requested()) {
    if (now_ < stalled_until_) {
      now_ = std::min(until_, stalled_until_);
      continue;
    }
    count_ticks();
    if (sleep_ != Sleep::kAwake) {
      if (!wakes()) {
        const SimTime tick = sys_tick_.next_interrupt();
        if (tick >= until_) return;
        now_ = std::max(now_, tick);
        continue;
      }
      if (sleep_ == Sleep::kForEvent) event_ = false;
      sleep_ = Sleep::kAwake;
      if (std::exchange(idle_, false)) {
        stalled_until_ = now_ + timing_.wake_up;
        continue;
      }
    }
    if (recheck_exceptions_ && take_pending()) continue;
    execute();
  }
}

void CortexM4::Core::count_ticks() {
  if (sys_tick_.advance(now_)) pend(exception::kSysTick);
}

void CortexM4::Core::limit(SimTime t) {
  until_ = std::min(until_, t);
  limit_ = std::min(limit_, t);
}

void CortexM4::Core::stall(SimTime duration) {
  stalled_until_ = std::max(stalled_until_, now_) + duration;
  limit_ = kStopNow;
}

void CortexM4::Core::idle_until(SimTime t) {
  now_ = std::max(now_, t);
}

bool CortexM4::Core::sleeping() const {
  return sleep_ != Sleep::kAwake && !wakes();
}

SimTime CortexM4::Core::next_wake() const {
  if (lockup_ || control_.reset_requested()) return kNever;
  const SimTime ready = std::max(now_, stalled_until_);
  return sleeping() ? std::max(ready, sys_tick_.next_interrupt()) : ready;
}

void CortexM4::Core::fall_asleep(Sleep kind) {
  sleep_ = kind;
  idle_ = !wakes();
  if (!idle_) return;
  if (guards_wake_up_ && !wakes_up_quietly()) {
    throw SimulationError(
        fmt::format("anomaly 220: a sleep before PC {:#010x} without PRIMASK or without four NOPs after it",
                    next_pc_ & ~1U));
  }
  bus_.on_sleep(now_);
}

// No exception is taken and no memory is written in the first four instructions after the sleep.
bool CortexM4::Core::wakes_up_quietly() const {
  constexpr std::array<std::uint8_t, 8> kFourNops{0x00, 0xBF, 0x00, 0xBF, 0x00, 0xBF, 0x00, 0xBF};
  const std::span<const std::uint8_t> code = memory_at(next_pc_ & ~1U, kFourNops.size());
  return engine_.masks().primask && std::equal(code.begin(), code.end(), kFourNops.begin(), kFourNops.end());
}

// B1.5.17 and B1.5.18: an interrupt wakes the CPU even if PRIMASK is set.
bool CortexM4::Core::wakes() const {
  if (sleep_ == Sleep::kForEvent && event_) return true;
  const unsigned best = nvic_.best_pending();
  if (best == 0) return false;
  ExceptionMasks masks = engine_.masks();
  masks.primask = false;
  return nvic_.group_priority(best) < nvic_.execution_priority(masks);
}

void CortexM4::Core::set_line(unsigned exception, bool level) {
  const std::uint64_t pending = nvic_.pending_bits();
  nvic_.set_line(exception, level);
  if (nvic_.pending_bits() != pending) exceptions_changed();
}

void CortexM4::Core::pend(unsigned exception) {
  nvic_.pend(exception);
  exceptions_changed();
}

// Called after any change that may make an exception pending or allow it to be taken.
void CortexM4::Core::exceptions_changed() {
  const std::uint64_t pending = nvic_.pending_bits();
  if (control_.pending_sends_event() && (pending & ~pending_before_) != 0) event_ = true;
  pending_before_ = pending;
  recheck_exceptions_ = true;
  update_attention();
  limit_ = std::min(limit_, sys_tick_.next_interrupt());
  if (nvic_.any_enabled_pending() || control_.reset_requested()) limit_ = kStopNow;
}

// Selects the blocks that need more than counting.
void CortexM4::Core::update_attention() {
  attention_ = thumb::kSendsEvent;
  if (nvic_.any_enabled_pending()) attention_ |= thumb::kWritesSpecialRegister;
  if (!control_.floating_point_enabled()) attention_ |= thumb::kFloatingPoint;
  if (control_.traps_division()) attention_ |= thumb::kDivides;
}

void CortexM4::Core::flash_changed(std::uint32_t address, std::size_t bytes) {
  const auto begin = std::min<std::size_t>(address, flash_.size());
  const auto end = std::min(begin + bytes, flash_.size());
  if (begin == end) return;
  // A block is at most a page long.
  const std::size_t first = begin > kPage ? begin - kPage : 0;
  std::fill(facts_.begin() + static_cast<std::ptrdiff_t>(first / 2),
            facts_.begin() + static_cast<std::ptrdiff_t>((end + 1) / 2), Facts{});
  watched_blocks_.clear();
  changed_code_.push_back({static_cast<std::uint32_t>(begin), static_cast<std::uint32_t>(end - begin)});
  limit_ = kStopNow;
}

void CortexM4::Core::trace_point(std::uint64_t what) {
  constexpr std::uint64_t kPrime = 0x100000001B3U;
  trace_hash_ = (trace_hash_ ^ what) * kPrime;
  trace_hash_ = (trace_hash_ ^ static_cast<std::uint64_t>(now_)) * kPrime;
}

// --- blocks of code

std::span<const std::uint8_t> CortexM4::Core::memory_at(std::uint32_t address, std::size_t bytes) const {
  const bool in_ram = address >= kRam;
  const std::span<const std::uint8_t> memory = in_ram ? ram_ : flash_;
  const std::size_t at = in_ram ? address - kRam : address;
  if (at >= memory.size()) return {};
  return memory.subspan(at, std::min(bytes, memory.size() - at));
}

inline CortexM4::Core::Facts CortexM4::Core::facts_of(const CodeBlock& block) {
  Facts& facts = facts_[block.address / 2];
  if (facts.instructions == 0 || facts.length != (block.bytes / 2 & 3U)) [[unlikely]]
    facts = analyse(block);
  return facts;
}

CortexM4::Core::Facts CortexM4::Core::analyse(const CodeBlock& block) const {
  const thumb::BlockFacts found = thumb::facts_of_block(memory_at(block.address, block.bytes));
  Facts facts;
  facts.instructions = found.instructions & 0x3FFU;  // Unicorn's blocks have 512 at most
  facts.length = block.bytes / 2 & 3U;
  facts.traits = found.traits & 0xFU;
  return facts;
}

// Called once for each block, before it runs, and again when it is resumed.
void CortexM4::Core::on_block(uc_engine*, std::uint64_t address, std::uint32_t bytes, void* user) {
  Core& self = *static_cast<Core*>(user);
  const CodeBlock block{static_cast<std::uint32_t>(address), bytes};
  if (self.now_ >= self.limit_) [[unlikely]] {
    self.stop_before(block);
    return;
  }
  const Facts facts = self.facts_of(block);
  const bool again = self.bus_read_ && block.address == self.block_.address;
  self.block_ = block;
  self.bus_read_ = false;
  const unsigned traits = facts.traits & self.attention_;
  if (traits != 0 && !self.attend(traits, block)) [[unlikely]]
    return;
  const std::uint32_t count = facts.instructions;
  if (again && count == thumb::kPollingInstructions) self.pass_over_turns(block);
  self.instructions_ += count;
  self.now_ += count * self.instruction_time_;
  if (self.tracing_) self.trace_point(address);
}

// The previous turn of the loop has read a word from the bus that does not change before limit_. So all turns
// that end before it are equal; the next turn runs again.
void CortexM4::Core::pass_over_turns(const CodeBlock& block) {
  if (tracing_ || !thumb::is_polling_loop(memory_at(block.address, block.bytes))) return;
  const SimTime turn = thumb::kPollingInstructions * instruction_time_;
  const SimTime turns = (limit_ - 1 - now_) / turn;
  now_ += turns * turn;
  instructions_ += static_cast<std::uint64_t>(turns) * thumb::kPollingInstructions;
}

void CortexM4::Core::stop_before(const CodeBlock& block) {
  stopped_before_block_ = true;
  block_ = block;
  engine_.stop();
}

// False: the block must not run yet.
bool CortexM4::Core::attend(unsigned traits, const CodeBlock& block) {
  constexpr unsigned kWatchable = thumb::kFloatingPoint | thumb::kDivides;
  if ((traits & kWatchable) != 0 && !watched_blocks_.contains({block.address, block.bytes})) {
    watch_block_ = true;
    stop_before(block);
    return false;
  }
  if ((traits & thumb::kSendsEvent) != 0) event_ = true;
  if ((traits & thumb::kWritesSpecialRegister) != 0) exceptions_changed();
  return true;
}

// Adds a hook to each floating-point instruction and division of the block.
void CortexM4::Core::watch_instructions_of(const CodeBlock& block) {
  const std::span<const std::uint8_t> code = memory_at(block.address, block.bytes);
  for (std::size_t at = 0; at + 1 < code.size();) {
    const thumb::Instruction i = thumb::instruction_at(code.subspan(at));
    const auto address = static_cast<std::uint32_t>(block.address + at);
    if ((thumb::is_floating_point(i) || thumb::is_division(i)) && watched_.insert(address).second) {
      engine_.add_hook(UC_HOOK_CODE, reinterpret_cast<void*>(&on_watched), this, address, address);
    }
    at += i.bytes;
  }
  engine_.drop_code(block.address, block.address + block.bytes);
  watched_blocks_.insert({block.address, block.bytes});
}

void CortexM4::Core::on_watched(uc_engine*, std::uint64_t address, std::uint32_t, void* user) {
  Core& self = *static_cast<Core*>(user);
  const auto pc = static_cast<std::uint32_t>(address);
  const thumb::Instruction i = thumb::instruction_at(self.memory_at(pc, 4));
  if (thumb::is_floating_point(i) && !self.control_.floating_point_enabled()) {
    self.stop_instruction(exception::kUsageFault, fault_status::kNoCoprocessor, self.place_at(pc));
  } else if (thumb::is_division(i) && self.control_.traps_division() &&
             self.engine_.read(core_register(i.second & 0xF)) == 0) {
    self.stop_instruction(exception::kUsageFault, fault_status::kDivideByZero, self.place_at(pc));
  }
}

// --- accesses other than to memory

// Makes the call, which returns false if nothing is mapped there. Stores exceptions, which must not pass
// through Unicorn's frames.
template <typename Call>
bool CortexM4::Core::guarded(const Access& access, Call call) {
  if (error_ || stopped_) return true;  // in an IT block Unicorn does not stop immediately
  access_ = access;
  try {
    if (!call()) stop_for_bus_fault(access);
  } catch (...) {
    error_ = std::current_exception();
    engine_.stop();
  }
  access_.reset();
  return !stopped_;
}

template <std::uint32_t base>
std::uint64_t CortexM4::Core::on_bus_read(uc_engine*, std::uint64_t offset, unsigned bytes, void* user) {
  Core& self = *static_cast<Core*>(user);
  const auto address = static_cast<std::uint32_t>(base + offset);
  std::uint32_t value = 0;
  self.bus_read_ = true;
  self.guarded({address, false}, [&] { return self.bus_.read(address, bytes, value); });
  return value;
}

template <std::uint32_t base>
void CortexM4::Core::on_bus_write(uc_engine*, std::uint64_t offset, unsigned bytes, std::uint64_t value,
                                  void* user) {
  Core& self = *static_cast<Core*>(user);
  const auto address = static_cast<std::uint32_t>(base + offset);
  self.guarded({address, true},
               [&] { return self.bus_.write(address, bytes, static_cast<std::uint32_t>(value)); });
}

std::uint64_t CortexM4::Core::on_private_read(uc_engine*, std::uint64_t offset, unsigned bytes, void* user) {
  Core& self = *static_cast<Core*>(user);
  const auto address = static_cast<std::uint32_t>(kPrivate + offset);
  std::uint32_t value = 0;
  self.guarded({address, false}, [&] {
    if (self.engine_.unprivileged()) return false;
    self.count_ticks();
    const std::uint32_t at = address - kSystemControl;
    if (at >= kSystemControlBytes || !self.control_.read(at, bytes, self.now_, value)) {
      throw SimulationError(fmt::format("a read of {} bytes at {:#010x}, which is not modelled (PC {:#010x})",
                                        bytes, address, self.pc()));
    }
    return true;
  });
  return value;
}

void CortexM4::Core::on_private_write(uc_engine*, std::uint64_t offset, unsigned bytes, std::uint64_t value,
                                      void* user) {
  Core& self = *static_cast<Core*>(user);
  const auto address = static_cast<std::uint32_t>(kPrivate + offset);
  self.guarded({address, true}, [&] {
    if (self.engine_.unprivileged()) return false;
    self.count_ticks();
    const std::uint32_t at = address - kSystemControl;
    if (at >= kSystemControlBytes ||
        !self.control_.write(at, bytes, self.now_, static_cast<std::uint32_t>(value))) {
      throw SimulationError(
          fmt::format("a write of {:#x} ({} bytes) to {:#010x}, which is not modelled (PC {:#010x})", value,
                      bytes, address, self.pc()));
    }
    self.exceptions_changed();
    return true;
  });
}

bool CortexM4::Core::on_unmapped(uc_engine*, int type, std::uint64_t address, int, std::int64_t, void* user) {
  Core& self = *static_cast<Core*>(user);
  self.guarded({static_cast<std::uint32_t>(address), type == UC_MEM_WRITE_UNMAPPED}, [] { return false; });
  return false;
}

bool CortexM4::Core::on_ram_store(uc_engine*, int, std::uint64_t address, int bytes, std::int64_t value,
                                  void* user) {
  Core& self = *static_cast<Core*>(user);
  const std::size_t at = address - kRam;
  const auto size = static_cast<std::size_t>(bytes);
  if (size > self.ram_.size() - at) [[unlikely]] {
    return self.guarded({static_cast<std::uint32_t>(address), true}, [] { return false; });
  }
  switch (size) {
    case 4:
      std::memcpy(&self.ram_[at], &value, 4);
      break;
    case 1:
      std::memcpy(&self.ram_[at], &value, 1);
      break;
    case 2:
      std::memcpy(&self.ram_[at], &value, 2);
      break;
    default:
      std::memcpy(&self.ram_[at], &value, size);
      break;
  }
  return true;
}

// True: done; Unicorn itself does not change the flash.
bool CortexM4::Core::on_flash_store(uc_engine*, int, std::uint64_t address, int bytes, std::int64_t value,
                                    void* user) {
  Core& self = *static_cast<Core*>(user);
  const auto at = static_cast<std::uint32_t>(address);
  const auto size = static_cast<unsigned>(bytes);
  return self.guarded({at, true}, [&] {
    const bool aligned = at % size == 0;
    if (!aligned || !self.bus_.flash_write(at, size, static_cast<std::uint32_t>(value))) return false;
    self.flash_changed(at, size);
    return true;
  });
}

void CortexM4::Core::on_interrupt(uc_engine*, std::uint32_t number, void* user) {
  Core& self = *static_cast<Core*>(user);
  self.interrupt_ = static_cast<int>(number);
  self.engine_.stop();
}

// --- the instruction that makes an access

// Unicorn does not know the PC within a block, but its registers are those before the access.
CortexM4::Core::Place CortexM4::Core::place_of(const Access& access) const {
  const std::span<const std::uint8_t> code = memory_at(block_.address, block_.bytes);
  thumb::Registers registers = engine_.core_registers();
  const std::uint32_t flags = engine_.xpsr();
  Place place{.address = block_.address};
  std::optional<Place> found;
  for (std::size_t at = 0; at + 1 < code.size();) {
    const thumb::Instruction i = thumb::instruction_at(code.subspan(at));
    registers[15] = place.address;
    const std::optional<thumb::MemoryAccess> memory = thumb::memory_access(i, registers);
    if (memory && memory->store == access.store && access.address - memory->address < memory->bytes &&
        place.it.condition_holds(flags)) {
      found = place;
      // A later instruction may make the same access; it is the one if this one is already complete.
      if (!was_completed(*memory, registers)) break;
    }
    place.it.after(i);
    place.address += i.bytes;
    at += i.bytes;
  }
  return found.value_or(Place{.address = block_.address});
}

// Whether an instruction with write-back is complete: the registers it loads or stores equal memory, at the
// address that follows from its present base register.
bool CortexM4::Core::was_completed(const thumb::MemoryAccess& access, const thumb::Registers& now) const {
  if (access.base_moves == 0 || access.core_registers == 0) return false;
  std::uint32_t address = access.address - static_cast<std::uint32_t>(access.base_moves);
  for (std::size_t r = 0; r < 15; ++r) {
    if ((access.core_registers >> r & 1U) == 0) continue;
    std::uint32_t value = 0;
    if (!load_word(address, value) || value != now[r]) return false;
    address += 4;
  }
  return true;
}

CortexM4::Core::Place CortexM4::Core::place_at(std::uint32_t address) const {
  const std::span<const std::uint8_t> code = memory_at(block_.address, block_.bytes);
  Place place{.address = block_.address};
  while (place.address < address) {
    const thumb::Instruction i = thumb::instruction_at(code.subspan(place.address - block_.address));
    place.it.after(i);
    place.address += i.bytes;
  }
  return place;
}

std::uint32_t CortexM4::Core::pc() const {
  if (access_) return place_of(*access_).address;
  return next_pc_ & ~1U;
}

void CortexM4::Core::stop_instruction(unsigned exception, std::uint32_t fault_bits, const Place& place) {
  Stopped stopped{.exception = exception, .fault_bits = fault_bits};
  stopped.registers = engine_.core_registers();
  stopped.registers[15] = place.address;
  stopped.xpsr = with_it_state(engine_.xpsr(), place.it.bits());
  stopped_ = stopped;
  engine_.stop();
}

void CortexM4::Core::stop_for_bus_fault(const Access& access) {
  stop_instruction(exception::kBusFault, fault_status::kPreciseData, place_of(access));
  stopped_->bus_address = access.address;
}

// --- execution

void CortexM4::Core::execute() {
  for (const CodeBlock& changed : changed_code_) {
    engine_.drop_code(changed.address, changed.address + changed.bytes);
  }
  changed_code_.clear();
  limit_ = std::min(until_, sys_tick_.next_interrupt());
  update_attention();
  stopped_before_block_ = false;
  bus_read_ = false;
  interrupt_ = -1;
  const uc_err result = engine_.start(next_pc_);
  if (error_) {
    next_pc_ = block_.address | 1U;
    std::rethrow_exception(std::exchange(error_, nullptr));
  }
  after_event(result);
}

void CortexM4::Core::after_event(uc_err result) {
  if (stopped_) {
    const Stopped stopped = *std::exchange(stopped_, std::nullopt);
    for (unsigned i = 0; i < 15; ++i) engine_.write(core_register(i), stopped.registers[i]);
    engine_.set_xpsr(stopped.xpsr);
    if (stopped.bus_address) control_.record_bus_address(*stopped.bus_address);
    fault(stopped.exception, stopped.fault_bits, stopped.registers[15]);
    return;
  }
  const std::uint32_t thumb_bit = engine_.xpsr() >> 24 & 1U;
  if (stopped_before_block_) {
    next_pc_ = block_.address | thumb_bit;
    if (std::exchange(watch_block_, false)) watch_instructions_of(block_);
    return;
  }
  const std::uint32_t pc = engine_.read(UC_ARM_REG_R15) & ~1U;
  next_pc_ = pc | thumb_bit;
  switch (interrupt_) {
    case kSupervisorCall:
      fault(exception::kSvCall, 0, pc);
      return;
    case kPrefetchAbort:
      fault(exception::kMemManage, fault_status::kInstructionAccess, pc);
      return;
    case kBreakpoint:
      breakpoint();
      return;
    case kExceptionReturn:
      return_from_exception(next_pc_);
      return;
    case kNoCoprocessor:
      fault(exception::kUsageFault, fault_status::kNoCoprocessor, pc);
      return;
    case -1:
      break;
    default:
      throw SimulationError(fmt::format("Unicorn's exception {} at PC {:#010x}", interrupt_, pc));
  }
  switch (result) {
    case UC_ERR_OK:  // WFI
      fall_asleep(Sleep::kForInterrupt);
      return;
    case UC_ERR_FETCH_UNMAPPED:
    case UC_ERR_FETCH_PROT:
      if (!memory_at(pc, 2).empty()) {
        throw SimulationError(fmt::format("execution of RAM, which is not modelled, at {:#010x}", pc));
      }
      if (never_executable(pc)) {
        fault(exception::kMemManage, fault_status::kInstructionAccess, pc);
      } else {
        fault(exception::kBusFault, fault_status::kInstructionBus, pc);
      }
      return;
    case UC_ERR_INSN_INVALID: {
      if (thumb_bit == 0) {
        fault(exception::kUsageFault, fault_status::kInvalidState, pc);
        return;
      }
      // A hint ends its block; an undefined instruction does not.
      const bool hint = pc == block_.address + block_.bytes;
      if (!hint) {
        fault(exception::kUsageFault, fault_status::kUndefined, pc);
      } else if (thumb::is_wait_for_event(last_instruction())) {
        fall_asleep(Sleep::kForEvent);
      }
      return;
    }
    default:
      throw SimulationError(fmt::format("Unicorn: {} at PC {:#010x}", uc_strerror(result), pc));
  }
}

thumb::Instruction CortexM4::Core::last_instruction() const {
  const std::span<const std::uint8_t> code = memory_at(block_.address, block_.bytes);
  thumb::Instruction i;
  for (std::size_t at = 0; at + 1 < code.size(); at += i.bytes) i = thumb::instruction_at(code.subspan(at));
  return i;
}

// --- access to registers from outside

namespace {

int unicorn_register(CortexM4::Register which) {
  using R = CortexM4::Register;
  if (which <= R::kR12) return core_register(static_cast<unsigned>(which));
  switch (which) {
    case R::kSp:
      return UC_ARM_REG_R13;
    case R::kLr:
      return UC_ARM_REG_R14;
    case R::kPc:
      return UC_ARM_REG_R15;
    case R::kXpsr:
      return UC_ARM_REG_XPSR;
    case R::kMsp:
      return UC_ARM_REG_MSP;
    case R::kPsp:
      return UC_ARM_REG_PSP;
    case R::kPrimask:
      return UC_ARM_REG_PRIMASK;
    case R::kBasepri:
      return UC_ARM_REG_BASEPRI;
    case R::kFaultmask:
      return UC_ARM_REG_FAULTMASK;
    case R::kControl:
      return UC_ARM_REG_CONTROL;
    default:
      return UC_ARM_REG_FPSCR;
  }
}

}  // namespace

std::uint32_t CortexM4::Core::get_register(Register which) const {
  return which == Register::kPc ? pc() : engine_.read(unicorn_register(which));
}

void CortexM4::Core::set_register(Register which, std::uint32_t value) {
  switch (which) {
    case Register::kPc:
      next_pc_ = value | 1U;
      break;
    case Register::kXpsr:
      engine_.set_xpsr(value);
      break;
    default:
      engine_.write(unicorn_register(which), value);
      break;
  }
  recheck_exceptions_ = true;
}

}  // namespace groma::sim
