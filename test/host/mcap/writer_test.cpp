// The writer against a reader that shares no code with it.
#include "host/mcap/writer.hpp"

#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

#include "test/support/mcap_reader.hpp"
#include "test/support/random.hpp"

namespace groma::mcap {
namespace {

using test::McapFile;
using test::McapMessage;
using test::McapReader;

constexpr Schema kRanges{"pkg.Ranges", "protobuf", {"\0\1\2", 3}};
constexpr Schema kPoses{"pkg.Pose", "protobuf", "pose"};

std::string small_file() {
  Writer writer("ros2", "groma 1");
  const std::uint16_t ranges =
      writer.add_channel("/ranges", "cdr", kRanges, {{"key", "value"}, {"other", ""}});
  writer.write(ranges, 5, "abc");
  const std::uint16_t poses = writer.add_channel("/pose", "cdr", kPoses);
  writer.write(poses, 4, "");
  writer.write(ranges, 7, std::string("\0\xFF", 2));
  return writer.finish();
}

TEST(McapWriter, ReadsBackAsItWasWritten) {
  const McapFile file = McapReader::read(small_file());
  EXPECT_EQ(file.profile, "ros2");
  EXPECT_EQ(file.library, "groma 1");
  ASSERT_EQ(file.channels.size(), 2U);
  const test::McapChannel& ranges = file.channels.at(0);
  EXPECT_EQ(ranges.topic, "/ranges");
  EXPECT_EQ(ranges.encoding, "cdr");
  EXPECT_THAT(ranges.metadata,
              testing::ElementsAre(testing::Pair("key", "value"), testing::Pair("other", "")));
  EXPECT_EQ(file.schemas.at(ranges.schema), (test::McapSchema{"pkg.Ranges", "protobuf", {"\0\1\2", 3}}));
  ASSERT_EQ(file.messages.size(), 3U);
  EXPECT_EQ(file.messages[0].data, "abc");
  EXPECT_EQ(file.messages[0].log_time_ns, 5U);
  EXPECT_EQ(file.messages[0].publish_time_ns, 5U);
  EXPECT_EQ(file.messages[1].data, "");
  EXPECT_EQ(file.messages[2].data, std::string("\0\xFF", 2));
  EXPECT_EQ(file.messages[2].sequence, 1U) << "counted by channel";
}

TEST(McapWriter, StoresASchemaOnce) {
  Writer writer("", "");
  EXPECT_NE(writer.add_channel("/a", "protobuf", kPoses), writer.add_channel("/b", "protobuf", kPoses));
  const McapFile file = McapReader::read(writer.finish());
  EXPECT_EQ(file.schemas.size(), 1U);
  EXPECT_EQ(file.channels.at(0).schema, file.channels.at(1).schema);
}

TEST(McapWriter, ClosesAFileWithoutMessages) {
  const McapFile file = McapReader::read(Writer("", "groma").finish());
  EXPECT_TRUE(file.messages.empty());
  EXPECT_EQ(file.chunks, 0U);
}

TEST(McapWriter, WritesSeveralChunks) {
  Writer writer("", "groma");
  test::Random random(3);
  std::vector<std::uint16_t> channels;
  for (const char* topic : {"/a", "/b", "/c"})
    channels.push_back(writer.add_channel(topic, "protobuf", kPoses));
  std::vector<McapMessage> sent;
  for (std::uint64_t i = 0; i < 3000; ++i) {
    // The last channel has messages only in the first chunk.
    const std::uint16_t channel = channels[i < 100 ? random.next() % 3U : random.next() % 2U];
    const std::uint64_t time_ns = i * 1000 + random.next() % 2000U;
    sent.push_back({channel, 0, time_ns, time_ns, std::string(random.next() % 2000U, static_cast<char>(i))});
    writer.write(channel, time_ns, sent.back().data);
  }
  EXPECT_EQ(writer.messages(), sent.size());
  const McapFile file = McapReader::read(writer.finish());
  EXPECT_GT(file.chunks, 2U);
  ASSERT_EQ(file.messages.size(), sent.size());
  for (std::size_t i = 0; i < sent.size(); ++i) {
    EXPECT_EQ(file.messages[i].channel, sent[i].channel);
    EXPECT_EQ(file.messages[i].log_time_ns, sent[i].log_time_ns);
    EXPECT_EQ(file.messages[i].data, sent[i].data);
  }
}

// Each byte is covered by a checksum or has one correct value.
TEST(McapWriter, AnyChangedByteIsFound) {
  const std::string good = small_file();
  EXPECT_NO_THROW(McapReader::read(good));
  for (std::size_t i = 0; i < good.size(); ++i) {
    std::string bad = good;
    bad[i] = static_cast<char>(bad[i] ^ 0x10);
    EXPECT_THROW(McapReader::read(bad), std::exception) << "byte " << i;
  }
}

}  // namespace
}  // namespace groma::mcap
