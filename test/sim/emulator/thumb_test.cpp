#include "firmware/sim/emulator/thumb.hpp"

#include <gtest/gtest.h>

#include <vector>

namespace groma::sim::thumb {
namespace {

Instruction instruction(std::uint16_t first, std::uint16_t second = 0) {
  return {.first = first, .second = second, .bytes = first >= 0xE800 ? 4U : 2U};
}

TEST(Thumb, CountsInstructionsByTheirLengths) {
  const std::vector<std::uint8_t> code{
      0x00, 0xBF,              // nop
      0x40, 0xF2, 0x01, 0x00,  // movw r0, #1
      0xFE, 0xE7,              // b .
      0x4F, 0xF0, 0x00, 0x01,  // mov.w r1, #0
  };
  const BlockFacts facts = facts_of_block(code);
  EXPECT_EQ(facts.instructions, 4);
  EXPECT_EQ(facts.traits, 0);
}

TEST(Thumb, ClassifiesInstructions) {
  EXPECT_TRUE(is_send_event(instruction(0xBF40)));
  EXPECT_TRUE(is_send_event(instruction(0xF3AF, 0x8004)));
  EXPECT_FALSE(is_send_event(instruction(0xBF20)));
  EXPECT_TRUE(is_wait_for_event(instruction(0xBF20)));
  EXPECT_TRUE(writes_special_register(instruction(0xB662)));           // cpsie i
  EXPECT_TRUE(writes_special_register(instruction(0xB671)));           // cpsid f
  EXPECT_TRUE(writes_special_register(instruction(0xF380, 0x8811)));   // msr basepri, r0
  EXPECT_FALSE(writes_special_register(instruction(0xF3EF, 0x8011)));  // mrs r0, basepri
  EXPECT_TRUE(is_floating_point(instruction(0xEE30, 0x0A00)));         // vadd.f32 s0, s0, s0
  EXPECT_TRUE(is_floating_point(instruction(0xED90, 0x0A00)));         // vldr s0, [r0]
  EXPECT_TRUE(is_floating_point(instruction(0xEE00, 0x0A10)));         // vmov s0, r0
  EXPECT_FALSE(is_floating_point(instruction(0xEE10, 0x0F10)));        // mrc p15, ...
  EXPECT_FALSE(is_floating_point(instruction(0xF04F, 0x0A00)));        // mov.w r10, #0
  EXPECT_TRUE(is_division(instruction(0xFBB0, 0xF0F1)));               // udiv r0, r0, r1
  EXPECT_TRUE(is_division(instruction(0xFB90, 0xF0F1)));               // sdiv r0, r0, r1
  EXPECT_FALSE(is_division(instruction(0xFBA0, 0x0101)));              // umull r0, r1, r0, r1
}

TEST(Thumb, RecognizesAPollingLoop) {
  const auto polls = [](const std::vector<std::uint16_t>& code) {
    std::vector<std::uint8_t> bytes;
    for (const std::uint16_t half : code) {
      bytes.push_back(static_cast<std::uint8_t>(half));
      bytes.push_back(static_cast<std::uint8_t>(half >> 8));
    }
    return is_polling_loop(bytes);
  };
  EXPECT_TRUE(polls({0x6813, 0x2B00, 0xD0FC}));           // ldr r3, [r2]; cmp r3, #0; beq .-4
  EXPECT_TRUE(polls({0xF8D2, 0x3118, 0x2B01, 0xD1FB}));   // ldr.w r3, [r2, #280]; cmp r3, #1; bne .-6
  EXPECT_FALSE(polls({0x6812, 0x2A00, 0xD0FC}));          // ldr r2, [r2]: the address changes
  EXPECT_FALSE(polls({0x6813, 0x2A00, 0xD0FC}));          // cmp r2, #0: another register
  EXPECT_FALSE(polls({0x6813, 0x2B00, 0xD0FB}));          // branches to before the load
  EXPECT_FALSE(polls({0x6813, 0x2B00, 0xDFFC}));          // svc
  EXPECT_FALSE(polls({0x6013, 0x2B00, 0xD0FC}));          // str r3, [r2]
  EXPECT_FALSE(polls({0x7813, 0x2B00, 0xD0FC}));          // ldrb r3, [r2]
  EXPECT_FALSE(polls({0x6813, 0x3B01, 0xD0FC}));          // subs r3, #1
  EXPECT_FALSE(polls({0x6813, 0x2B00, 0xD0FC, 0xBF00}));  // more code
  EXPECT_FALSE(polls({}));
}

TEST(Thumb, WalksThroughItBlocks) {
  ItState it;
  it.after(instruction(0xBF14));  // ite ne
  EXPECT_EQ(it.bits(), 0x14);
  EXPECT_TRUE(it.condition_holds(0));
  EXPECT_FALSE(it.condition_holds(1U << 30));
  it.after(instruction(0x2001));
  EXPECT_FALSE(it.condition_holds(0));
  EXPECT_TRUE(it.condition_holds(1U << 30));
  it.after(instruction(0x2001));
  EXPECT_EQ(it.bits(), 0);
  EXPECT_TRUE(it.condition_holds(1U << 30));
}

TEST(Thumb, EvaluatesConditions) {
  constexpr std::uint32_t kN = 1U << 31;
  constexpr std::uint32_t kZ = 1U << 30;
  constexpr std::uint32_t kC = 1U << 29;
  constexpr std::uint32_t kV = 1U << 28;
  const auto holds = [](std::uint8_t condition, std::uint32_t flags) {
    return ItState(static_cast<std::uint8_t>(condition << 4 | 8)).condition_holds(flags);
  };
  EXPECT_TRUE(holds(0x2, kC));  // cs
  EXPECT_TRUE(holds(0x5, 0));   // pl
  EXPECT_TRUE(holds(0x6, kV));  // vs
  EXPECT_TRUE(holds(0x8, kC));  // hi
  EXPECT_FALSE(holds(0x8, kC | kZ));
  EXPECT_TRUE(holds(0x9, kC | kZ));  // ls
  EXPECT_TRUE(holds(0xA, kN | kV));  // ge
  EXPECT_TRUE(holds(0xB, kN));       // lt
  EXPECT_TRUE(holds(0xC, 0));        // gt
  EXPECT_TRUE(holds(0xD, kZ));       // le
  EXPECT_TRUE(holds(0xE, 0));        // al
}

TEST(Thumb, FindsTheAddressesOfMemoryAccesses) {
  Registers r{};
  r[1] = 0x1000;
  r[2] = 3;
  r[13] = 0x2000;
  r[15] = 0x4002;
  const auto address = [&](std::uint16_t first, std::uint16_t second = 0) {
    const auto access = memory_access(instruction(first, second), r);
    return access ? access->address : 0xFFFFFFFFU;
  };
  EXPECT_EQ(address(0x4801), 0x4008U);              // ldr r0, [pc, #4]
  EXPECT_EQ(address(0xF8DF, 0x0010), 0x4014U);      // ldr.w r0, [pc, #16]
  EXPECT_EQ(address(0xF85F, 0x0010), 0x3FF4U);      // ldr.w r0, [pc, #-16]
  EXPECT_EQ(address(0x9803), 0x200CU);              // ldr r0, [sp, #12]
  EXPECT_EQ(address(0xF831, 0x0012), 0x1006U);      // ldrh.w r0, [r1, r2, lsl #1]
  EXPECT_EQ(address(0xE841, 0x0304), 0x1010U);      // strex r3, r0, [r1, #16]
  EXPECT_EQ(address(0xE8D1, 0x0F5F), 0x1000U);      // ldrexh r0, [r1]
  EXPECT_EQ(address(0xE8D1, 0xF012), 0x1006U);      // tbh [r1, r2, lsl #1]
  EXPECT_EQ(address(0xED2D, 0x8B02), 0x1FF8U);      // vpush {d8}
  EXPECT_EQ(address(0xF891, 0xF000), 0xFFFFFFFFU);  // pld [r1]
  EXPECT_EQ(address(0xEE30, 0x0A00), 0xFFFFFFFFU);  // vadd.f32 s0, s0, s0
  EXPECT_EQ(address(0x1840), 0xFFFFFFFFU);          // adds r0, r0, r1
}

TEST(Thumb, FindsTheWriteBack) {
  Registers r{};
  r[1] = 0x1000;
  const auto access = memory_access(instruction(0xF841, 0x0D08), r);  // str r0, [r1, #-8]!
  ASSERT_TRUE(access);
  EXPECT_TRUE(access->store);
  EXPECT_EQ(access->address, 0xFF8U);
  EXPECT_EQ(access->base_moves, -8);
  EXPECT_EQ(access->core_registers, 1U);
  EXPECT_EQ(access->bytes, 4U);
}

}  // namespace
}  // namespace groma::sim::thumb
