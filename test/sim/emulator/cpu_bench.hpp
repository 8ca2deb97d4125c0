// A test bench of a processor with its memories: code by half-words, handlers, a bus of a few words.
#pragma once

#include <cstdint>
#include <cstring>
#include <functional>
#include <map>
#include <vector>

#include "firmware/sim/emulator/cortex_m4.hpp"

namespace groma::sim {

class CpuBench final : public Bus {
 public:
  using Register = CortexM4::Register;
  using Code = std::vector<std::uint16_t>;

  static constexpr std::uint32_t kMain = 0x200;      // where the program begins
  static constexpr std::uint32_t kHandler = 0x1000;  // of faults; leaves CFSR, HFSR and BFAR in R8 to R10
  static constexpr std::uint32_t kFaultSeen = 0x1014;
  static constexpr std::uint32_t kRam = 0x20000000;
  static constexpr std::uint32_t kRamBytes = 0x4000;
  static constexpr std::uint32_t kStack = kRam + kRamBytes;
  static constexpr std::uint32_t kBus = 0x40000000;

  static constexpr unsigned kNmi = 2;
  static constexpr unsigned kHardFault = 3;
  static constexpr unsigned kMemManage = 4;
  static constexpr unsigned kBusFault = 5;
  static constexpr unsigned kUsageFault = 6;
  static constexpr unsigned kSvCall = 11;
  static constexpr unsigned kPendSv = 14;
  static constexpr unsigned kSysTick = 15;
  static constexpr unsigned kIrq0 = 16;

  explicit CpuBench(const CpuTiming& timing = {})
      : flash_(0x8000, 0xFF), ram_(kRamBytes), cpu_(flash_, ram_, *this, timing) {
    put_word(0, kStack);
    put_word(4, kMain | 1);
    for (const unsigned fault : {kHardFault, kMemManage, kBusFault, kUsageFault}) handler(fault, kHandler);
    put(kHandler, {
                      0xF64E, 0x5028,  // movw r0, #0xED28
                      0xF2CE, 0x0000,  // movt r0, #0xE000
                      0xF8D0, 0x8000,  // ldr.w r8, [r0]
                      0xF8D0, 0x9004,  // ldr.w r9, [r0, #4]
                      0xF8D0, 0xA010,  // ldr.w r10, [r0, #16]
                      0xE7FE,          // b .
                  });
  }

  void put(std::uint32_t address, const Code& code) {
    for (const std::uint16_t half : code) {
      std::memcpy(at(address), &half, sizeof half);
      address += 2;
    }
  }
  void put_word(std::uint32_t address, std::uint32_t value) {
    std::memcpy(at(address), &value, sizeof value);
  }
  [[nodiscard]] std::uint32_t word(std::uint32_t address) {
    std::uint32_t value = 0;
    std::memcpy(&value, at(address), sizeof value);
    return value;
  }
  void handler(unsigned exception, std::uint32_t address) { put_word(4 * exception, address | 1); }

  // Runs the program from reset for `duration`.
  void run(const Code& program, SimTime duration = kUnitsPerMillisecond) {
    put(kMain, program);
    cpu_.reset(0);
    run_for(duration);
  }
  void run_for(SimTime duration) {
    const SimTime end = cpu_.now() + duration;
    cpu_.run(end);
    if (cpu_.now() < end) cpu_.idle_until(end);
  }

  [[nodiscard]] CortexM4& cpu() { return cpu_; }
  [[nodiscard]] std::uint32_t r(unsigned number) {
    return cpu_.get_register(static_cast<Register>(static_cast<unsigned>(Register::kR0) + number));
  }
  [[nodiscard]] std::uint32_t reg(Register which) { return cpu_.get_register(which); }
  // Words of the frame on top of the stack.
  [[nodiscard]] std::uint32_t stacked(unsigned index) { return word(reg(Register::kSp) + 4 * index); }
  [[nodiscard]] std::uint32_t stacked_pc() { return stacked(6); }
  [[nodiscard]] std::uint32_t stacked_xpsr() { return stacked(7); }
  [[nodiscard]] std::uint32_t ipsr() { return reg(Register::kXpsr) & 0x1FF; }

  // The bus: words that are kept, and callbacks for writes.
  std::map<std::uint32_t, std::uint32_t> registers;
  std::function<void(std::uint32_t address, std::uint32_t value)> on_write;
  std::function<bool(std::uint32_t address, std::uint32_t value)> on_flash_write;

  int reads = 0;

  bool read(std::uint32_t address, unsigned, std::uint32_t& value) override {
    ++reads;
    const auto found = registers.find(address);
    if (found == registers.end()) return false;
    value = found->second;
    return true;
  }
  bool write(std::uint32_t address, unsigned, std::uint32_t value) override {
    if (on_write) on_write(address, value);
    const auto found = registers.find(address);
    if (found == registers.end()) return false;
    found->second = value;
    return true;
  }
  bool flash_write(std::uint32_t address, unsigned, std::uint32_t value) override {
    if (!on_flash_write || !on_flash_write(address, value)) return false;
    put_word(address, word(address) & value);
    return true;
  }

 private:
  [[nodiscard]] std::uint8_t* at(std::uint32_t address) {
    return address >= kRam ? &ram_[address - kRam] : &flash_[address];
  }

  std::vector<std::uint8_t> flash_;
  std::vector<std::uint8_t> ram_;
  CortexM4 cpu_;
};

}  // namespace groma::sim
