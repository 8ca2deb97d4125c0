// A Cortex-M4F core, instruction by instruction: ARMv7E-M with single precision FPU, NVIC, SysTick, system
// control block and its faults. Section numbers are those of the ARMv7-M Architecture Reference Manual (DDI
// 0403E).
//
//   CortexM4 cpu(flash, ram, soc);
//   cpu.reset(0);
//   while (cpu.now() < end) {
//     cpu.run(std::min(end, soc.next_event()));
//     if (cpu.sleeping()) cpu.idle_until(std::min({end, soc.next_event(), cpu.next_wake()}));
//     soc.advance(cpu.now());  // its interrupts by cpu.set_irq()
//   }
//
// What it does not do:
//  - An instruction costs a fixed time; there are no flash wait states and no bus contention.
//  - Interrupts are taken between blocks of straight-line code, never inside one. A block's time is charged
//    when it begins, so now() in a bus access is the end of the block that makes it.
//  - Every data bus fault is precise, a buffered store's too. Where two instructions of one block could have
//    made the faulting access (a pointer chased twice through one register), the first is told as its PC.
//  - Code in RAM is not run: a SimulationError.
//  - No MPU, no debug unit. CCR.UNALIGN_TRP cannot be set, and an unaligned LDM or LDRD does not fault.
//  - STREX fails where the word has changed since LDREX; an exception in between alone does not make it fail.
//  - Floating-point context is stacked at once; lazy stacking (FPCCR.LSPEN) changes time alone.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>

#include "firmware/sim/time.hpp"

namespace groma::sim {

// What lies at 0x40000000-0x5FFFFFFF and 0x10000000-0x10001FFF (peripherals, FICR, UICR), and who decides on
// stores to flash. Addresses are a multiple of `bytes`, which is 1, 2 or 4. May call the CPU's limit(),
// set_irq() and stall(), and throw: the exception leaves run(). Throws SimulationError for a register that
// is not modelled, naming its address and the CPU's pc().
class Bus {
 public:
  Bus() = default;
  Bus(const Bus&) = delete;
  Bus& operator=(const Bus&) = delete;
  virtual ~Bus() = default;

  // False: nothing is there, a bus fault for the firmware.
  virtual bool read(std::uint32_t address, unsigned bytes, std::uint32_t& value) = 0;
  virtual bool write(std::uint32_t address, unsigned bytes, std::uint32_t value) = 0;
  // Whoever implements it changes the flash's bytes itself.
  virtual bool flash_write(std::uint32_t address, unsigned bytes, std::uint32_t value) = 0;
};

struct CpuTiming {
  SimTime cycle = 4992;             // 64 MHz
  SimTime instruction = 6240;       // 1.25 cycles
  std::uint32_t entry_cycles = 12;  // of an exception, with zero wait states
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

  // Flash at 0, RAM at 0x20000000, each a multiple of 4 KiB; both and the bus outlive the CPU, which reads
  // and writes RAM in place (so may DMA, between and within bus accesses). Flash that is changed from
  // outside by anything but Bus::flash_write needs flash_changed().
  CortexM4(std::span<std::uint8_t> flash, std::span<std::uint8_t> ram, Bus& bus,
           const CpuTiming& timing = {});
  CortexM4(const CortexM4&) = delete;
  CortexM4& operator=(const CortexM4&) = delete;
  ~CortexM4();

  // Loads SP and PC from the vector table at 0. RAM keeps its content.
  void reset(SimTime t);

  // Runs until now() reaches `until` (at the first block boundary then, so now() may lie beyond it), it
  // sleeps with nothing to wake it, it is locked up or has asked for a reset. How a stretch of time is cut
  // into runs changes nothing of what happens in it.
  void run(SimTime until);
  // From within a bus access: ends this run() at t at the latest.
  void limit(SimTime t);
  // The CPU does nothing for this long, from the end of the present block on: a flash write or erase.
  void stall(SimTime duration);

  // Of the CPU's own crystal.
  [[nodiscard]] SimTime now() const;
  // Lets time pass for a CPU that is sleeping, stalled or locked up; t not beyond next_wake().
  void idle_until(SimTime t);
  // In WFI, WFE or sleep-on-exit with nothing to wake it.
  [[nodiscard]] bool sleeping() const;
  [[nodiscard]] bool sleeping_deep() const;  // with SCR.SLEEPDEEP
  // When it next does something by itself: now(), a stall's end, SysTick's next interrupt while it sleeps,
  // kNever.
  [[nodiscard]] SimTime next_wake() const;

  // The level of a peripheral's interrupt line, 0 to 47: pends while high. Any time, also from within a bus
  // access.
  void set_irq(unsigned irq, bool level);
  void pend_nmi();
  // An event from outside (WFE).
  void set_event();

  // B1.5.15. Nothing but a reset ends it.
  [[nodiscard]] bool lockup() const;
  // AIRCR.SYSRESETREQ was written.
  [[nodiscard]] bool reset_requested() const;

  // Drops what is known of the code there.
  void flash_changed(std::uint32_t address, std::size_t bytes);

  // Within a bus access: that of the instruction that makes it.
  [[nodiscard]] std::uint32_t pc() const;
  [[nodiscard]] std::uint32_t get_register(Register which) const;
  // Between runs, for fault injection.
  void set_register(Register which, std::uint32_t value);

  [[nodiscard]] std::uint64_t instructions() const;
  [[nodiscard]] std::uint64_t exceptions() const;
  // FNV over (address, time) of every block and every exception entry while tracing: equal for equal runs.
  void trace(bool on);
  [[nodiscard]] std::uint64_t trace_hash() const;

  // Test images: BKPT 0xAB calls this with R0 (the operation) and R1; its result goes to R0. Without it, and
  // for any other BKPT, a HardFault with HFSR.DEBUGEVT.
  void set_semihosting(std::function<std::uint32_t(std::uint32_t operation, std::uint32_t argument)> handler);

 private:
  class Core;
  std::unique_ptr<Core> core_;
};

}  // namespace groma::sim
