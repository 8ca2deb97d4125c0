// Decodes Thumb-2 code as far as the emulator needs: instruction lengths, a few kinds of instructions, and
// the memory that a load or store accesses. Encodings: ARMv7-M Architecture Reference Manual (DDI 0403E),
// A5-A7.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

namespace groma::sim::thumb {

struct Instruction {
  std::uint16_t first = 0;
  std::uint16_t second = 0;  // of a 32-bit instruction
  unsigned bytes = 2;
};

// The instruction at the start of `code`, which holds at least 2 bytes. The missing half of a truncated
// 32-bit instruction reads as zero.
[[nodiscard]] Instruction instruction_at(std::span<const std::uint8_t> code) noexcept;

[[nodiscard]] bool is_send_event(const Instruction& i) noexcept;
[[nodiscard]] bool is_wait_for_event(const Instruction& i) noexcept;
[[nodiscard]] bool is_wait_for_interrupt(const Instruction& i) noexcept;
// CPS, and MSR to any register.
[[nodiscard]] bool writes_special_register(const Instruction& i) noexcept;
// An instruction of coprocessor 10 or 11.
[[nodiscard]] bool is_floating_point(const Instruction& i) noexcept;
[[nodiscard]] bool is_division(const Instruction& i) noexcept;

// Traits: the kinds of instructions in a block of code.
inline constexpr std::uint8_t kSendsEvent = 1;
inline constexpr std::uint8_t kWritesSpecialRegister = 2;
inline constexpr std::uint8_t kFloatingPoint = 4;
inline constexpr std::uint8_t kDivides = 8;

struct BlockFacts {
  std::uint16_t instructions = 0;
  std::uint8_t traits = 0;
};

[[nodiscard]] BlockFacts facts_of_block(std::span<const std::uint8_t> code) noexcept;

// The code is nothing but this loop: load a word, compare it with a number, branch back on a condition.
[[nodiscard]] bool is_polling_loop(std::span<const std::uint8_t> code) noexcept;
inline constexpr unsigned kPollingInstructions = 3;

// The state of an IT block (EPSR.IT, B1.4.2): 0 outside an IT block.
class ItState {
 public:
  explicit ItState(std::uint8_t bits = 0) noexcept : bits_(bits) {}
  // Advances the state by an instruction: IT starts a block, any other proceeds within it.
  void after(const Instruction& i) noexcept;
  [[nodiscard]] std::uint8_t bits() const noexcept { return bits_; }
  // With the flags in the top bits of `apsr`.
  [[nodiscard]] bool condition_holds(std::uint32_t apsr) const noexcept;

 private:
  std::uint8_t bits_;
};

using Registers = std::array<std::uint32_t, 16>;  // R15 is the instruction's own address

// The memory that a load or store accesses.
struct MemoryAccess {
  bool store = false;
  std::uint32_t address = 0;  // of the lowest byte
  std::uint32_t bytes = 0;
  std::int32_t base_moves = 0;       // change of the base register by write-back
  std::uint32_t core_registers = 0;  // mask of those loaded or stored in order of address; word accesses only
};

// `r`: the registers before the instruction. nullopt: not a load or store.

[[nodiscard]] std::optional<MemoryAccess> memory_access(const Instruction& i, const Registers& r) noexcept;

}  // namespace groma::sim::thumb
