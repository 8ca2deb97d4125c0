// The implementation of CortexM4: Unicorn executes code; this class decides what it executes next.
#pragma once

#include <array>
#include <cstdint>
#include <exception>
#include <functional>
#include <optional>
#include <set>
#include <span>
#include <utility>
#include <vector>

#include "firmware/sim/emulator/cortex_m4.hpp"
#include "firmware/sim/emulator/nvic.hpp"
#include "firmware/sim/emulator/sys_tick.hpp"
#include "firmware/sim/emulator/system_control.hpp"
#include "firmware/sim/emulator/thumb.hpp"
#include "firmware/sim/emulator/unicorn_engine.hpp"

namespace groma::sim {

class CortexM4::Core {
 public:
  Core(std::span<std::uint8_t> flash, std::span<std::uint8_t> ram, Bus& bus, const CpuTiming& timing);

  void reset(SimTime t);
  void run(SimTime until);
  void limit(SimTime t);
  void stall(SimTime duration);
  void idle_until(SimTime t);
  [[nodiscard]] SimTime now() const { return now_; }
  [[nodiscard]] bool sleeping() const;
  [[nodiscard]] bool sleeping_deep() const { return sleeping() && control_.sleeps_deep(); }
  [[nodiscard]] SimTime next_wake() const;
  void set_line(unsigned exception, bool level);
  void pend(unsigned exception);
  void set_event() { event_ = true; }
  [[nodiscard]] bool lockup() const { return lockup_; }
  [[nodiscard]] bool reset_requested() const { return control_.reset_requested(); }
  void guard_wake_up(bool on) { guards_wake_up_ = on; }
  void flash_changed(std::uint32_t address, std::size_t bytes);
  [[nodiscard]] std::uint32_t pc() const;
  [[nodiscard]] std::uint32_t get_register(Register which) const;
  void set_register(Register which, std::uint32_t value);
  [[nodiscard]] std::uint64_t instructions() const { return instructions_; }
  [[nodiscard]] std::uint64_t exceptions() const { return exceptions_; }
  void trace(bool on) { tracing_ = on; }
  [[nodiscard]] std::uint64_t trace_hash() const { return trace_hash_; }
  void set_semihosting(std::function<std::uint32_t(std::uint32_t, std::uint32_t)> handler) {
    semihosting_ = std::move(handler);
  }

 private:
  enum class Sleep : std::uint8_t { kAwake, kForInterrupt, kForEvent };

  struct CodeBlock {
    std::uint32_t address = 0;
    std::uint32_t bytes = 0;
  };

  // Cached facts of a block, packed into two bytes: nodes alternate, and the host's cache holds little of
  // each.
  struct Facts {
    std::uint16_t instructions : 10 = 0;  // 0: not cached
    std::uint16_t length : 2 = 0;         // half-words, low bits: detects another block at the same address
    std::uint16_t traits : 4 = 0;
  };

  // The CPU's present access to something other than memory.
  struct Access {
    std::uint32_t address = 0;
    bool store = false;
  };

  // The exception that an instruction raised, and the registers before that instruction.
  struct Stopped {
    unsigned exception = 0;
    std::uint32_t fault_bits = 0;
    std::optional<std::uint32_t> bus_address{};
    thumb::Registers registers{};
    std::uint32_t xpsr = 0;
  };

  // An instruction of the present block and its IT state.
  struct Place {
    std::uint32_t address = 0;
    thumb::ItState it{};
  };

  // Unicorn's callbacks.
  static void on_block(uc_engine* engine, std::uint64_t address, std::uint32_t bytes, void* self);
  static void on_watched(uc_engine* engine, std::uint64_t address, std::uint32_t bytes, void* self);
  static void on_interrupt(uc_engine* engine, std::uint32_t number, void* self);
  static bool on_unmapped(uc_engine* engine, int type, std::uint64_t address, int bytes, std::int64_t value,
                          void* self);
  static bool on_ram_store(uc_engine* engine, int type, std::uint64_t address, int bytes, std::int64_t value,
                           void* self);
  static bool on_flash_store(uc_engine* engine, int type, std::uint64_t address, int bytes,
                             std::int64_t value, void* self);
  template <std::uint32_t base>
  static std::uint64_t on_bus_read(uc_engine* engine, std::uint64_t offset, unsigned bytes, void* self);
  template <std::uint32_t base>
  static void on_bus_write(uc_engine* engine, std::uint64_t offset, unsigned bytes, std::uint64_t value,
                           void* self);
  static std::uint64_t on_private_read(uc_engine* engine, std::uint64_t offset, unsigned bytes, void* self);
  static void on_private_write(uc_engine* engine, std::uint64_t offset, unsigned bytes, std::uint64_t value,
                               void* self);

