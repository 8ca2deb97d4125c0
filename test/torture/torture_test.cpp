// Runs the torture image on QEMU's Cortex-M4, an independent implementation, and in the project's emulator.
#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <sstream>
#include <string>
#include <vector>

#include "firmware/sim/emulator/cortex_m4.hpp"
#include "test/support/child_process.hpp"
#include "test/support/elf_file.hpp"

namespace groma {
namespace {

constexpr const char* kImage = TORTURE_IMAGE;
constexpr const char* kQemu = "/usr/bin/qemu-system-arm";
constexpr std::uint32_t kRam = 0x20000000;

// A bus without peripherals: the image uses none.
class NoBus final : public sim::Bus {
 public:
  bool read(std::uint32_t, unsigned, std::uint32_t&) override { return false; }
  bool write(std::uint32_t, unsigned, std::uint32_t) override { return false; }
  bool flash_write(std::uint32_t, unsigned, std::uint32_t) override { return false; }
};

struct Outcome {
  std::string text;
  int exit_code = -1;
};

// -icount: QEMU's time advances by instructions, so that no pause of its host adds a SysTick.
Outcome run_on_qemu() {
  const test::ChildResult result = test::run_child(
      {kQemu, "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "none", "-icount",
       "shift=5,sleep=off", "-semihosting-config", "enable=on,target=native", "-kernel", kImage});
  return {.text = result.out + result.err, .exit_code = result.exit_code};
}

// cut: the duration of each run().
Outcome run_on_ours(sim::SimTime cut) {
  constexpr std::uint32_t kWrite0 = 0x04;
  constexpr std::uint32_t kExitExtended = 0x20;
  std::vector<std::uint8_t> flash(std::size_t{64} * 1024, 0xFF);
  std::vector<std::uint8_t> ram(std::size_t{32} * 1024);
  const test::ElfFile image(kImage);
  for (const auto& [address, byte] : image.loaded()) flash.at(address) = byte;
  NoBus bus;
  sim::CortexM4 cpu(flash, ram, bus);
  Outcome outcome;
  const auto byte_at = [&](std::uint32_t address) {
    return address >= kRam ? ram.at(address - kRam) : flash.at(address);
  };
  cpu.set_semihosting([&](std::uint32_t operation, std::uint32_t argument) -> std::uint32_t {
    if (operation == kWrite0) {
      for (std::uint32_t at = argument; byte_at(at) != 0; ++at)
        outcome.text += static_cast<char>(byte_at(at));
    } else if (operation == kExitExtended) {
      outcome.exit_code = byte_at(argument + 4);
      cpu.limit(cpu.now());
    }
    return 0;
  });
  cpu.reset(0);
  const sim::SimTime end = 10 * sim::kUnitsPerSecond;
  while (cpu.now() < end && outcome.exit_code < 0 && !cpu.lockup()) {
    cpu.run(cpu.now() + cut);
    if (cpu.sleeping()) cpu.idle_until(std::min(end, cpu.next_wake()));
  }
  return outcome;
}

class Torture : public testing::Test {
 protected:
  void SetUp() override {
    for (const char* needed : {kImage, kQemu}) {
      if (std::filesystem::exists(needed)) continue;
      const std::string message =
          std::string("no ") + needed + ": run scripts/setup test, configure and build again";
      if (std::getenv("GROMA_REQUIRE_IMAGE") != nullptr) FAIL() << message;
      GTEST_SKIP() << message;
    }
  }
};

std::vector<std::string> lines_of(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(line);
  return lines;
}

TEST_F(Torture, GivesTheSameOutputOnQemuAndInTheEmulator) {
  const Outcome theirs = run_on_qemu();
  EXPECT_EQ(theirs.exit_code, 0) << theirs.text;
  const Outcome ours = run_on_ours(sim::kUnitsPerMillisecond);
  EXPECT_EQ(ours.exit_code, 0);
  const std::vector<std::string> expected = lines_of(theirs.text);
  const std::vector<std::string> seen = lines_of(ours.text);
  EXPECT_GT(expected.size(), 350U);
  EXPECT_EQ(seen.size(), expected.size());
  for (std::size_t i = 0; i < std::min(seen.size(), expected.size()); ++i) {
    ASSERT_EQ(seen[i], expected[i]) << "line " << i + 1 << ", after: " << (i > 0 ? expected[i - 1] : "");
  }
}

TEST_F(Torture, GivesTheSameOutputForAnyDivisionIntoRuns) {
  const Outcome whole = run_on_ours(sim::kUnitsPerSecond);
  EXPECT_EQ(whole.exit_code, 0);
  EXPECT_EQ(run_on_ours(700 * sim::kUnitsPerMicrosecond / 1000).text, whole.text);
}

}  // namespace
}  // namespace groma
