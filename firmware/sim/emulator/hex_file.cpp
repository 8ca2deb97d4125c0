#include "firmware/sim/emulator/hex_file.hpp"

#include <array>
#include <cstddef>
#include <cstdio>
#include <numeric>
#include <span>
#include <string>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum class Record : std::uint8_t {
  kData = 0,
  kEndOfFile = 1,
  kExtendedSegment = 2,
  kStartSegment = 3,
  kExtendedLinear = 4,
  kStartLinear = 5,
};

[[noreturn]] void fail(std::size_t line, const std::string& what) {
  throw SimulationError("Intel HEX, line " + std::to_string(line) + ": " + what);
}

int digit(char c) {
  if (c >= '0' && c <= '9') return c - '0';
  if (c >= 'A' && c <= 'F') return c - 'A' + 10;
  if (c >= 'a' && c <= 'f') return c - 'a' + 10;
  return -1;
}

// The record's bytes from the count to the checksum.
std::vector<std::uint8_t> bytes_of(std::string_view record, std::size_t line) {
  if (record.front() != ':') fail(line, "a record begins with ':'");
  record.remove_prefix(1);
  if (record.size() % 2 != 0) fail(line, "an odd number of hexadecimal digits");
  std::vector<std::uint8_t> bytes;
  for (std::size_t i = 0; i < record.size(); i += 2) {
    const int high = digit(record[i]);
    const int low = digit(record[i + 1]);
    if (high < 0 || low < 0) fail(line, "'" + std::string(record.substr(i, 2)) + "' is not hexadecimal");
    bytes.push_back(static_cast<std::uint8_t>(high * 16 + low));
  }
  if (bytes.size() < 5) fail(line, "too short for a record");
  if (bytes.size() != bytes[0] + std::size_t{5}) {
    fail(line, "announces " + std::to_string(bytes[0]) + " data bytes and carries " +
                   std::to_string(bytes.size() - 5));
  }
  const unsigned sum = std::accumulate(bytes.begin(), bytes.end(), 0U);
  if ((sum & 0xFF) != 0) {
    std::array<char, 24> right{};
    std::snprintf(right.data(), right.size(), "%02X", (bytes.back() - sum) & 0xFF);
    fail(line, std::string("the checksum should be ") + right.data());
  }
  return bytes;
}

void append(std::vector<HexSegment>& segments, std::uint32_t address, std::span<const std::uint8_t> data) {
  if (segments.empty() || segments.back().address + segments.back().bytes.size() != address)
    segments.push_back({address, {}});
  segments.back().bytes.insert(segments.back().bytes.end(), data.begin(), data.end());
}

void expect_length(std::span<const std::uint8_t> data, std::size_t length, std::size_t line) {
  if (data.size() != length)
    fail(line, "a record of this type carries " + std::to_string(length) + " data bytes");
}

}  // namespace

std::vector<HexSegment> parse_hex(std::string_view text) {
  std::vector<HexSegment> segments;
  std::uint32_t base = 0;
  bool ended = false;
  std::size_t line = 0;
  while (!text.empty()) {
    ++line;
    const std::size_t end = text.find('\n');
    std::string_view record = text.substr(0, end);
    text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
    while (!record.empty() && (record.back() == '\r' || record.back() == ' ')) record.remove_suffix(1);
    if (record.empty()) continue;
    if (ended) fail(line, "a record after the end-of-file record");

    const std::vector<std::uint8_t> bytes = bytes_of(record, line);
    const std::span<const std::uint8_t> data(bytes.data() + 4, bytes[0]);
    const auto offset = static_cast<std::uint32_t>(bytes[1] << 8 | bytes[2]);
    switch (static_cast<Record>(bytes[3])) {
      case Record::kData:
        if (offset + data.size() > 0x10000) fail(line, "data beyond the end of its 64 KiB");
        append(segments, base + offset, data);
        break;
      case Record::kEndOfFile:
        expect_length(data, 0, line);
        ended = true;
        break;
      case Record::kExtendedSegment:
        expect_length(data, 2, line);
        base = static_cast<std::uint32_t>(data[0] << 8 | data[1]) << 4;
        break;
      case Record::kExtendedLinear:
        expect_length(data, 2, line);
        base = static_cast<std::uint32_t>(data[0] << 8 | data[1]) << 16;
        break;
      case Record::kStartSegment:
      case Record::kStartLinear:
        // Ignored: the processor starts from its vector table.
        expect_length(data, 4, line);
        break;
      default:
        fail(line, "unknown record type " + std::to_string(bytes[3]));
    }
  }
  if (!ended) fail(line, "no end-of-file record: the file is cut short");
  return segments;
}

}  // namespace groma::sim
