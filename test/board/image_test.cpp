// The contents of each board's image, and the linker's rejection of forbidden contents.
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <fstream>
#include <map>
#include <memory>
#include <set>
#include <sstream>
#include <string>
#include <vector>

#include "firmware/core/node/image_identity.hpp"
#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/emulator/hex_file.hpp"
#include "test/board/image_file.hpp"
#include "test/support/child_process.hpp"
#include "test/support/elf_file.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma {
namespace {

using test::ElfFile;

// As in firmware/soc/nrf52832/nrf52832.ld, which gives the reasons.
constexpr std::uint32_t kFlashBudget = 192 * 1024;
constexpr std::uint32_t kRamBudget = 48 * 1024;
constexpr std::uint32_t kRam = sim::kRamAddress;
constexpr std::uint32_t kThumb = 1;

class Image : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override {
    GROMA_NEEDS_SHIPPED_IMAGE();
    elf_ = std::make_unique<ElfFile>(test::image_file(GetParam(), ".elf"));
  }

  std::unique_ptr<ElfFile> elf_;
};

INSTANTIATE_TEST_SUITE_P(Boards, Image, testing::Values(test::kShippedImage, test::kBareBoardImage),
                         [](const auto& board) {
                           return board.param == std::string(test::kShippedImage) ? "Dwm1001" : "BareBoard";
                         });

TEST_P(Image, FitsItsBudgetOfFlashAndRam) {
  EXPECT_GT(elf_->loaded().size(), 16U * 1024);
  EXPECT_LE(elf_->loaded().rbegin()->first + 1, kFlashBudget);
  std::uint32_t ram_end = kRam;
  for (const auto& [name, section] : elf_->sections()) {
    if (section.in_memory && section.address >= kRam) {
      ram_end = std::max(ram_end, section.address + section.bytes);
    }
  }
  EXPECT_LE(ram_end - kRam, kRamBudget);
  RecordProperty("flash_bytes", static_cast<int>(elf_->loaded().size()));
  RecordProperty("ram_bytes", static_cast<int>(ram_end - kRam));
}

TEST_P(Image, HasItsStackAtTheBottomOfTheRam) {
  EXPECT_EQ(elf_->symbol("groma_stack_begin"), kRam);
  EXPECT_GE(elf_->symbol("groma_stack_end"), kRam + 4 * 1024);
  EXPECT_EQ(elf_->symbol("groma_stack_end") % 8, 0U);
  EXPECT_GE(elf_->symbol("groma_data_begin"), elf_->symbol("groma_fault_stack_end"));
}

TEST_P(Image, HasNoHeapNoExceptionsAndNoFiles) {
  const std::set<std::string> forbidden{"malloc",
                                        "_malloc_r",
                                        "free",
                                        "_free_r",
                                        "calloc",
                                        "realloc",
                                        "_sbrk",
                                        "_sbrk_r",
                                        "sbrk",
                                        "__cxa_throw",
                                        "__cxa_guard_acquire",
                                        "__cxa_atexit",
                                        "atexit",
                                        "__cxa_allocate_exception",
                                        "_Unwind_RaiseException",
                                        "printf",
                                        "_vfprintf_r",
                                        "abort",
                                        "__gxx_personality_v0",
                                        "exit",
                                        "_exit",
                                        "_write"};
  for (const auto& [name, value] : elf_->symbols()) {
    EXPECT_FALSE(forbidden.contains(name)) << name;
    // All forms of operator new, new[], delete and delete[].
    for (const char* prefix : {"_Znw", "_Zna", "_Zdl", "_Zda"})
      EXPECT_FALSE(name.starts_with(prefix)) << name;
  }
  EXPECT_EQ(elf_->section(".ARM.extab").bytes, 0U);
  // The compiler's 64-bit division has one entry.
  EXPECT_LE(elf_->section(".ARM.exidx").bytes, 16U);
  EXPECT_EQ(elf_->section(".eh_frame").bytes, 0U);
}

TEST_P(Image, BeginsWithAVectorTableOfItsHandlers) {
  EXPECT_EQ(elf_->section(".vectors").address, 0U);
  const auto handler = [this](const char* name) { return elf_->symbol(name) | kThumb; };
  EXPECT_EQ(elf_->loaded_word(0), elf_->symbol("groma_stack_end"));
  EXPECT_EQ(elf_->loaded_word(4), handler("reset_entry"));
  EXPECT_EQ(elf_->entry() | kThumb, handler("reset_entry"));

  constexpr std::uint32_t kExceptions = 16;
  constexpr std::uint32_t kInterrupts = 39;
  const std::map<std::uint32_t, const char*> served{{kExceptions + 2, "uarte0_entry"},
                                                    {kExceptions + 6, "gpiote_entry"},
                                                    {kExceptions + 8, "timer0_entry"},
                                                    {kExceptions + 14, "ecb_entry"},
                                                    {kExceptions + 16, "watchdog_entry"}};
  EXPECT_GE(elf_->section(".vectors").bytes, 4 * (kExceptions + kInterrupts));
  for (std::uint32_t vector = 2; vector < kExceptions + kInterrupts; ++vector) {
    const std::uint32_t entry = elf_->loaded_word(4 * vector);
    EXPECT_TRUE((entry & kThumb) != 0 && entry > elf_->symbol("groma_text_begin") &&
                entry < elf_->symbol("groma_text_end"))
        << "vector " << vector;
    const auto found = served.find(vector);
    EXPECT_EQ(entry, handler(found == served.end() ? "fault_entry" : found->second)) << "vector " << vector;
  }
}

