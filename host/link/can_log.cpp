#include "host/link/can_log.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cerrno>
#include <charconv>
#include <fstream>
#include <span>
#include <utility>

#include "host/link/descriptor.hpp"

namespace groma::link {
namespace {

// CAN_ERR_FLAG of linux/can.h: candump prints it with the error class.
constexpr std::uint32_t kErrorFrame = 0x2000'0000;
constexpr std::size_t kExtendedIdDigits = 8;
constexpr std::size_t kStandardIdDigits = 3;
constexpr unsigned kBitRateSwitch = 1;

// `text` as a number; nothing unless all of it is one.
template <typename Number, typename... Base>
std::optional<Number> number(std::string_view text, Base... base) {
  Number value{};
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value, base...);
  if (error != std::errc{} || end != text.data() + text.size()) return std::nullopt;
  return value;
}

// Returns the text before the next `mark` and removes it with the mark; without a mark, the whole text.
std::string_view take_until(std::string_view& text, char mark) {
  const std::size_t at = std::min(text.find(mark), text.size());
  const std::string_view taken = text.substr(0, at);
  text.remove_prefix(std::min(at + 1, text.size()));
  return taken;
}

bool parse_payload(std::string_view digits, wire::CanFrame& frame) {
  const std::size_t size = digits.size() / 2;
  if (digits.size() % 2 != 0 || size > wire::max_can_payload(frame.format) ||
      wire::kCanLengths[wire::can_length_code(size)] != size) {
    return false;
  }
  for (std::size_t i = 0; i < size; ++i) {
    const auto byte = number<std::uint8_t>(digits.substr(2 * i, 2), 16);
    if (!byte) return false;
    frame.data[i] = *byte;
  }
  frame.size = static_cast<std::uint8_t>(size);
  return true;
}

}  // namespace

CanLogLine parse_candump_line(std::string_view line) {
  LoggedCanFrame logged;
  if (!line.starts_with('(')) return {};
  line.remove_prefix(1);
  const auto t_s = number<double>(take_until(line, ')'));
  if (!t_s || !line.starts_with(' ')) return {};
  logged.t_s = *t_s;
  line.remove_prefix(1);
  logged.interface = take_until(line, ' ');
  // A direction, R or T, may follow the frame (candump -x).
  std::string_view content = take_until(line, ' ');
  const std::string_view id_digits = take_until(content, '#');
  const auto id = number<std::uint32_t>(id_digits, 16);
  if (logged.interface.empty() || !id) return {};
  if (id_digits.size() == kStandardIdDigits || (*id & kErrorFrame) != 0 || content.starts_with('R')) {
    return {.intact = true, .frame = std::nullopt};
  }
  if (id_digits.size() != kExtendedIdDigits || *id > wire::kCanIdBits) return {};
  logged.frame.id = *id;
  if (content.starts_with('#')) {
    const auto flags = number<unsigned>(content.substr(1, 1), 16);
    if (!flags) return {};
    logged.frame.format = wire::CanFormat::kFd;
    logged.frame.bit_rate_switch = (*flags & kBitRateSwitch) != 0;
    content.remove_prefix(2);
  }
  if (!parse_payload(content, logged.frame)) return {};
  return {.intact = true, .frame = std::move(logged)};
}

CanLog read_candump_log(const std::filesystem::path& path) {
  std::ifstream file(path);
  if (!file) return {{}, explain_open_error(path.string(), errno)};
  CanLog log;
  std::string line;
  for (std::size_t number = 1; std::getline(file, line); ++number) {
    if (line.ends_with('\r')) line.pop_back();
    if (line.empty()) continue;
    CanLogLine parsed = parse_candump_line(line);
    if (!parsed.intact) {
      return {{},
              {LinkFault::kUnsuitable,
               fmt::format("{}:{}: not a line of a candump log; record one with 'candump -l can0'",
                           path.string(), number)}};
    }
    if (parsed.frame) log.frames.push_back(std::move(*parsed.frame));
  }
  if (file.bad()) return {{}, explain_open_error(path.string(), EISDIR)};
  return log;
}

}  // namespace groma::link
