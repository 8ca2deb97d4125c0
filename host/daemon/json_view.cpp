#include "host/daemon/json_view.hpp"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstddef>
#include <limits>
#include <system_error>

namespace groma::daemon {
namespace {

bool is_digit(char c) noexcept {
  return c >= '0' && c <= '9';
}

bool is_hexadecimal(char c) noexcept {
  return is_digit(c) || (c >= 'a' && c <= 'f') || (c >= 'A' && c <= 'F');
}

// Reads a text from its begin. After a fault ok() is false and the rest is not read.
class Scanner {
 public:
  explicit Scanner(std::string_view text) noexcept : rest_(text) {}

  [[nodiscard]] bool ok() const noexcept { return ok_; }
  [[nodiscard]] bool at_end() const noexcept { return rest_.empty(); }

  void space() noexcept { rest_.remove_prefix(std::min(rest_.find_first_not_of(" \t\r\n"), rest_.size())); }

  // Reads a character if it is the next one.
  [[nodiscard]] bool accept(char c) noexcept {
    if (!ok_ || rest_.empty() || rest_.front() != c) return false;
    rest_.remove_prefix(1);
    return true;
  }
  void expect(char c) noexcept { ok_ = accept(c); }

  // Reads a value; returns its text.
  std::string_view value(int depth) noexcept {
    const std::string_view begin = rest_;
    if (rest_.empty() || depth > JsonView::kMaxDepth) {
      ok_ = false;
    } else if (rest_.front() == '{') {
      object(depth);
    } else if (rest_.front() == '[') {
      array(depth);
    } else if (rest_.front() == '"') {
      string();
    } else if (rest_.front() == '-' || is_digit(rest_.front())) {
      number();
    } else {
      word();
    }
    return begin.substr(0, begin.size() - rest_.size());
  }

  // Reads a string; returns the characters between its quotes.
  std::string_view string() noexcept {
    expect('"');
    const std::string_view begin = rest_;
    while (ok_ && !rest_.empty() && rest_.front() != '"') character();
    const std::string_view text = begin.substr(0, begin.size() - rest_.size());
    expect('"');
    return text;
  }

 private:
  void object(int depth) noexcept {
    expect('{');
    space();
    if (accept('}')) return;
    do {
      space();
      string();
      space();
      expect(':');
      space();
      if (ok_) value(depth + 1);
      space();
    } while (accept(','));
    expect('}');
  }

  void array(int depth) noexcept {
    expect('[');
    space();
    if (accept(']')) return;
    do {
      space();
      value(depth + 1);
      space();
    } while (accept(','));
    expect(']');
  }

  void character() noexcept {
    constexpr char kFirstPrintable = ' ';
    if (!accept('\\')) {
      const char c = rest_.front();
      // Bytes above 127 belong to UTF-8 sequences.
      ok_ = static_cast<unsigned char>(c) >= static_cast<unsigned char>(kFirstPrintable);
      rest_.remove_prefix(1);
      return;
    }
    if (accept('u')) {
      constexpr std::size_t kDigits = 4;
      ok_ = rest_.size() >= kDigits && std::all_of(rest_.begin(), rest_.begin() + kDigits, is_hexadecimal);
      if (ok_) rest_.remove_prefix(kDigits);
      return;
    }
    ok_ = !rest_.empty() && std::string_view("\"\\/bfnrt").find(rest_.front()) != std::string_view::npos;
    if (ok_) rest_.remove_prefix(1);
  }

  void number() noexcept {
    static_cast<void>(accept('-'));
    if (!accept('0')) digits();
    if (accept('.')) digits();
    if (accept('e') || accept('E')) {
      if (!accept('+')) static_cast<void>(accept('-'));
      digits();
    }
  }

  void digits() noexcept {
    ok_ = ok_ && !rest_.empty() && is_digit(rest_.front());
    while (ok_ && !rest_.empty() && is_digit(rest_.front())) rest_.remove_prefix(1);
  }

  void word() noexcept {
    for (const std::string_view word : {"null", "true", "false"}) {
      if (!rest_.starts_with(word)) continue;
      rest_.remove_prefix(word.size());
      return;
    }
    ok_ = false;
  }

  std::string_view rest_;
  bool ok_ = true;
};

}  // namespace

std::optional<JsonView> JsonView::parse(std::string_view text) noexcept {
  Scanner scanner(text);
  scanner.space();
  const std::string_view value = scanner.value(0);
  scanner.space();
  if (!scanner.ok() || !scanner.at_end()) return std::nullopt;
  return JsonView(value);
}

std::optional<double> JsonView::number() const noexcept {
  if (text_.front() != '-' && !is_digit(text_.front())) return std::nullopt;
  double value = 0.0;
  const auto [end, error] = std::from_chars(text_.data(), text_.data() + text_.size(), value);
  if (error != std::errc() || !std::isfinite(value)) return std::nullopt;
  return value;
}

std::optional<std::string_view> JsonView::string() const noexcept {
  if (text_.front() != '"') return std::nullopt;
  return text_.substr(1, text_.size() - 2);
}

std::optional<JsonView> JsonView::find(std::string_view name) const noexcept {
  std::optional<JsonView> found;
  Scanner scanner(text_);
  if (!scanner.accept('{')) return found;
  do {
    scanner.space();
    // Only an empty object has no name here.
    const std::string_view key = scanner.string();
    scanner.space();
    scanner.expect(':');
    scanner.space();
    if (!scanner.ok()) break;
    const std::string_view value = scanner.value(1);
    if (key == name) found = JsonView(value);
    scanner.space();
  } while (scanner.accept(','));
  return found;
}

bool JsonView::numbers(std::span<double> out) const noexcept {
  Scanner scanner(text_);
  if (!scanner.accept('[')) return false;
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (i > 0) scanner.expect(',');
    scanner.space();
    const std::string_view text = scanner.value(1);
    if (!scanner.ok()) return false;
    const JsonView element(text);
    const auto number = element.number();
    if (!number && !element.is_null()) return false;
    out[i] = number.value_or(std::numeric_limits<double>::quiet_NaN());
    scanner.space();
  }
  return scanner.accept(']');
}

}  // namespace groma::daemon
