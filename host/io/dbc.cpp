#include "host/io/dbc.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <charconv>
#include <cmath>
#include <limits>
#include <system_error>

namespace groma::io {
namespace {

constexpr unsigned kMaxBytes = 64;  // of a payload of CAN FD
constexpr unsigned kMaxBits = 64;   // of a signal
constexpr std::string_view kSignalForm =
    "write it as SG_ NAME : START|BITS@ORDER SIGN (FACTOR,OFFSET) [MIN|MAX] \"UNIT\" RECEIVERS";

// A position in the text. A section that is read ends with its line.
class Cursor {
 public:
  Cursor(const std::filesystem::path& path, std::string_view text) : path_(path), text_(text) {}

  [[nodiscard]] bool at_end() const noexcept { return at_ == text_.size(); }
  // The next character; 0 at the end.
  [[nodiscard]] char peek() const noexcept { return at_end() ? '\0' : text_[at_]; }
  [[nodiscard]] FilePlace place() const { return {path_, line_, at_ - line_begin_ + 1}; }
  [[noreturn]] void fail(std::string_view remedy) const {
    const std::string_view rest = text_.substr(at_, text_.find_first_of("\r\n", at_) - at_);
    throw ConfigError(place(), fmt::format("{} is not expected here", shown(rest)), remedy);
  }

  void skip_blanks() noexcept {
    while (peek() == ' ' || peek() == '\t' || peek() == '\r') ++at_;
  }
  [[nodiscard]] bool at_line_end() noexcept {
    skip_blanks();
    return at_end() || peek() == '\n';
  }
  // To the begin of the next line; a quoted text may extend over several.
  void skip_line() {
    while (!at_end() && peek() != '\n') {
      if (peek() == '"') {
        static_cast<void>(quoted());
      } else {
        ++at_;
      }
    }
    if (!at_end()) new_line();
  }