  // Blocks of code (cortex_m4_core.cpp).
  [[nodiscard]] std::span<const std::uint8_t> memory_at(std::uint32_t address, std::size_t bytes) const;
  [[nodiscard]] Facts facts_of(const CodeBlock& block);
  [[nodiscard]] Facts analyse(const CodeBlock& block) const;
  [[nodiscard]] bool attend(unsigned traits, const CodeBlock& block);
  void watch_instructions_of(const CodeBlock& block);
  void stop_before(const CodeBlock& block);
  void exceptions_changed();
  void update_attention();
  void count_ticks();
  void pass_over_turns(const CodeBlock& block);
  void trace_point(std::uint64_t what);

  // Bus accesses and their faults.
  template <typename Call>
  bool guarded(const Access& access, Call call);
  void stop_instruction(unsigned exception, std::uint32_t fault_bits, const Place& place);
  void stop_for_bus_fault(const Access& access);
  [[nodiscard]] Place place_of(const Access& access) const;
  [[nodiscard]] Place place_at(std::uint32_t address) const;
  [[nodiscard]] bool was_completed(const thumb::MemoryAccess& access, const thumb::Registers& now) const;

  void execute();
  void after_event(uc_err result);
  [[nodiscard]] thumb::Instruction last_instruction() const;
  void fall_asleep(Sleep kind);
  [[nodiscard]] bool wakes_up_quietly() const;
  [[nodiscard]] bool wakes() const;

  // Exceptions (cortex_m4_exceptions.cpp).
  [[nodiscard]] bool take_pending();
  void fault(unsigned exception, std::uint32_t fault_bits, std::uint32_t return_pc);
  void hard_fault(std::uint32_t status);
  void pend_derived(unsigned exception);
  [[nodiscard]] std::uint32_t push_frame();
  void take(std::uint32_t exc_return, std::uint32_t cycles);
  void return_from_exception(std::uint32_t exc_return);
  void invalid_return(std::uint32_t exc_return);
  [[nodiscard]] bool pop_frame(std::uint32_t exc_return);
  void breakpoint();
  void lock_up();
  [[nodiscard]] bool store_word(std::uint32_t address, std::uint32_t value);
  [[nodiscard]] bool load_word(std::uint32_t address, std::uint32_t& value) const;
  void add_cycles(std::uint32_t cycles) { now_ += static_cast<SimTime>(cycles) * timing_.cycle; }

  // The members that every block uses, in one cache line.
  alignas(64) SimTime now_ = 0;
  SimTime limit_ = 0;  // no block begins at or after it
  SimTime instruction_time_;
  std::uint64_t instructions_ = 0;
  CodeBlock block_;
  unsigned attention_ = 0;  // traits that need attend() now
  bool tracing_ = false;
  bool bus_read_ = false;     // by the present block
  std::vector<Facts> facts_;  // of the blocks that begin at each half-word of the flash

  std::span<std::uint8_t> flash_;
  std::span<std::uint8_t> ram_;
  Bus& bus_;
  CpuTiming timing_;
  mutable UnicornEngine engine_;
  Nvic nvic_;
  SysTick sys_tick_;
  SystemControl control_;

  SimTime until_ = 0;  // end of this run()
  SimTime stalled_until_ = 0;
  std::uint32_t next_pc_ = 0;  // between executions; bit 0 is the T bit
  Sleep sleep_ = Sleep::kAwake;
  bool guards_wake_up_ = false;
  bool idle_ = false;  // asleep with nothing to wake it, so that waking takes time
  bool event_ = false;
  bool recheck_exceptions_ = false;  // an exception may now be taken
  bool lockup_ = false;
  std::uint64_t pending_before_ = 0;

  // Within an execution.
  bool stopped_before_block_ = false;
  bool watch_block_ = false;
  int interrupt_ = -1;
  std::optional<Access> access_;
  std::optional<Stopped> stopped_;
  std::exception_ptr error_;

  std::set<std::uint32_t> watched_;                                   // instructions
  std::set<std::pair<std::uint32_t, std::uint32_t>> watched_blocks_;  // address, bytes
  std::vector<CodeBlock> changed_code_;

  std::uint64_t exceptions_ = 0;
  std::uint64_t trace_hash_ = 0xCBF29CE484222325U;
  std::function<std::uint32_t(std::uint32_t, std::uint32_t)> semihosting_;
};

}  // namespace groma::sim
