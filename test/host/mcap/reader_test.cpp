#include "host/mcap/reader.hpp"

#include <fmt/format.h>
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

// Schema and channel 7, then 100 messages.
std::string records_of_chunk() {
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
  return records;
}

// A file with one chunk. size: as the chunk states it.
std::string file_of_chunk(const std::string& compression, const std::string& content, std::uint64_t size,
                          std::uint32_t crc) {
  std::string body;
  append(body, std::uint64_t{0});
  append(body, std::uint64_t{99});
  append(body, size);
  append(body, crc);
  append_text(body, compression);
  append(body, std::uint64_t{content.size()});
  std::string file(kMagic);
  append_record(file, Opcode::kChunk, body + content);
  append_record(file, Opcode::kDataEnd, std::string(4, '\0'));
  return file;
}

std::string compressed_file(const std::string& compression) {
  const std::string records = records_of_chunk();
  std::string compressed(2 * records.size() + 1000, '\0');
  compressed.resize(compression == "zstd" ? ZSTD_compress(compressed.data(), compressed.size(),
                                                          records.data(), records.size(), 3)
                                          : LZ4F_compressFrame(compressed.data(), compressed.size(),
                                                               records.data(), records.size(), nullptr));
  return file_of_chunk(compression, compressed, records.size(), crc_of(records));
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
  EXPECT_EQ(channel.schema->name, "pkg/msg/Ranges");
  EXPECT_EQ(channel.schema->encoding, "ros2msg");
  EXPECT_EQ(channel.schema->data, "float64 range\n");
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
    EXPECT_EQ(read.content->channels.at(7).schema->name, "pkg/msg/Ranges");
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
}

TEST(McapReader, SaysWhatIsDamagedAndWhere) {
  const std::string records = records_of_chunk();
  const auto damage = [](const std::string& bytes) { return read_bytes(bytes).content->first_damage; };
  EXPECT_EQ(damage(file_of_chunk("", records, records.size(), 0)), "");
  EXPECT_EQ(damage(file_of_chunk("", records, records.size(), 1)),
            "the chunk at byte 8: its checksum is wrong");
  EXPECT_EQ(damage(file_of_chunk("lzma", records, records.size(), 0)),
            "the chunk at byte 8: its compression 'lzma' is neither zstd nor lz4");
  EXPECT_EQ(damage(file_of_chunk("zstd", records, records.size(), 0)),
            "the chunk at byte 8: it cannot be decompressed (zstd)");
  EXPECT_EQ(damage(file_of_chunk("", records, records.size() + 1, 0)),
            fmt::format("the chunk at byte 8: it has {} bytes, not {}", records.size(), records.size() + 1));
  EXPECT_EQ(damage(file_of_chunk("", records.substr(0, records.size() - 1), records.size() - 1, 0)),
            fmt::format("the chunk at byte 8: its record at byte {}: it is longer than the chunk",
                        records.size() - 9 - 22 - text_of(99).size()));
  std::string early(kMagic);
  append_record(early, Opcode::kMetadata, "any");
  append_record(early, Opcode::kSchema, "too short");
  append_record(early, Opcode::kMessage, std::string(22, '\0'));
  const Read read = read_bytes(early);
  EXPECT_EQ(read.content->damaged, 2U);
  EXPECT_EQ(read.content->first_damage, "the record at byte 20: it is too short");
  EXPECT_EQ(read.content->end, early.size());
}

// Sizes are those of 64 bits that a few bytes of a file can state.
TEST(McapReader, AllocatesNoMoreThanTheFileCanContain) {
  const std::string small(100, 'x');
  for (const std::uint64_t size : {std::uint64_t{1} << 30U, std::uint64_t{1} << 40U, ~std::uint64_t{0}}) {
    for (const char* compression : {"", "zstd", "lz4"}) {
      const std::string first = read_bytes(file_of_chunk(compression, small, size, 0)).content->first_damage;
      EXPECT_EQ(first, fmt::format("the chunk at byte 8: 100 bytes cannot contain {} bytes", size));
    }
    for (const Opcode opcode : {Opcode::kSchema, Opcode::kMessage, Opcode::kChunk, Opcode::kMetadata}) {
      std::string bytes(kMagic);
      append(bytes, static_cast<std::uint8_t>(opcode));
      append(bytes, size);
      const Read read = read_bytes(bytes + small);
      EXPECT_FALSE(read.content->is_complete);
      EXPECT_EQ(read.content->end, kMagic.size());
    }
  }
  // The frame states 4 GiB.
  EXPECT_FALSE(decompress_zstd(std::string("\x28\xB5\x2F\xFD\xE0\0\0\0\0\1\0\0\0\1\0\0", 16)));
  EXPECT_FALSE(decompress_zstd("")) << "no frame";
}

TEST(McapReader, ManyChannelsShareOneSchema) {
  std::string bytes(kMagic);
  std::string body;
  append(body, std::uint16_t{1});
  for (const std::string& text :
       {std::string("pkg/msg/A"), std::string("ros2msg"), std::string(1 << 20, '#')})
    append_text(body, text);
  append_record(bytes, Opcode::kSchema, body);
  for (std::uint32_t id = 0; id <= 0xFFFF; ++id) {
    body.clear();
    append(body, static_cast<std::uint16_t>(id));
    append(body, std::uint16_t{1});
    for (const char* text : {"/a", "cdr", ""}) append_text(body, text);
    append_record(bytes, Opcode::kChannel, body);
  }
  const Read read = read_bytes(bytes);
  ASSERT_EQ(read.content->channels.size(), 65536U);
  EXPECT_EQ(read.content->channels.at(65535).schema, read.content->channels.at(0).schema)
      << "64 GiB otherwise";
}

TEST(McapReader, ZerosAfterALossOfPowerAreTheEnd) {
  const std::string whole = file_of(2000);
  const Read read = read_bytes(whole.substr(0, whole.size() / 2) + std::string(10000, '\0'));
  EXPECT_FALSE(read.content->is_complete);
  std::string zeros(kMagic);
  append_record(zeros, Opcode::kMetadata, "any");
  const std::uint64_t end = zeros.size();
  EXPECT_EQ(read_bytes(zeros + std::string(10000, '\0')).content->end, end);
}

// Where the first chunk defines the channels, its loss must not cost the others.
TEST(McapReader, FindsChannelsInTheSummary) {
  std::string bytes = file_of(50000);
  const std::size_t schema_at = bytes.find('\3', kMagic.size() + 9 + 4 + 4 + 4 + 5);
  ASSERT_EQ(bytes[schema_at], '\3');
  bytes[schema_at] = '\x70';
  const std::size_t channel_at = schema_at + 9 + static_cast<std::uint8_t>(bytes[schema_at + 1]);
  ASSERT_EQ(bytes[channel_at], '\4');
  bytes[channel_at] = '\x70';
  const Read read = read_bytes(bytes);
  EXPECT_EQ(read.messages.size(), 50000U);
  EXPECT_EQ(read.content->channels.begin()->second.schema->name, "pkg/msg/Ranges");
  EXPECT_EQ(read.content->damaged, 0U);
  // Without the summary they are unknown.
  const Read cut = read_bytes(bytes.substr(0, bytes.size() - 1));
  EXPECT_TRUE(cut.messages.empty());
  EXPECT_NE(cut.content->first_damage.find("its channel 0 is not defined"), std::string::npos);
  // A summary whose checksum is wrong is not used.
  std::string wrong = bytes;
  const std::size_t name_at = wrong.rfind("pkg/msg/Ranges");
  wrong[name_at] = 'q';
  EXPECT_TRUE(read_bytes(wrong).messages.empty());
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
