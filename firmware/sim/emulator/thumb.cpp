#include "firmware/sim/emulator/thumb.hpp"

#include <bit>

namespace groma::sim::thumb {
namespace {

constexpr unsigned kSp = 13;
constexpr unsigned kLr = 14;
constexpr unsigned kPc = 15;

constexpr std::uint32_t bits(std::uint32_t value, unsigned high, unsigned low) noexcept {
  return (value >> low) & ((1U << (high - low + 1)) - 1);
}

constexpr std::uint32_t signed_offset(std::uint32_t magnitude, bool add) noexcept {
  return add ? magnitude : 0U - magnitude;
}

// The PC as base of an address: the instruction's address plus 4, aligned (A4.2.1).
constexpr std::uint32_t literal_base(const Registers& r) noexcept {
  return (r[kPc] + 4) & ~3U;
}

MemoryAccess single(bool store, std::uint32_t address, std::uint32_t bytes, unsigned rt) noexcept {
  return {.store = store,
          .address = address,
          .bytes = bytes,
          .base_moves = 0,
          .core_registers = bytes == 4 ? 1U << rt : 0U};
}

std::optional<MemoryAccess> narrow_access(std::uint16_t op, const Registers& r) noexcept {
  const unsigned rt = bits(op, 2, 0);
  const unsigned rn = bits(op, 5, 3);
  if (bits(op, 15, 11) == 0b01001) {  // LDR literal
    return single(false, literal_base(r) + 4 * bits(op, 7, 0), 4, bits(op, 10, 8));
  }
  if (bits(op, 15, 12) == 0b0101) {  // register offset: STR STRH STRB LDRSB LDR LDRH LDRB LDRSH
    constexpr std::array<std::uint32_t, 8> kBytes{4, 2, 1, 1, 4, 2, 1, 2};
    const unsigned kind = bits(op, 11, 9);
    return single(kind < 3, r[rn] + r[bits(op, 8, 6)], kBytes[kind], rt);
  }
  if (bits(op, 15, 13) == 0b011) {  // STR LDR STRB LDRB, immediate
    const std::uint32_t bytes = bits(op, 12, 12) != 0 ? 1 : 4;
    return single(bits(op, 11, 11) == 0, r[rn] + bytes * bits(op, 10, 6), bytes, rt);
  }
  if (bits(op, 15, 12) == 0b1000) {  // STRH LDRH, immediate
    return single(bits(op, 11, 11) == 0, r[rn] + 2 * bits(op, 10, 6), 2, rt);
  }
  if (bits(op, 15, 12) == 0b1001) {  // SP-relative
    return single(bits(op, 11, 11) == 0, r[kSp] + 4 * bits(op, 7, 0), 4, bits(op, 10, 8));
  }
  const auto count = static_cast<std::uint32_t>(std::popcount(bits(op, 8, 0)));
  if (bits(op, 15, 9) == 0b1011010) {  // PUSH
    const std::uint32_t list = bits(op, 7, 0) | bits(op, 8, 8) << kLr;
    return MemoryAccess{true, r[kSp] - 4 * count, 4 * count, -static_cast<std::int32_t>(4 * count), list};
  }
  if (bits(op, 15, 9) == 0b1011110) {  // POP
    const std::uint32_t list = bits(op, 7, 0) | bits(op, 8, 8) << kPc;
    return MemoryAccess{false, r[kSp], 4 * count, static_cast<std::int32_t>(4 * count), list};
  }
  if (bits(op, 15, 12) == 0b1100) {  // STM LDM
    const std::uint32_t list = bits(op, 7, 0);
    const unsigned base = bits(op, 10, 8);
    const bool load = bits(op, 11, 11) != 0;
    const auto bytes = 4 * static_cast<std::uint32_t>(std::popcount(list));
    const bool writes_back = !load || (list >> base & 1U) == 0;
    return MemoryAccess{!load, r[base], bytes, writes_back ? static_cast<std::int32_t>(bytes) : 0, list};
  }
  return std::nullopt;
}

MemoryAccess indexed(bool store, std::uint32_t base, bool index, bool add, bool write_back,
                     std::uint32_t offset, std::uint32_t bytes, std::uint32_t list) noexcept {
  const std::uint32_t moved = signed_offset(offset, add);
  return {.store = store,
          .address = index ? base + moved : base,
          .bytes = bytes,
          .base_moves = write_back ? static_cast<std::int32_t>(moved) : 0,
          .core_registers = list};
}

MemoryAccess multiple(bool store, std::uint32_t base, bool decrement, bool write_back, std::uint32_t words,
                      std::uint32_t list) noexcept {
  const std::uint32_t bytes = 4 * words;
  return {.store = store,
          .address = decrement ? base - bytes : base,
          .bytes = bytes,
          .base_moves = write_back ? static_cast<std::int32_t>(decrement ? 0U - bytes : bytes) : 0,
          .core_registers = list};
}

// A5.3.6: load and store dual and exclusive, table branch.
std::optional<MemoryAccess> dual_or_exclusive(const Instruction& i, const Registers& r) noexcept {
  const unsigned rn = bits(i.first, 3, 0);
  const std::uint32_t base = rn == kPc ? literal_base(r) : r[rn];
  const bool store = bits(i.first, 4, 4) == 0;
  const bool index = bits(i.first, 8, 8) != 0;
  const bool add = bits(i.first, 7, 7) != 0;
  const bool write_back = bits(i.first, 5, 5) != 0;
  const unsigned rt = bits(i.second, 15, 12);
  if (index || write_back) {
    return indexed(store, base, index, add, write_back, 4 * bits(i.second, 7, 0), 8,
                   1U << rt | 1U << bits(i.second, 11, 8));
  }
  if (!add) return single(store, base + 4 * bits(i.second, 7, 0), 4, rt);  // STREX LDREX
  const unsigned kind = bits(i.second, 7, 4);
  if (store || kind >= 4) return single(store, base, kind == 4 ? 1 : 2, rt);  // STREXB STREXH LDREXB LDREXH
  const std::uint32_t table = rn == kPc ? r[kPc] + 4 : base;
  const std::uint32_t entry = r[bits(i.second, 3, 0)];
  if (kind == 0) return single(false, table + entry, 1, 0);  // TBB
  if (kind == 1) return single(false, table + 2 * entry, 2, 0);
  return std::nullopt;
}

// A5.3.7 to A5.3.10: a single register.
std::optional<MemoryAccess> wide_single(const Instruction& i, const Registers& r) noexcept {
  const bool store = bits(i.first, 4, 4) == 0;
  const unsigned size = bits(i.first, 6, 5);
  if (size == 3) return std::nullopt;
  const std::uint32_t bytes = 1U << size;
  const unsigned rn = bits(i.first, 3, 0);
  const unsigned rt = bits(i.second, 15, 12);
  if (!store && rt == kPc && bytes != 4) return std::nullopt;  // preload hints
  const std::uint32_t list = bytes == 4 ? 1U << rt : 0;
  if (rn == kPc) {
    if (store) return std::nullopt;
    return single(false, literal_base(r) + signed_offset(bits(i.second, 11, 0), bits(i.first, 7, 7) != 0),
                  bytes, rt);
  }
  if (bits(i.first, 7, 7) != 0) return single(store, r[rn] + bits(i.second, 11, 0), bytes, rt);
  if (bits(i.second, 11, 11) != 0) {
    return indexed(store, r[rn], bits(i.second, 10, 10) != 0, bits(i.second, 9, 9) != 0,
                   bits(i.second, 8, 8) != 0, bits(i.second, 7, 0), bytes, list);
  }
  if (bits(i.second, 10, 6) != 0) return std::nullopt;
  return single(store, r[rn] + (r[bits(i.second, 3, 0)] << bits(i.second, 5, 4)), bytes, rt);
}

// A6.6: VSTR VLDR VSTM VLDM VPUSH VPOP.
std::optional<MemoryAccess> floating_point_access(const Instruction& i, const Registers& r) noexcept {
  const bool index = bits(i.first, 8, 8) != 0;
  const bool add = bits(i.first, 7, 7) != 0;
  const bool write_back = bits(i.first, 5, 5) != 0;
  const bool store = bits(i.first, 4, 4) == 0;
  const bool doubles = bits(i.second, 8, 8) != 0;
  const unsigned rn = bits(i.first, 3, 0);
  const std::uint32_t base = rn == kPc ? literal_base(r) : r[rn];
  const std::uint32_t immediate = bits(i.second, 7, 0);
  if (!index && !add) return std::nullopt;  // moves between registers
  if (index && !write_back) {
    return indexed(store, base, true, add, false, 4 * immediate, doubles ? 8 : 4, 0);
  }
  return multiple(store, base, index, write_back, immediate, 0);
}

std::optional<MemoryAccess> wide_access(const Instruction& i, const Registers& r) noexcept {
  if (is_floating_point(i)) {
    if (bits(i.first, 11, 9) == 0b110) return floating_point_access(i, r);
    return std::nullopt;
  }
  if (bits(i.first, 15, 9) == 0b1110100) {
    if (bits(i.first, 6, 6) != 0) return dual_or_exclusive(i, r);
    const bool decrement = bits(i.first, 8, 7) == 0b10;  // STMDB LDMDB; the other is IA
    const std::uint32_t list = i.second;
    const unsigned rn = bits(i.first, 3, 0);
    return multiple(bits(i.first, 4, 4) == 0, r[rn], decrement, bits(i.first, 5, 5) != 0,
                    static_cast<std::uint32_t>(std::popcount(list)), list);
  }
  if (bits(i.first, 15, 9) == 0b1111100) return wide_single(i, r);
  return std::nullopt;
}

}  // namespace

Instruction instruction_at(std::span<const std::uint8_t> code) noexcept {
  const auto half = [&](std::size_t at) {
    return at + 1 < code.size() ? static_cast<std::uint16_t>(code[at] | code[at + 1] << 8) : std::uint16_t{0};
  };
  Instruction i{.first = half(0), .second = 0, .bytes = 2};
  if (i.first >= 0xE800) {
    i.second = half(2);
    i.bytes = 4;
  }
  return i;
}

bool is_send_event(const Instruction& i) noexcept {
  return i.first == 0xBF40 || (i.first == 0xF3AF && i.second == 0x8004);
}

bool is_wait_for_event(const Instruction& i) noexcept {
  return i.first == 0xBF20 || (i.first == 0xF3AF && i.second == 0x8002);
}

bool is_wait_for_interrupt(const Instruction& i) noexcept {
  return i.first == 0xBF30 || (i.first == 0xF3AF && i.second == 0x8003);
}

bool writes_special_register(const Instruction& i) noexcept {
  const bool cps = (i.first & 0xFFEC) == 0xB660;
  const bool msr = (i.first & 0xFFE0) == 0xF380 && (i.second & 0xD000) == 0x8000;
  return cps || msr;
}

bool is_floating_point(const Instruction& i) noexcept {
  const bool coprocessor = (i.first & 0xEC00) == 0xEC00;
  return i.bytes == 4 && coprocessor && (i.second & 0x0E00) == 0x0A00;
}

bool is_division(const Instruction& i) noexcept {
  return (i.first & 0xFFD0) == 0xFB90 && (i.second & 0x00F0) == 0x00F0;
}

BlockFacts facts_of_block(std::span<const std::uint8_t> code) noexcept {
  BlockFacts facts;
  for (std::size_t at = 0; at + 1 < code.size();) {
    const Instruction i = instruction_at(code.subspan(at));
    ++facts.instructions;
    if (is_send_event(i)) facts.traits |= kSendsEvent;
    if (writes_special_register(i)) facts.traits |= kWritesSpecialRegister;
    if (is_floating_point(i)) facts.traits |= kFloatingPoint;
    if (is_division(i)) facts.traits |= kDivides;
    at += i.bytes;
  }
  return facts;
}

bool is_polling_loop(std::span<const std::uint8_t> code) noexcept {
  if (code.size() < 2) return false;
  const Instruction load = instruction_at(code);
  if (code.size() != load.bytes + 4) return false;
  unsigned base = 0;
  unsigned loaded = 0;
  if (bits(load.first, 15, 11) == 0b01101) {  // LDR immediate
    base = bits(load.first, 5, 3);
    loaded = bits(load.first, 2, 0);
  } else if (bits(load.first, 15, 4) == 0xF8D) {  // LDR.W immediate
    base = bits(load.first, 3, 0);
    loaded = bits(load.second, 15, 12);
  } else {
    return false;
  }
  const std::uint32_t compare = instruction_at(code.subspan(load.bytes)).first;
  const std::uint32_t branch = instruction_at(code.subspan(load.bytes + 2)).first;
  const bool compares = bits(compare, 15, 11) == 0b00101 && bits(compare, 10, 8) == loaded;
  const bool branches = bits(branch, 15, 12) == 0b1101 && bits(branch, 11, 9) != 0b111;
  const int target = static_cast<int>(load.bytes) + 6 + 2 * static_cast<std::int8_t>(branch & 0xFF);
  return base != loaded && compares && branches && target == 0;
}

void ItState::after(const Instruction& i) noexcept {
  if ((i.first & 0xFF00) == 0xBF00 && (i.first & 0xF) != 0) {
    bits_ = static_cast<std::uint8_t>(i.first & 0xFF);
  } else if ((bits_ & 7) == 0) {
    bits_ = 0;
  } else {
    bits_ = static_cast<std::uint8_t>((bits_ & 0xE0) | (bits_ << 1 & 0x1F));
  }
}

bool ItState::condition_holds(std::uint32_t apsr) const noexcept {
  if (bits_ == 0) return true;
  const bool n = (apsr >> 31 & 1) != 0;
  const bool z = (apsr >> 30 & 1) != 0;
  const bool c = (apsr >> 29 & 1) != 0;
  const bool v = (apsr >> 28 & 1) != 0;
  const auto holds = [&] {
    switch (bits_ >> 5) {
      case 0:
        return z;
      case 1:
        return c;
      case 2:
        return n;
      case 3:
        return v;
      case 4:
        return c && !z;
      case 5:
        return n == v;
      case 6:
        return n == v && !z;
      default:
        return true;
    }
  };
  const bool inverted = (bits_ >> 4 & 1) != 0 && (bits_ >> 4) != 0xF;
  return holds() != inverted;
}

std::optional<MemoryAccess> memory_access(const Instruction& i, const Registers& r) noexcept {
  return i.bytes == 2 ? narrow_access(i.first, r) : wide_access(i, r);
}

}  // namespace groma::sim::thumb
