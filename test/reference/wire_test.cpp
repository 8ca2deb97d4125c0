// docs/reference/wire.md against the code and the schema: limits, messages, enumerations, examples and
// errors.

#include <gtest/gtest.h>
#include <pb_decode.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <functional>
#include <map>
#include <sstream>
#include <string>
#include <tuple>

#include "firmware/core/node/messages.hpp"
#include "groma.pb.h"
#include "proto/can_segment.hpp"
#include "proto/compact_report.hpp"
#include "proto/crc32.hpp"
#include "proto/frame_codec.hpp"
#include "test/reference/page.hpp"

namespace groma::wire {
namespace {

using reference::Bytes;
using reference::lines_of;
using reference::number;
using reference::Page;
using reference::Table;
using reference::trimmed;

const Page& page() {
  static const Page page("wire.md");
  return page;
}

Bytes encoded(const Bytes& payload) {
  Bytes frame(max_encoded_size(payload.size()));
  frame.resize(encode_frame(payload, frame));
  return frame;
}

std::map<std::string, double> constants() {
  const std::string digits = "123456789";
  return {{"kFrameVersion", kFrameVersion},
          {"kProtocolVersion", node::kProtocolVersion},
          {"kMaxPayload", kMaxPayload},
          {"kFrameOverhead", kFrameOverhead},
          {"max_encoded_size", static_cast<double>(max_encoded_size(kMaxPayload))},
          {"crc32", crc32(Bytes(digits.begin(), digits.end()))},
          {"groma_NodeToHost_size", groma_NodeToHost_size},
          {"groma_HostToNode_size", groma_HostToNode_size},
          {"can_id, to host", can_id({CanDirection::kToHost, 3})},
          {"can_id, to node", can_id({CanDirection::kToNode, 3})},
          {"kMaxClassicPayload", kMaxClassicPayload},
          {"kMaxFdPayload", kMaxFdPayload}};
}

TEST(WireReference, EachConstantHasItsValue) {
  const auto all = constants();
  std::size_t seen = 0;
  for (const Table& table : page().tables()) {
    if (table.columns.back() != "code") continue;
    for (const auto& row : table.rows) {
      const auto found = all.find(row[2]);
      ASSERT_NE(found, all.end()) << row[2];
      EXPECT_EQ(number(row[1]), found->second) << row[0];
      ++seen;
    }
  }
  EXPECT_EQ(seen, all.size());
}

// ---- frames

// The payload of the example, which has to be one whole frame.
Bytes payload_of(const std::string& name) {
  const Bytes bytes = page().example(name);
  FrameDecoder decoder;
  Bytes payload;
  for (std::size_t i = 0; i < bytes.size(); ++i) {
    EXPECT_EQ(decoder.push(bytes[i]), i + 1 == bytes.size()) << name << ", byte " << i;
  }
  payload.assign(decoder.payload().begin(), decoder.payload().end());
  EXPECT_EQ(encoded(payload), bytes) << name;
  std::ostringstream hex;
  hex << "The payload is";
  for (const std::uint8_t byte : payload)
    hex << ' ' << "0123456789abcdef"[byte >> 4] << "0123456789abcdef"[byte & 15];
  EXPECT_TRUE(page().contains(hex.str())) << hex.str();
  return payload;
}

TEST(WireReference, ExamplesAreWhatTheyStandFor) {
  const Bytes command = payload_of("HostToNode");
  groma_HostToNode asked = groma_HostToNode_init_zero;
  pb_istream_t in = pb_istream_from_buffer(command.data(), command.size());
  ASSERT_TRUE(pb_decode(&in, groma_HostToNode_fields, &asked));
  EXPECT_EQ(asked.request_id, 42U);
  EXPECT_EQ(asked.which_body, groma_HostToNode_get_hello_tag);

  const Bytes answer = payload_of("NodeToHost");
  groma_NodeToHost answered = groma_NodeToHost_init_zero;
  in = pb_istream_from_buffer(answer.data(), answer.size());
  ASSERT_TRUE(pb_decode(&in, groma_NodeToHost_fields, &answered));
  ASSERT_EQ(answered.which_body, groma_NodeToHost_reply_tag);
  EXPECT_EQ(answered.body.reply.request_id, 42U);
  EXPECT_EQ(answered.body.reply.result, groma_Result_RESULT_OK);
}

TEST(WireReference, PartsOfAFrameHaveTheirSizes) {
  const Table parts = page().table("part", "", "Frame");
  const auto part = [&](const std::string& name) {
    for (const auto& row : parts.rows) {
      if (row[0] == name) return row;
    }
    ADD_FAILURE() << name;
    return std::vector<std::string>(3);
  };
  const Bytes payload = {1, 2, 3};
  double size = static_cast<double>(payload.size());
  for (const char* name : {"opening zero", "version", "CRC-32", "COBS", "closing zero"})
    size += number(part(name)[1]);
  EXPECT_EQ(encoded(payload).size(), size);
  EXPECT_EQ(part("payload")[1], "0 to " + std::to_string(kMaxPayload));
}

// A frame's content, as COBS, without a check.
Bytes framed(const Bytes& content) {
  Bytes plain = content;
  plain.push_back(0);
  Bytes out = {0};
  for (std::size_t begin = 0; begin < plain.size();) {
    const auto zero = static_cast<std::size_t>(
        std::find(plain.begin() + static_cast<std::ptrdiff_t>(begin), plain.end(), 0) - plain.begin());
    const std::size_t length = std::min<std::size_t>(zero - begin, 254);
    out.push_back(static_cast<std::uint8_t>(length + 1));
    out.insert(out.end(), plain.begin() + static_cast<std::ptrdiff_t>(begin),
               plain.begin() + static_cast<std::ptrdiff_t>(begin + length));
    begin += length + (length < 254 ? 1 : 0);
  }
  out.push_back(0);
  return out;
}

Bytes with_crc(Bytes content) {
  const std::uint32_t check = crc32(content);
  for (unsigned shift = 0; shift < 32; shift += 8)
    content.push_back(static_cast<std::uint8_t>(check >> shift));
  return content;
}

TEST(WireReference, EachErrorCountsWhereThePageSays) {
  const std::map<std::string, std::uint32_t FrameCounters::*> counters = {
      {"oversize", &FrameCounters::oversize},
      {"cobs_errors", &FrameCounters::cobs_errors},
      {"truncated", &FrameCounters::truncated},
      {"crc_errors", &FrameCounters::crc_errors},
      {"version_errors", &FrameCounters::version_errors}};
  const auto start = [](const std::string& text) { return static_cast<std::size_t>(number(text)); };
  const Table errors = page().table("error", "counter of the decoder");
  ASSERT_EQ(errors.rows.size(), counters.size());
  for (const auto& row : errors.rows) {
    SCOPED_TRACE(row[0]);
    Bytes bad;
    if (row[1] == "oversize") {
      const std::size_t most = start(row[0].substr(std::string("more than ").size()));
      EXPECT_EQ(most, kMaxPayload + kFrameOverhead);
      bad = framed(Bytes(most + 1, 7));
    } else if (row[1] == "cobs_errors") {
      bad = {0, 9, 1, 2, 0};
    } else if (row[1] == "truncated") {
      const std::size_t least = start(row[0].substr(std::string("fewer than ").size()));
      EXPECT_EQ(least, kFrameOverhead);
      bad = framed(Bytes(least - 1, 7));
    } else if (row[1] == "crc_errors") {
      bad = framed(Bytes(9, 7));
    } else {
      bad = framed(with_crc({kFrameVersion + 1, 5}));
    }
    FrameDecoder decoder;
    for (const std::uint8_t byte : bad) EXPECT_FALSE(decoder.push(byte));
    for (const auto& [name, counter] : counters)
      EXPECT_EQ(decoder.counters().*counter, name == row[1] ? 1U : 0U) << name;
    EXPECT_EQ(decoder.counters().bytes_discarded, bad.size() - 2);
  }
}

// ---- CAN

TEST(WireReference, CanIdentifiersHaveTheirBits) {
  std::map<std::string, std::string> bits;
  for (const auto& row : page().table("bits of the 29-bit identifier", "", "On a CAN bus").rows)
    bits[row[0]] = row[1];
  const std::uint32_t id = can_id({CanDirection::kToNode, 0xFFFF});
  EXPECT_EQ(id >> 24, std::stoul(bits["28..24"].substr(0, 5), nullptr, 2));
  EXPECT_EQ(id >> 17 & 0x7F, number(bits["23..17"]));
  EXPECT_EQ(id ^ can_id({CanDirection::kToHost, 0xFFFF}), 1U << 16);
  EXPECT_EQ(bits["16"], "0: from the node to its host, 1: from the host to the node");
  EXPECT_EQ(bits["15..0"], "the node's id");
}

TEST(WireReference, TheExampleIsCutIntoItsCanPayloads) {
  const Bytes stream = page().example("HostToNode");
  CanFrame first;
  const std::size_t taken = cut_can_payload(stream, CanFormat::kClassic, first);
  CanFrame second;
  EXPECT_EQ(cut_can_payload(std::span(stream).subspan(taken), CanFormat::kClassic, second),
            stream.size() - taken);
  EXPECT_EQ(taken, kMaxClassicPayload);
  EXPECT_TRUE(page().contains("    00 05 01 08 2a 12 05 a7"));
  EXPECT_TRUE(page().contains("    45 d8 73 00"));
  EXPECT_EQ(Bytes(first.payload().begin(), first.payload().end()),
            reference::bytes_in("00 05 01 08 2a 12 05 a7"));
  EXPECT_EQ(Bytes(second.payload().begin(), second.payload().end()), reference::bytes_in("45 d8 73 00"));
}

// ---- the schema

struct SchemaField {
  std::string message;
  std::string type;
  std::string name;
  int number = 0;
  [[nodiscard]] auto key() const { return std::tie(message, number, name, type); }
  friend bool operator==(const SchemaField& a, const SchemaField& b) { return a.key() == b.key(); }
  friend bool operator<(const SchemaField& a, const SchemaField& b) { return a.key() < b.key(); }
};

struct Schema {
  std::vector<SchemaField> fields;  // of messages
  std::vector<SchemaField> names;   // of enumerations
};

// The fields of proto/groma.proto, which has one on each line.
Schema schema() {
  Schema schema;
  std::string owner;
  bool is_enum = false;
  for (const std::string& line : lines_of("proto/groma.proto")) {
    std::istringstream words(line.substr(0, line.find("//")));
    std::vector<std::string> w;
    for (std::string word; words >> word;) w.push_back(word);
    if (w.empty()) continue;
    if ((w[0] == "message" || w[0] == "enum") && w.size() >= 3) {
      owner = w[1];
      is_enum = w[0] == "enum";
      continue;
    }
    const auto equals = std::find(w.begin(), w.end(), "=");
    if (equals == w.end() || owner.empty()) continue;
    SchemaField field{.message = owner, .name = *(equals - 1), .number = std::stoi(*(equals + 1))};
    for (auto word = w.begin(); word != equals - 1; ++word)
      field.type += (field.type.empty() ? "" : " ") + *word;
    (is_enum ? schema.names : schema.fields).push_back(field);
  }
  return schema;
}

// The limits of proto/groma.options, in the page's words.
std::map<std::string, std::string> limits() {
  std::map<std::string, std::string> strings;
  for (const SchemaField& field : schema().fields) strings[field.message + "." + field.name] = field.type;
  std::map<std::string, std::string> limits;
  for (const std::string& line : lines_of("proto/groma.options")) {
    std::istringstream words(line);
    std::string name;
    words >> name;
    name = name.substr(name.find('.') + 1);
    std::string bits;
    std::string most;
    for (std::string word; words >> word;) {
      const std::string value = word.substr(word.find(':') + 1);
      if (word == "int_size:IS_8") bits = "8 bits";
      if (word == "int_size:IS_16") bits = "16 bits";
      if (word.find("max_count") == 0) most = "at most " + value;
      // A string is stored with a closing zero.
      if (word.find("max_size") == 0)
        most = std::to_string(std::stoi(value) - (strings[name] == "string" ? 1 : 0)) + " bytes";
    }
    std::string both = bits;
    if (!bits.empty() && !most.empty()) both += ", ";
    both += most;
    if (!both.empty()) limits[name] = both;
  }
  return limits;
}

TEST(WireReference, EachFieldIsThatOfTheSchema) {
  auto expected = schema().fields;
  ASSERT_GT(expected.size(), 100U);
  auto left = limits();
  std::vector<SchemaField> found;
  for (const Table& table : page().tables()) {
    if (table.columns.size() != 5 || table.columns[0] != "number" || table.columns[1] != "field") continue;
    for (const auto& row : table.rows) {
      found.push_back({.message = table.heading,
                       .type = row[2],
                       .name = row[1],
                       .number = static_cast<int>(number(row[0]))});
      const std::string name = table.heading + "." + row[1];
      EXPECT_EQ(row[3], left[name]) << name;
      left.erase(name);
    }
  }
  std::sort(expected.begin(), expected.end());
  std::sort(found.begin(), found.end());
  for (const SchemaField& field : expected) {
    EXPECT_TRUE(std::binary_search(found.begin(), found.end(), field))
        << "not in wire.md: " << field.message << ": " << field.type << ' ' << field.name << " = "
        << field.number;
  }
  EXPECT_EQ(found.size(), expected.size());
  for (const auto& [name, limit] : left) ADD_FAILURE() << "the limit of " << name << " is not in wire.md";
}

TEST(WireReference, EachNumberOfAnEnumerationIsThatOfTheSchema) {
  const auto expected = schema().names;
  std::vector<SchemaField> found;
  for (const auto& row : page().table("enumeration", "").rows)
    found.push_back({.message = row[0], .name = row[2], .number = static_cast<int>(number(row[1]))});
  for (const SchemaField& name : expected) {
    EXPECT_NE(std::find(found.begin(), found.end(), name), found.end())
        << "not in wire.md: " << name.message << ": " << name.name << " = " << name.number;
  }
  EXPECT_EQ(found.size(), expected.size());
}

// An encoded field has the page's number, independently of the schema's text.
TEST(WireReference, NumbersAreThoseOnTheWire) {
  EXPECT_EQ(groma_NodeToHost_slot_report_tag, 1);
  const auto has = [](const std::string& message, const std::string& field, int tag) {
    for (const auto& row : page().table("number", "", message).rows) {
      if (row[1] == field) return static_cast<int>(number(row[0])) == tag;
    }
    return false;
  };
  EXPECT_TRUE(has("NodeToHost", "slot_report", groma_NodeToHost_slot_report_tag));
  EXPECT_TRUE(has("NodeToHost", "source_id", groma_NodeToHost_source_id_tag));
  EXPECT_TRUE(has("HostToNode", "request_id", groma_HostToNode_request_id_tag));
  EXPECT_TRUE(has("HostToNode", "target_id", groma_HostToNode_target_id_tag));
  EXPECT_TRUE(has("Config", "network_key_hash", groma_Config_network_key_hash_tag));
  EXPECT_TRUE(has("Range", "flags", groma_Range_flags_tag));
}

TEST(WireReference, FlagsOfARangeHaveTheirBits) {
  const std::map<std::string, int> flags = {{"2", groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS},
                                            {"3", groma_RangeFlag_RANGE_FLAG_TEMPERATURE},
                                            {"4", groma_RangeFlag_RANGE_FLAG_SUPPLY},
                                            {"5", groma_RangeFlag_RANGE_FLAG_POWER_BIAS}};
  const std::map<int, std::string> about = {{groma_RangeFlag_RANGE_FLAG_ANTENNA_DELAYS, "antenna delays"},
                                            {groma_RangeFlag_RANGE_FLAG_TEMPERATURE, "temperature"},
                                            {groma_RangeFlag_RANGE_FLAG_SUPPLY, "supply voltage"},
                                            {groma_RangeFlag_RANGE_FLAG_POWER_BIAS, "receive power"}};
  std::size_t seen = 0;
  for (const auto& row : page().table("bits of Range.flags", "").rows) {
    const auto found = flags.find(row[0]);
    if (found == flags.end()) {
      EXPECT_EQ(row[0], "0..1");
      continue;
    }
    ++seen;
    EXPECT_EQ(found->second, 1 << static_cast<int>(number(row[0])));
    EXPECT_NE(row[1].find(about.at(found->second)), std::string::npos) << row[1];
  }
  EXPECT_EQ(seen, flags.size());
}

// ---- the compact report

// Each value changes the bytes that the table gives, and no others.
TEST(WireReference, ACompactRangeHasItsBytes) {
  const auto bytes_with = [](const std::function<void(groma_Range&)>& change) {
    groma_SlotReport report = groma_SlotReport_init_zero;
    report.ranges_count = 1;
    groma_Range& range = report.ranges[0];
    range.has_first_path_power_cdbm = range.has_receive_power_cdbm = true;
    change(range);
    groma_CompactReport compact = groma_CompactReport_init_zero;
    compact_report(report, compact);
    return Bytes(compact.ranges.bytes, compact.ranges.bytes + compact.ranges.size);
  };
  struct Expected {
    std::string bytes;
    std::function<void(groma_Range&)> change;
    std::uint32_t value;
  };
  const std::vector<Expected> all = {
      {"0..1", [](auto& range) { range.anchor_id = 0x2221; }, 0x2221},
      {"2", [](auto& range) { range.status = groma_RangeStatus_RANGE_STALE; }, groma_RangeStatus_RANGE_STALE},
      {"3..5", [](auto& range) { range.range_m = 123.4567F; }, 1'234'567},
      {"6..8", [](auto& range) { range.instant_offset_dtu = -638'976LL * 200'000; }, 2'000'000},
      {"9", [](auto& range) { range.first_path_power_cdbm = -8'500; }, 170},
      {"10", [](auto& range) { range.receive_power_cdbm = -8'450; }, 169}};
  const Table table = page().table("bytes", "bounds", "Compact report");
  ASSERT_EQ(table.rows.size(), all.size());
  const Bytes base = bytes_with([](groma_Range&) {});
  EXPECT_EQ(base.size(), kCompactRangeBytes);
  EXPECT_TRUE(page().contains("`ranges` with 11 bytes per range"));
  for (std::size_t i = 0; i < all.size(); ++i) {
    const std::string& cell = table.rows[i][0];
    EXPECT_EQ(cell, all[i].bytes);
    const auto first = static_cast<std::size_t>(number(cell));
    const auto dots = cell.find("..");
    const std::size_t last =
        dots == std::string::npos ? first : static_cast<std::size_t>(number(cell.substr(dots + 2)));
    Bytes expected = base;
    for (std::size_t byte = first; byte <= last; ++byte)
      expected[byte] = static_cast<std::uint8_t>(all[i].value >> (8 * (byte - first)));
    EXPECT_EQ(bytes_with(all[i].change), expected) << table.rows[i][1];
  }
  EXPECT_EQ(bytes_with([](auto& range) { range.has_receive_power_cdbm = false; })[10], 0xFF);
}

}  // namespace
}  // namespace groma::wire
