#include "host/link/can_log.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <string>
#include <vector>

#include "test/support/scratch_folder.hpp"

namespace groma::link {
namespace {

using groma::test::ScratchFolder;
using ::testing::ElementsAre;
using ::testing::HasSubstr;

std::vector<std::uint8_t> bytes_of(const LoggedCanFrame& logged) {
  return {logged.frame.payload().begin(), logged.frame.payload().end()};
}

TEST(CandumpLine, ClassicAndFd) {
  const CanLogLine classic = parse_candump_line("(1436509052.249713) vcan0 16000003#2A366C2BBA");
  ASSERT_TRUE(classic.intact);
  ASSERT_TRUE(classic.frame);
  EXPECT_DOUBLE_EQ(classic.frame->t_s, 1436509052.249713);
  EXPECT_EQ(classic.frame->interface, "vcan0");
  EXPECT_EQ(classic.frame->frame.id, 0x16000003U);
  EXPECT_EQ(classic.frame->frame.format, wire::CanFormat::kClassic);
  EXPECT_FALSE(classic.frame->frame.bit_rate_switch);
  EXPECT_THAT(bytes_of(*classic.frame), ElementsAre(0x2A, 0x36, 0x6C, 0x2B, 0xBA));

  const CanLogLine fd = parse_candump_line("(0.000001) can0 16010003##50102030405060708090A0B0C T");
  ASSERT_TRUE(fd.frame);
  EXPECT_EQ(fd.frame->frame.format, wire::CanFormat::kFd);
  EXPECT_TRUE(fd.frame->frame.bit_rate_switch);
  EXPECT_EQ(fd.frame->frame.size, 12);
  EXPECT_FALSE(parse_candump_line("(0.1) can0 16010003##4").frame->frame.bit_rate_switch);
}

TEST(CandumpLine, FramesOfOtherProtocolsAreSkipped) {
  for (const char* line : {"(1.0) can0 123#1122", "(1.0) can0 123##1AABB", "(1.0) can0 16000003#R",
                           "(1.0) can0 16000003#R8", "(1.0) can0 20000080#0000000000000000"}) {
    const CanLogLine parsed = parse_candump_line(line);
    EXPECT_TRUE(parsed.intact) << line;
    EXPECT_FALSE(parsed.frame) << line;
  }
}

TEST(CandumpLine, ADamagedLineIsNotIntact) {
  for (const char* line :
       {"", "x", "(1.0", "(1.0)", "(1.0) can0", "(1.0) can0 ", "(x) can0 16000003#11",
        "(1.0)can0 16000003#11", "(1.0) can0 1600003#11", "(1.0) can0 D6000003#11", "(1.0) can0 16000003#1",
        "(1.0) can0 16000003#1G", "(1.0) can0 16000003#112233445566778899", "(1.0) can0 16000003##",
        "(1.0) can0 16000003##G", "(1.0) can0 16000003##1112233445566778899",
        "can0  16000003   [2]  11 22"}) {
    EXPECT_FALSE(parse_candump_line(line).intact) << line;
  }
}

TEST(CanLogFile, GivesAllFramesOrTheInvalidLine) {
  const ScratchFolder folder;
  folder.write("good.log", "(1.0) can0 16000001#11\r\n\n(1.5) can0 123#22\n(2.0) can0 16000002#33\n");
  const CanLog log = read_candump_log(folder / "good.log");
  EXPECT_EQ(log.error.fault, LinkFault::kNone) << log.error.message;
  ASSERT_EQ(log.frames.size(), 2U);
  EXPECT_EQ(log.frames[1].t_s, 2.0);

  folder.write("bad.log", "(1.0) can0 16000001#11\nnonsense\n");
  const CanLog bad = read_candump_log(folder / "bad.log");
  EXPECT_EQ(bad.error.fault, LinkFault::kUnsuitable);
  EXPECT_THAT(bad.error.message, HasSubstr("bad.log:2: "));
  EXPECT_TRUE(bad.frames.empty());
  EXPECT_EQ(read_candump_log(folder / "none.log").error.fault, LinkFault::kNoDevice);
  EXPECT_EQ(read_candump_log(folder.path()).error.fault, LinkFault::kUnsuitable);
}

TEST(CanLogLink, GivesTheStreamOfOneNodeToItsEnd) {
  const ScratchFolder folder;
  folder.write("bus.log",
               "(1.0) can0 16000001#6869\n(1.1) can0 16000002#7878\n(1.2) can0 16010001#7979\n"
               "(1.3) can0 16000001##020746865726521\n");
  const std::string path = "can-log:" + (folder / "bus.log").string() + "/1";
  const OpenedLink opened = open_link(path, 0);
  ASSERT_TRUE(opened.link) << opened.error.message;
  std::string text;
  std::uint8_t buffer[3];
  for (ReadResult result; !(result = opened.link->read(buffer)).gone;)
    text.append(buffer, buffer + result.bytes);
  EXPECT_EQ(text, "hi there!");

  EXPECT_EQ(open_link("can-log:" + (folder / "none.log").string() + "/1", 0).error.fault,
            LinkFault::kNoDevice);
  EXPECT_THAT(open_link("can-log:" + (folder / "bus.log").string(), 0).error.message,
              HasSubstr("can-log:FILE/NODE"));
}

}  // namespace
}  // namespace groma::link
