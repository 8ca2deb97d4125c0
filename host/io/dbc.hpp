// Reads the messages and signals of a DBC file, which describes a CAN bus: the sections BO_ with SG_, and
// SIG_VALTYPE_. All other sections are skipped.
#pragma once

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "host/io/error.hpp"

namespace groma::io {

// A part of a message's payload. Bits are numbered as in the file: bit 8 i + k is bit k of byte i, bit 0 of a
// byte being its least significant one.
struct DbcSignal {
  enum class Type : std::uint8_t { kUnsigned, kSigned, kFloat, kDouble };

  std::string name;
  FilePlace place;
  bool big_endian = false;  // "Motorola"; otherwise "Intel"
  unsigned start_bit =
      0;  // of the most significant bit if big_endian, of the least significant one otherwise
  unsigned bits = 0;
  Type type = Type::kUnsigned;
  double factor = 1.0;  // physical value = factor * raw value + offset
  double offset = 0.0;
  double min = 0.0;  // bounds of the physical value; both 0: none
  double max = 0.0;
  std::string unit;  // as in the file, in any encoding
  bool is_multiplexor = false;
  std::optional<std::uint64_t> multiplexed;  // present only while the multiplexor has this raw value

  [[nodiscard]] bool has_bounds() const noexcept { return min < max; }
};

struct DbcMessage {
  std::uint32_t id = 0;  // as in the file, and as can_id of Linux: bit 31 is set for an id of 29 bits
  std::string name;
  FilePlace place;
  unsigned bytes = 0;
  std::vector<DbcSignal> signals;
};

// `path` is for messages. Throws ConfigError with line and column if a section that is read has another form.
[[nodiscard]] std::vector<DbcMessage> parse_dbc(const std::filesystem::path& path, std::string_view text);

// Throws ConfigError if values of this signal cannot be read: it does not fit its message, or its type,
// length and factor contradict each other.
void expect_readable(const DbcMessage& message, const DbcSignal& signal);

// Whether a payload of that many bytes contains all bits of the signal.
[[nodiscard]] bool fits(const DbcSignal& signal, std::size_t bytes) noexcept;

// The signal's bits as an unsigned number, and its physical value. Require a readable signal that fits.
[[nodiscard]] std::uint64_t raw_value(const DbcSignal& signal,
                                      std::span<const std::uint8_t> payload) noexcept;
[[nodiscard]] double physical_value(const DbcSignal& signal, std::span<const std::uint8_t> payload) noexcept;

}  // namespace groma::io
