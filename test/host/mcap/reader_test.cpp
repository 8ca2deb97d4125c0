#include "host/mcap/reader.hpp"

#include <gtest/gtest.h>
#include <lz4frame.h>
#include <zstd.h>

#include <cstdint>
#include <sstream>
#include <string>
#include <vector>

#include "host/mcap/bytes.hpp"
#include "host/mcap/format.hpp"
#include "host/mcap/writer.hpp"
#include "test/support/random.hpp"

namespace groma::mcap {
namespace {

struct Read {
  std::optional<Content> content;
  std::vector<std::string> messages;
};

Read read_bytes(const std::string& bytes) {
  std::istringstream file(bytes);
  Read out;
  out.content = read(file, [&](std::uint16_t /*channel*/, std::uint64_t /*time*/, std::string_view data) {
    out.messages.emplace_back(data);
  });
  return out;
}

std::string text_of(std::size_t i) {
  return "message " + std::to_string(i) + std::string(i % 50, 'x');
}

std::string file_of(std::size_t messages) {
  Writer writer("ros2", "groma");
  const std::uint16_t channel =
      writer.add_channel("/ranges", "cdr", {"pkg/msg/Ranges", "ros2msg", "float64 range\n"});
  for (std::size_t i = 0; i < messages; ++i) writer.write(channel, i, text_of(i));
  return writer.finish();
}

void append_text(std::string& out, std::string_view text) {
  append(out, static_cast<std::uint32_t>(text.size()));
  out += text;
}
void append_record(std::string& out, Opcode opcode, std::string_view body) {
  append(out, static_cast<std::uint8_t>(opcode));
  append(out, std::uint64_t{body.size()});
  out += body;
}

// A file whose only chunk holds schema, channel and 100 messages, compressed.
std::string compressed_file(const std::string& compression) {
  std::string records;
  std::string body;
  append(body, std::uint16_t{1});
  for (const char* text : {"pkg/msg/Ranges", "ros2msg", "float64 range\n"}) append_text(body, text);
  append_record(records, Opcode::kSchema, body);
  body.clear();
  append(body, std::uint16_t{7});
  append(body, std::uint16_t{1});
  for (const char* text : {"/ranges", "cdr", ""}) append_text(body, text);
  append_record(records, Opcode::kChannel, body);
  for (std::uint32_t i = 0; i < 100; ++i) {
    body.clear();
    append(body, std::uint16_t{7});
    append(body, i);
    append(body, std::uint64_t{i});
    append(body, std::uint64_t{i});
    append_record(records, Opcode::kMessage, body + text_of(i));
  }
  std::string compressed(2 * records.size() + 1000, '\0');
  compressed.resize(compression == "zstd" ? ZSTD_compress(compressed.data(), compressed.size(),
                                                          records.data(), records.size(), 3)
                                          : LZ4F_compressFrame(compressed.data(), compressed.size(),
                                                               records.data(), records.size(), nullptr));
  body.clear();
  append(body, std::uint64_t{0});
  append(body, std::uint64_t{99});
  append(body, std::uint64_t{records.size()});
  append(body, crc_of(records));
  append_text(body, compression);
  append(body, std::uint64_t{compressed.size()});
  body += compressed;
  std::string file(kMagic);
  append_record(file, Opcode::kChunk, body);
  append_record(file, Opcode::kDataEnd, std::string(4, '\0'));
  return file;
}

TEST(McapReader, ReadsWhatTheWriterWrites) {
  const Read read = read_bytes(file_of(50000));
  ASSERT_TRUE(read.content);
  EXPECT_TRUE(read.content->is_complete);
  EXPECT_EQ(read.content->damaged, 0U);
  ASSERT_EQ(read.content->channels.size(), 1U);
  const Channel& channel = read.content->channels.begin()->second;
  EXPECT_EQ(channel.topic, "/ranges");
  EXPECT_EQ(channel.message_encoding, "cdr");
  EXPECT_EQ(channel.schema_name, "pkg/msg/Ranges");
  EXPECT_EQ(channel.schema_encoding, "ros2msg");
  EXPECT_EQ(channel.schema_data, "float64 range\n");
  EXPECT_EQ(channel.messages, 50000U);
  ASSERT_EQ(read.messages.size(), 50000U);
  for (std::size_t i = 0; i < read.messages.size(); ++i) ASSERT_EQ(read.messages[i], text_of(i));
}

TEST(McapReader, ReadsCompressedChunks) {
  for (const char* compression : {"zstd", "lz4"}) {
    const Read read = read_bytes(compressed_file(compression));
    ASSERT_TRUE(read.content) << compression;
    EXPECT_EQ(read.content->damaged, 0U) << compression;
    ASSERT_EQ(read.messages.size(), 100U) << compression;
    EXPECT_EQ(read.messages[99], text_of(99));
    EXPECT_EQ(read.content->channels.at(7).schema_name, "pkg/msg/Ranges");
  }
}

TEST(McapReader, SkipsAndCountsADamagedChunk) {
  for (const char* compression : {"zstd", "lz4"}) {
    std::string bytes = compressed_file(compression);
    bytes[bytes.size() / 2] = static_cast<char>(bytes[bytes.size() / 2] ^ 0x40);
    const Read read = read_bytes(bytes);
    EXPECT_EQ(read.content->damaged, 1U) << compression;
    EXPECT_TRUE(read.messages.empty()) << compression;
  }
  std::string unknown = compressed_file("zstd");
  unknown.replace(unknown.find("zstd"), 4, "lzma");
  EXPECT_EQ(read_bytes(unknown).content->damaged, 1U);
}

TEST(McapReader, ATornFileGivesTheMessagesBefore) {
  const std::string whole = file_of(50000);
  const Read all = read_bytes(whole);
  const Read torn = read_bytes(whole.substr(0, whole.size() / 2));
  ASSERT_TRUE(torn.content);
  EXPECT_FALSE(torn.content->is_complete);
  EXPECT_GT(torn.messages.size(), 20000U) << "also those of the torn chunk";
  ASSERT_LT(torn.messages.size(), all.messages.size());
  EXPECT_TRUE(std::equal(torn.messages.begin(), torn.messages.end(), all.messages.begin()));
}

TEST(McapReader, SurvivesRandomBytes) {
  EXPECT_FALSE(read_bytes("not an MCAP file").content);
  test::Random random(5);
  const std::string good = compressed_file("lz4") + file_of(20);
  for (int i = 0; i < 2000; ++i) {
    std::string bytes = good;
    for (std::uint64_t change = 0; change < 1 + random.next() % 8; ++change)
      bytes[8 + random.next() % (bytes.size() - 8)] = static_cast<char>(random.next());
    bytes.resize(8 + random.next() % (bytes.size() - 8));
    const Read read = read_bytes(bytes);
    EXPECT_LE(read.messages.size(), 121U);
  }
}

}  // namespace
}  // namespace groma::mcap