  // A name; empty if there is none.
  [[nodiscard]] std::string_view word() noexcept {
    skip_blanks();
    const std::size_t begin = at_;
    const auto is_part = [](char c) {
      return (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') || (c >= '0' && c <= '9') || c == '_';
    };
    while (is_part(peek())) ++at_;
    return text_.substr(begin, at_ - begin);
  }
  [[nodiscard]] std::string name(std::string_view remedy) {
    const std::string_view found = word();
    if (found.empty()) fail(remedy);
    return std::string(found);
  }
  [[nodiscard]] bool take(char c) noexcept {
    skip_blanks();
    if (peek() != c) return false;
    ++at_;
    return true;
  }
  void expect(char c, std::string_view remedy) {
    if (!take(c)) fail(remedy);
  }
  template <typename Number>
  [[nodiscard]] Number number(std::string_view remedy) {
    skip_blanks();
    const char* const begin = text_.data() + at_ + (peek() == '+' ? 1 : 0);
    Number value{};
    const auto [end, error] = std::from_chars(begin, text_.data() + text_.size(), value);
    if (error != std::errc()) fail(remedy);
    at_ = static_cast<std::size_t>(end - text_.data());
    return value;
  }
  [[nodiscard]] std::string quoted() {
    const FilePlace begin = place();
    std::string out;
    for (++at_; peek() != '"'; ++at_) {
      if (at_end()) throw ConfigError(begin, "the quoted text does not end", "add the closing quote");
      if (peek() == '\\' && at_ + 1 < text_.size() && text_[at_ + 1] == '"') ++at_;
      out += text_[at_];
      if (text_[at_] != '\n') continue;
      line_begin_ = at_ + 1;
      ++line_;
    }
    ++at_;
    return out;
  }

 private:
  void new_line() noexcept {
    ++at_;
    ++line_;
    line_begin_ = at_;
  }

  const std::filesystem::path& path_;
  std::string_view text_;
  std::size_t at_ = 0;
  std::size_t line_ = 1;
  std::size_t line_begin_ = 0;
};

// BO_ ID NAME: BYTES SENDER
DbcMessage parse_message(Cursor& cursor) {
  constexpr std::string_view kForm = "write it as BO_ ID NAME: BYTES SENDER";
  DbcMessage message;
  message.place = cursor.place();
  message.id = cursor.number<std::uint32_t>(kForm);
  message.name = cursor.name(kForm);
  cursor.expect(':', kForm);
  message.bytes = cursor.number<unsigned>(kForm);
  return message;
}

// M, or m and the multiplexor's value; m1M is both.
void parse_multiplexing(Cursor& cursor, DbcSignal& signal) {
  const FilePlace place = cursor.place();
  const std::string_view whole = cursor.word();
  if (whole.empty()) cursor.fail(kSignalForm);
  std::string_view word = whole;
  if (word.ends_with('M')) {
    signal.is_multiplexor = true;
    word.remove_suffix(1);
  }
  if (word.empty() && signal.is_multiplexor) return;
  std::uint64_t value = 0;
  const char* const end = word.data() + word.size();
  if (word.size() < 2 || word.front() != 'm' || std::from_chars(word.data() + 1, end, value).ptr != end) {
    throw ConfigError(place, fmt::format("{} is no multiplexing", shown(whole)),
                      "write M for the multiplexor, or m and its value, such as m0");
  }
  signal.multiplexed = value;
}

DbcSignal parse_signal(Cursor& cursor) {
  DbcSignal signal;
  cursor.skip_blanks();
  signal.place = cursor.place();
  signal.name = cursor.name(kSignalForm);
  if (!cursor.take(':')) {
    parse_multiplexing(cursor, signal);
    cursor.expect(':', kSignalForm);
  }
  signal.start_bit = cursor.number<unsigned>(kSignalForm);
  cursor.expect('|', kSignalForm);
  signal.bits = cursor.number<unsigned>(kSignalForm);
  cursor.expect('@', kSignalForm);
  signal.big_endian = cursor.take('0');
  if (!signal.big_endian) cursor.expect('1', kSignalForm);
  if (cursor.take('-')) {
    signal.type = DbcSignal::Type::kSigned;
  } else {
    cursor.expect('+', kSignalForm);
  }
  const auto pair = [&](char open, double& first, char between, double& second, char close) {
    cursor.expect(open, kSignalForm);
    first = cursor.number<double>(kSignalForm);
    cursor.expect(between, kSignalForm);
    second = cursor.number<double>(kSignalForm);
    cursor.expect(close, kSignalForm);
  };
  pair('(', signal.factor, ',', signal.offset, ')');
  pair('[', signal.min, '|', signal.max, ']');
  cursor.skip_blanks();
  if (cursor.peek() != '"') cursor.fail(kSignalForm);
  signal.unit = cursor.quoted();
  return signal;
}

// SIG_VALTYPE_ ID NAME : TYPE; with type 1 for float and 2 for double. Signals that do not exist are ignored.
void parse_type(Cursor& cursor, std::vector<DbcMessage>& messages) {
  constexpr std::string_view kForm = "write it as SIG_VALTYPE_ ID NAME : TYPE, with type 0, 1 or 2";
  const auto id = cursor.number<std::uint32_t>(kForm);
  const std::string name = cursor.name(kForm);
  static_cast<void>(cursor.take(':'));
  const auto type = cursor.number<unsigned>(kForm);
  for (DbcMessage& message : messages) {
    if (message.id != id || type == 0) continue;
    for (DbcSignal& signal : message.signals) {
      if (signal.name == name) {
        signal.type = type == 1 ? DbcSignal::Type::kFloat : DbcSignal::Type::kDouble;
      }
    }
  }
}

// The last byte that has a bit of the signal.
std::size_t last_byte(const DbcSignal& signal) noexcept {
  // Counted from the most significant bit of byte 0 on, a big-endian signal's bits are adjacent.
  const std::size_t first =
      signal.big_endian ? signal.start_bit / 8 * 8 + (7 - signal.start_bit % 8) : signal.start_bit;
  return (first + signal.bits - 1) / 8;
}

}  // namespace

std::vector<DbcMessage> parse_dbc(const std::filesystem::path& path, std::string_view text) {
  std::vector<DbcMessage> messages;
  Cursor cursor(path, text);
  while (!cursor.at_end()) {
    const std::string_view section = cursor.word();
    // The section NS_ lists names of sections, each on a line of its own.
    if (!cursor.at_line_end()) {
      if (section == "BO_") {
        messages.push_back(parse_message(cursor));
      } else if (section == "SG_") {
        if (messages.empty()) cursor.fail("put the signal below the BO_ line of its message");
        messages.back().signals.push_back(parse_signal(cursor));
      } else if (section == "SIG_VALTYPE_") {
        parse_type(cursor, messages);
      }
    }
    cursor.skip_line();
  }
  return messages;
}

void expect_readable(const DbcMessage& message, const DbcSignal& signal) {
  const auto fail = [&](const std::string& problem, std::string_view remedy) {
    throw ConfigError(signal.place, fmt::format("{}.{} {}", message.name, signal.name, problem), remedy);
  };
  if (signal.bits == 0 || signal.bits > kMaxBits)
    fail(fmt::format("has {} bits", signal.bits), "give it 1 to 64");
  if (message.bytes > kMaxBytes || !fits(signal, message.bytes)) {
    fail(fmt::format("does not fit the {} bytes of its message", message.bytes),
         "correct the start bit, the number of bits or the message's length");
  }
  const bool is_float = signal.type == DbcSignal::Type::kFloat;
  if ((is_float && signal.bits != 32) || (signal.type == DbcSignal::Type::kDouble && signal.bits != 64)) {
    fail(fmt::format("is a floating-point number of {} bits", signal.bits),
         "give a float 32 bits and a double 64, or remove its SIG_VALTYPE_ line");
  }
  if (!std::isfinite(signal.factor) || signal.factor == 0.0 || !std::isfinite(signal.offset)) {
    fail(fmt::format("has the factor {} and the offset {}", signal.factor, signal.offset),
         "give a finite factor other than 0, and a finite offset");
  }
}

bool fits(const DbcSignal& signal, std::size_t bytes) noexcept {
  return signal.start_bit / 8 < bytes && last_byte(signal) < bytes;
}

std::uint64_t raw_value(const DbcSignal& signal, std::span<const std::uint8_t> payload) noexcept {
  std::uint64_t raw = 0;
  unsigned bit = signal.start_bit;
  for (unsigned i = 0; i < signal.bits; ++i) {
    const std::uint64_t value = payload[bit / 8] >> (bit % 8) & 1U;
    if (signal.big_endian) {
      // Downwards within a byte, then on with the most significant bit of the next.
      raw = raw << 1U | value;
      bit = bit % 8 == 0 ? bit + 15 : bit - 1;
    } else {
      raw |= value << i;
      ++bit;
    }
  }
  return raw;
}

double physical_value(const DbcSignal& signal, std::span<const std::uint8_t> payload) noexcept {
  const std::uint64_t raw = raw_value(signal, payload);
  double value = 0.0;
  switch (signal.type) {
    case DbcSignal::Type::kUnsigned:
      value = static_cast<double>(raw);
      break;
    case DbcSignal::Type::kSigned: {
      // The sign bit in the most significant place, and back by an arithmetic shift.
      const unsigned unused = kMaxBits - signal.bits;
      value = static_cast<double>(static_cast<std::int64_t>(raw << unused) >> unused);
      break;
    }
    case DbcSignal::Type::kFloat:
      value = static_cast<double>(std::bit_cast<float>(static_cast<std::uint32_t>(raw)));
      break;
    case DbcSignal::Type::kDouble:
      value = std::bit_cast<double>(raw);
      break;
  }
  return signal.factor * value + signal.offset;
}

}  // namespace groma::io
