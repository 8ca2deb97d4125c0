// Encodes one message of Protocol Buffers (protobuf.dev, encoding). Fields are named by their numbers in the
// .proto file; optional fields that are not written are absent.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>

#include "host/mcap/bytes.hpp"

namespace groma::convert {

class ProtoWriter {
 public:
  // uint32, uint64, int32 and int64 that are not negative, bool, enumerations.
  ProtoWriter& integer(unsigned field, std::uint64_t value) {
    tag(field, kVarint);
    varint(value);
    return *this;
  }
  // double.
  ProtoWriter& number(unsigned field, double value) {
    tag(field, kFixed64);
    mcap::append(bytes_, value);
    return *this;
  }
  // float.
  ProtoWriter& number(unsigned field, float value) {
    tag(field, kFixed32);
    mcap::append(bytes_, value);
    return *this;
  }
  // repeated double.
  ProtoWriter& numbers(unsigned field, std::span<const double> values) {
    tag(field, kLength);
    varint(values.size_bytes());
    for (const double value : values) mcap::append(bytes_, value);
    return *this;
  }
  // string, bytes, and an encoded message.
  ProtoWriter& bytes(unsigned field, std::string_view value) {
    tag(field, kLength);
    varint(value.size());
    bytes_ += value;
    return *this;
  }

  [[nodiscard]] const std::string& message() const noexcept { return bytes_; }

 private:
  enum WireType : unsigned { kVarint = 0, kFixed64 = 1, kLength = 2, kFixed32 = 5 };

  void tag(unsigned field, WireType type) { varint(field << 3U | type); }
  void varint(std::uint64_t value) {
    for (; value >= 0x80; value >>= 7U) bytes_ += static_cast<char>(value | 0x80U);
    bytes_ += static_cast<char>(value);
  }

  std::string bytes_;
};

}  // namespace groma::convert