TEST_P(Image, NamesItsBoard) {
  using node::ImageIdentity;
  std::string begin(ImageIdentity::kSearched_bytes, '\xFF');
  for (const auto& [address, byte] : elf_->loaded()) {
    if (address < begin.size()) begin[address] = static_cast<char>(byte);
  }
  const std::size_t at = begin.find(std::string(ImageIdentity::kMark.begin(), ImageIdentity::kMark.end()));
  ASSERT_NE(at, std::string::npos);
  const auto text = [&](std::size_t offset, std::size_t bytes) { return begin.substr(at + offset, bytes); };
  EXPECT_EQ(text(offsetof(ImageIdentity, board_mark), sizeof(ImageIdentity::board_mark)), "GROMABRD");
  std::string name = GetParam() == std::string(test::kShippedImage) ? "dwm1001" : "nrf52832_dw1000";
  name.resize(sizeof(ImageIdentity::board));
  EXPECT_EQ(text(offsetof(ImageIdentity, board), name.size()), name);
}

TEST_P(Image, KeepsItsFaultRecordAtStartUp) {
  const ElfFile::Section kept = elf_->section(".noinit");
  EXPECT_GT(kept.bytes, 0U);
  EXPECT_FALSE(kept.has_content);
  const auto inside = [&](std::uint32_t begin, std::uint32_t end) {
    return begin < kept.address + kept.bytes && end > kept.address;
  };
  EXPECT_FALSE(inside(elf_->symbol("groma_data_begin"), elf_->symbol("groma_data_end")));
  EXPECT_FALSE(inside(elf_->symbol("groma_bss_begin"), elf_->symbol("groma_bss_end")));
  EXPECT_FALSE(inside(elf_->symbol("groma_stack_begin"), elf_->symbol("groma_fault_stack_end")));
}

TEST_P(Image, HasTheSameContentInBothFiles) {
  std::ifstream file(test::image_file(GetParam(), ".hex"));
  std::ostringstream text;
  text << file.rdbuf();
  std::map<std::uint32_t, std::uint8_t> flashed;
  for (const sim::HexSegment& segment : sim::parse_hex(text.str())) {
    for (std::uint32_t i = 0; i < segment.bytes.size(); ++i) flashed[segment.address + i] = segment.bytes[i];
  }
  EXPECT_EQ(flashed, elf_->loaded());
}

// ---- checks of the linker script --------------------------------------------------------------------------

test::ChildResult link(const std::string& source) {
  const test::ScratchFolder folder;
  const std::filesystem::path file = folder.path() / "image.c";
  std::ofstream(file) << source;
  const std::string script = std::string(GROMA_SOURCE_DIR) + "/firmware/soc/nrf52832/nrf52832.ld";
  return test::run_child({"/usr/bin/env", "arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-ffreestanding",
                          "-nostartfiles", "--specs=nano.specs", "--specs=nosys.specs", "-Wl,--gc-sections",
                          std::string("-L") + GROMA_SOURCE_DIR, "-Wl,--script=" + script, "-o",
                          (folder.path() / "image.elf").string(), file.string()});
}

class Linker : public testing::Test {
 protected:
  void SetUp() override { GROMA_NEEDS_SHIPPED_IMAGE(); }
};

TEST_F(Linker, AcceptsAValidImage) {
  const auto result = link("void reset_entry(void) {}");
  EXPECT_EQ(result.exit_code, 0) << result.err;
}

TEST_F(Linker, RefusesTheHeap) {
  const auto result =
      link("#include <stdlib.h>\nvoid* volatile p; void reset_entry(void) { p = malloc(4); }");
  EXPECT_NE(result.exit_code, 0);
  EXPECT_THAT(result.err, testing::HasSubstr("the heap is pulled in"));
}

TEST_F(Linker, RefusesOperatorNew) {
  const auto result =
      link("void* _Znwj(unsigned n) { return (void*)n; } void reset_entry(void) { _Znwj(4); }");
  EXPECT_NE(result.exit_code, 0);
  EXPECT_THAT(result.err, testing::HasSubstr("operator new is pulled in"));
}

TEST_F(Linker, RefusesExceptions) {
  const auto result = link("void __cxa_throw(void) {} void reset_entry(void) { __cxa_throw(); }");
  EXPECT_NE(result.exit_code, 0);
  EXPECT_THAT(result.err, testing::HasSubstr("exceptions or destructors of statics are pulled in"));
}

TEST_F(Linker, RefusesMoreRamAndFlashThanTheBudget) {
  const auto ram = link("char big[48 * 1024]; void reset_entry(void) { big[0] = 1; }");
  EXPECT_NE(ram.exit_code, 0);
  EXPECT_THAT(ram.err, testing::HasSubstr("region `ram' overflowed"));
  const auto flash = link(
      "const char big[192 * 1024] = {1}; char c; void reset_entry(void) { c = *(volatile const char*)big; }");
  EXPECT_NE(flash.exit_code, 0);
  EXPECT_THAT(flash.err, testing::HasSubstr("region `flash' overflowed"));
}

}  // namespace
}  // namespace groma
