#include "firmware/sim/emulator/hex_file.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <filesystem>
#include <string>

#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {
namespace {

using ::testing::ElementsAre;
using ::testing::HasSubstr;

std::string error_of(const std::string& text) {
  try {
    (void)parse_hex(text);
  } catch (const SimulationError& error) {
    return error.what();
  }
  return {};
}

TEST(HexFile, ReadsDataAtSegmentAndLinearAddresses) {
  const auto segments = parse_hex(
      ":020000040001F9\r\n"
      ":04FFFC0001020304F7\r\n"
      ":020000040002F8\r\n"
      ":020000000506F3\r\n"
      "\r\n"
      ":020000021000EC\r\n"
      ":010010001FD0\r\n"
      ":04000005000001C135\r\n"
      ":00000001FF\r\n");
  ASSERT_EQ(segments.size(), 2U);
  EXPECT_EQ(segments[0].address, 0x1FFFCU);
  EXPECT_THAT(segments[0].bytes, ElementsAre(1, 2, 3, 4, 5, 6));
  EXPECT_EQ(segments[1].address, 0x10010U);
  EXPECT_THAT(segments[1].bytes, ElementsAre(0x1F));
}

TEST(HexFile, NamesTheLineAndTheCause) {
  const std::string end = "\n:00000001FF\n";
  EXPECT_THAT(error_of(":00000001FF\n:0100000000FF\n"), HasSubstr("line 2: a record after"));
  EXPECT_THAT(error_of(":0100000000FE" + end), HasSubstr("line 1: the checksum should be FF"));
  EXPECT_THAT(error_of("\n0100000000FF" + end), HasSubstr("line 2: a record begins with ':'"));
  EXPECT_THAT(error_of(":01000000000" + end), HasSubstr("odd number"));
  EXPECT_THAT(error_of(":01000000G0FF" + end), HasSubstr("'G0' is not hexadecimal"));
  EXPECT_THAT(error_of(":0200000000FE" + end), HasSubstr("announces 2 data bytes and carries 1"));
  EXPECT_THAT(error_of(":00" + end), HasSubstr("too short"));
  EXPECT_THAT(error_of(":00000006FA" + end), HasSubstr("unknown record type 6"));
  EXPECT_THAT(error_of(":0100000401FA" + end), HasSubstr("carries 2 data bytes"));
  EXPECT_THAT(error_of(":02FFFF00000000" + end), HasSubstr("beyond the end of its 64 KiB"));
  EXPECT_THAT(error_of(":0100000000FF\n"), HasSubstr("no end-of-file record"));
  EXPECT_THAT(error_of(""), HasSubstr("no end-of-file record"));
}

TEST(FirmwareImage, PutsDataIntoFlashAndUicr) {
  const FirmwareImage image = firmware_image_of_hex(
      ":0400000000000120DB\n"
      ":020000041000EA\n"
      ":0412080015000000CD\n"
      ":00000001FF\n");
  EXPECT_EQ(image.flash[3], 0x20);
  EXPECT_EQ(image.flash[4], 0xFF);
  EXPECT_EQ(image.uicr[0x208], 0x15);
}

TEST(FirmwareImage, RefusesDataWhereTheChipHasNone) {
  try {
    (void)firmware_image_of_hex(":020000042000DA\n:0100000000FF\n:00000001FF\n");
    FAIL() << "data in RAM was accepted";
  } catch (const SimulationError& error) {
    EXPECT_THAT(error.what(), HasSubstr("1 bytes at 0x20000000 lie in neither flash nor UICR"));
  }
}

TEST(FirmwareImage, ReportsHowToBuildAMissingImage) {
  const auto nowhere = std::filesystem::temp_directory_path() / "there-is-no-such-directory" / "node.hex";
  try {
    (void)read_firmware_image(nowhere);
    FAIL() << "it was read";
  } catch (const SimulationError& error) {
    EXPECT_THAT(error.what(), HasSubstr(nowhere.string()));
    EXPECT_THAT(error.what(), HasSubstr("cmake --preset dwm1001 && cmake --build --preset dwm1001"));
  }
}

}  // namespace
}  // namespace groma::sim
