// An emulated Cortex-M4F core: ARMv7E-M with single-precision FPU, NVIC, SysTick, system control block and
// faults. Section numbers refer to the ARMv7-M Architecture Reference Manual (DDI 0403E).
//
//   CortexM4 cpu(flash, ram, soc);
//   cpu.reset(0);
//   while (cpu.now() < end) {
//     cpu.run(std::min(end, soc.next_event()));
//     if (cpu.sleeping()) cpu.idle_until(std::min({end, soc.next_event(), cpu.next_wake()}));
//     soc.advance(cpu.now());  // raises interrupts by cpu.set_irq()
//   }
//
// Limits of the model:
//  - An instruction takes a fixed time, which includes an average of the flash's wait states.
//  - Interrupts are taken between blocks of straight-line code, never inside one. A block's time is added
//    when it begins, so now() in a bus access is the end of the block that makes it.
//  - Every data bus fault is precise, that of a buffered store too. If two instructions of a block could have
//    made the faulting access (a pointer followed twice through one register), the PC is that of the first.
//  - Code in RAM does not run: a SimulationError.
//  - No MPU, no debug unit. CCR.UNALIGN_TRP cannot be set, and an unaligned LDM or LDRD does not fault.
//  - STREX fails if the word has changed since LDREX; an exception in between alone does not make it fail.
//  - Floating-point context is stacked immediately; lazy stacking (FPCCR.LSPEN) would only change timing.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// Handles accesses to 0x40000000-0x5FFFFFFF and 0x10000000-0x10001FFF (peripherals, FICR, UICR), and stores
// to flash. Addresses are a multiple of `bytes`, which is 1, 2 or 4. May call the CPU's limit(), set_irq()
// and stall(), and may throw: run() passes the exception on. Throws SimulationError for a register that is
// not modelled, with its address and the CPU's pc().
class Bus {
 public:
  Bus() = default;
  Bus(const Bus&) = delete;
  Bus& operator=(const Bus&) = delete;
  virtual ~Bus() = default;

  // False: nothing is mapped there; the firmware gets a bus fault. A word that the CPU reads again and again
  // must not change before the time given to limit() or run(): the CPU passes over the turns of such a loop.
  virtual bool read(std::uint32_t address, unsigned bytes, std::uint32_t& value) = 0;
  virtual bool write(std::uint32_t address, unsigned bytes, std::uint32_t value) = 0;
  // The implementation changes the flash's bytes itself.
  virtual bool flash_write(std::uint32_t address, unsigned bytes, std::uint32_t value) = 0;

  // The CPU falls asleep at t: WFI, WFE or sleep-on-exit with nothing to wake it. Not within an access.
  virtual void on_sleep(SimTime t) { (void)t; }
};

struct CpuTiming {
  SimTime cycle = 4992;                        // 64 MHz
  SimTime instruction = 9984;                  // 2.0 cycles: docs/explanation/silicon.md, A4
  SimTime wake_up = 3 * kUnitsPerMicrosecond;  // from the interrupt that ends a sleep; tIDLE2CPU
  std::uint32_t entry_cycles = 12;             // exception entry, with zero wait states
  std::uint32_t return_cycles = 10;
  std::uint32_t tail_chain_cycles = 6;
};

class CortexM4 {
 public:
  enum class Register : std::uint8_t {
    kR0,
    kR1,
    kR2,
    kR3,
    kR4,
    kR5,
    kR6,
    kR7,
    kR8,
    kR9,
    kR10,
    kR11,
    kR12,
    kSp,
    kLr,
    kPc,
    kXpsr,
    kMsp,
    kPsp,
    kPrimask,
    kBasepri,
    kFaultmask,
    kControl,
    kFpscr
  };

  // Flash is mapped at 0, RAM at 0x20000000; each is a multiple of 4 KiB. Both and the bus must outlive the
  // CPU, which reads and writes RAM in place (DMA may too, between and within bus accesses). After any change
  // of the flash other than by Bus::flash_write, call flash_changed().
  CortexM4(std::span<std::uint8_t> flash, std::span<std::uint8_t> ram, Bus& bus,
           const CpuTiming& timing = {});
  CortexM4(const CortexM4&) = delete;
  CortexM4& operator=(const CortexM4&) = delete;
  ~CortexM4();

  // Loads SP and PC from the vector table at 0. RAM is not changed.
  void reset(SimTime t);

  // Runs until now() reaches `until` (run() returns at the next block boundary, so now() may be later), the
  // CPU sleeps with nothing to wake it, it is locked up, or it has requested a reset. The result does not
  // depend on how the time is divided into runs.
  void run(SimTime until);
  // From within a bus access: this run() ends at t at the latest.
  void limit(SimTime t);
  // Halts the CPU for this long from the end of the present block: a flash write or erase.
  void stall(SimTime duration);

  // The time of the CPU's own crystal.
  [[nodiscard]] SimTime now() const;
  // Advances the time of a CPU that is sleeping, stalled or locked up; t must not exceed next_wake().
  void idle_until(SimTime t);
  // In WFI, WFE or sleep-on-exit with nothing to wake it.
  [[nodiscard]] bool sleeping() const;
  [[nodiscard]] bool sleeping_deep() const;  // with SCR.SLEEPDEEP
  // When the CPU next does something by itself: now(), the end of a stall, SysTick's next interrupt while it
  // sleeps, or kNever.
  [[nodiscard]] SimTime next_wake() const;

  // The level of a peripheral's interrupt line, 0 to 47; it pends while high. May be called at any time, also
  // from within a bus access.
  void set_irq(unsigned irq, bool level);
  void pend_nmi();
  // An external event (WFE).
  void set_event();

  // B1.5.15. Only a reset ends it.
  [[nodiscard]] bool lockup() const;
  // AIRCR.SYSRESETREQ was written.
  [[nodiscard]] bool reset_requested() const;

  // With it, run() throws a SimulationError if the CPU falls asleep without PRIMASK or without four NOPs
  // after the sleep (silicon.hpp, anomaly 220 of the nRF52832).
  void guard_wake_up(bool on);

  // Discards the cached code there.
  void flash_changed(std::uint32_t address, std::size_t bytes);

  // Within a bus access: the PC of the instruction that makes it.
  [[nodiscard]] std::uint32_t pc() const;
  [[nodiscard]] std::uint32_t get_register(Register which) const;
  // Between runs, for fault injection.
  void set_register(Register which, std::uint32_t value);

  [[nodiscard]] std::uint64_t instructions() const;
  [[nodiscard]] std::uint64_t exceptions() const;
  // FNV hash over (address, time) of every block and every exception entry while tracing is on.
  void trace(bool on);
  [[nodiscard]] std::uint64_t trace_hash() const;

  // For test images: BKPT 0xAB calls the handler with R0 (the operation) and R1; its result goes to R0.
  // Without a handler, and for any other BKPT: a HardFault with HFSR.DEBUGEVT.
  void set_semihosting(std::function<std::uint32_t(std::uint32_t operation, std::uint32_t argument)> handler);

 private:
  class Core;
  std::unique_ptr<Core> core_;
};

}  // namespace groma::sim
