#include "host/provision/image.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "firmware/core/node/image_identity.hpp"
#include "host/io/error.hpp"
#include "test/host/provision/small_image.hpp"
#include "test/support/scratch_folder.hpp"

namespace groma::provision {
namespace {

using groma::test::ScratchFolder;
using ::testing::HasSubstr;

std::string image_fault_of(const std::string& text) {
  const ScratchFolder scratch;
  scratch.write("node.hex", text);
  try {
    (void)read_node_image(scratch / "node.hex");
  } catch (const io::DataError& error) {
    return error.what();
  }
  return "none";
}

TEST(NodeImage, HasVersionHashAndSize) {
  const ScratchFolder scratch;
  scratch.write("node.hex", test::hex_of(test::small_image(5000, "1.2.3", 0xC0FFEE01)) + test::kHexEnd);
  const NodeImage image = read_node_image(scratch / "node.hex");
  EXPECT_EQ(image.version, "1.2.3");
  EXPECT_EQ(image.git_hash, 0xC0FFEE01);
  EXPECT_EQ(image.board, "dwm1001");
  EXPECT_EQ(image.bytes, 5000U);
}

std::string board_fault_of(const std::vector<std::uint8_t>& image, const std::string& board) {
  const ScratchFolder scratch;
  scratch.write("node.hex", test::hex_of(image) + test::kHexEnd);
  try {
    require_board(read_node_image(scratch / "node.hex"), board);
  } catch (const io::DataError& error) {
    return error.what();
  }
  return "none";
}

TEST(NodeImage, OfAnotherBoardIsRefused) {
  const std::vector<std::uint8_t> image = test::small_image(5000, "1.2.3", 0, "nrf52832_dw1000");
  EXPECT_EQ(board_fault_of(image, "nrf52832_dw1000"), "none");
  EXPECT_THAT(board_fault_of(image, "dwm1001"),
              HasSubstr("node.hex: is an image of the board nrf52832_dw1000, whose pins are not those of "
                        "dwm1001; give the image of dwm1001, or '--board nrf52832_dw1000' if the nodes are "
                        "such boards"));
  EXPECT_THAT(board_fault_of(image, "nrf52832"), HasSubstr("whose pins are not those of nrf52832;"));
}

TEST(NodeImage, OfAnOlderReleaseNamesNoBoard) {
  using node::ImageIdentity;
  std::vector<std::uint8_t> image = test::small_image(5000, "0.1.0", 0xC0FFEE01, "nrf52832_dw1000");
  image[0x100 + offsetof(ImageIdentity, board_mark)] ^= 1U;
  const auto read = [](const std::vector<std::uint8_t>& bytes) {
    const ScratchFolder scratch;
    scratch.write("node.hex", test::hex_of(bytes) + test::kHexEnd);
    return read_node_image(scratch / "node.hex");
  };
  EXPECT_EQ(read(image).board, "");
  EXPECT_EQ(board_fault_of(image, "dwm1001"), "none");
  // The file may end with the identity.
  image.resize(0x100 + offsetof(ImageIdentity, board_mark));
  image[4] = 0x81;
  image[5] = 0;
  EXPECT_EQ(read(image).board, "");
  EXPECT_EQ(read(image).version, "0.1.0");
  EXPECT_EQ(read(image).git_hash, 0xC0FFEE01);
}

TEST(NodeImage, MayWriteUicr) {
  const std::vector<std::uint8_t> word{0x5A, 0xFF, 0xFF, 0xFF};
  EXPECT_EQ(
      image_fault_of(test::hex_of(test::small_image(5000)) + test::hex_of(word, 0x1000'1208) + test::kHexEnd),
      "none");
}

TEST(NodeImage, OtherFilesAreRefusedBeforeAnythingIsErased) {
  const std::vector<std::uint8_t> good = test::small_image(5000);
  const auto hex = [](const std::vector<std::uint8_t>& image) { return test::hex_of(image) + test::kHexEnd; };
  EXPECT_EQ(image_fault_of(hex(good)), "none");
  EXPECT_THAT(image_fault_of("ELF"), HasSubstr("node.hex: Intel HEX, line 1: a record begins with ':'"));
  EXPECT_THAT(image_fault_of(test::hex_of(good)), HasSubstr("cut short"));
  EXPECT_THAT(image_fault_of(""), HasSubstr("cmake --preset dwm1001"));
  EXPECT_THAT(image_fault_of(test::kHexEnd), HasSubstr("has no vector table"));

  std::vector<std::uint8_t> unmarked = good;
  unmarked[0x100] ^= 1U;
  EXPECT_THAT(image_fault_of(hex(unmarked)), HasSubstr("is not an image of a Groma node"));
  std::vector<std::uint8_t> no_stack = good;
  no_stack[3] = 0x30;
  EXPECT_THAT(image_fault_of(hex(no_stack)),
              HasSubstr("does not begin with a vector table (stack 30001000, entry 00000201)"));
  std::vector<std::uint8_t> no_entry = good;
  no_entry[4] = 0;
  EXPECT_THAT(image_fault_of(hex(no_entry)), HasSubstr("does not begin with a vector table"));

  const std::vector<std::uint8_t> word(4);
  EXPECT_THAT(image_fault_of(test::hex_of(good) + test::hex_of(word, 0x7DFFE) + test::kHexEnd),
              HasSubstr("would overwrite the node's configuration at 0x7e000"));
  EXPECT_THAT(image_fault_of(test::hex_of(good) + test::hex_of(word, 0x2000'0000) + test::kHexEnd),
              HasSubstr("4 bytes at 0x20000000 lie in neither flash nor UICR"));
}

TEST(NodeImage, AMissingImageNamesTheBuildCommand) {
  try {
    (void)read_node_image("/none/node.hex");
    FAIL();
  } catch (const io::DataError& error) {
    EXPECT_STREQ(
        error.what(),
        "/none/node.hex: no such image; build it: cmake --preset dwm1001 && cmake --build --preset dwm1001");
  }
}

}  // namespace
}  // namespace groma::provision
