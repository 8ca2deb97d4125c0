// A JSON value (RFC 8259) as a view of its text. It uses no heap, so that reading the robot's odometry does
// not.
#pragma once

#include <optional>
#include <span>
#include <string_view>

namespace groma::daemon {

class JsonView {
 public:
  // Arrays and objects in each other; deeper ones are refused.
  static constexpr int kMaxDepth = 32;

  // Nothing unless the text is one JSON value, with or without space around it. The text has to outlive the
  // view. Whether strings are valid UTF-8 is not checked.
  [[nodiscard]] static std::optional<JsonView> parse(std::string_view text) noexcept;

  [[nodiscard]] bool is_object() const noexcept { return text_.front() == '{'; }
  [[nodiscard]] bool is_null() const noexcept { return text_.front() == 'n'; }
  // Nothing unless it is a number that a double can hold.
  [[nodiscard]] std::optional<double> number() const noexcept;
  // The characters between the quotes, with escapes as they are written; nothing unless it is a string.
  [[nodiscard]] std::optional<std::string_view> string() const noexcept;
  // An object's member, the last of that name. A name that is written with escapes is not found.
  [[nodiscard]] std::optional<JsonView> find(std::string_view name) const noexcept;
  // Whether it is an array of out.size() numbers and nulls; a null gives NaN.
  [[nodiscard]] bool numbers(std::span<double> out) const noexcept;

 private:
  explicit JsonView(std::string_view text) noexcept : text_(text) {}

  std::string_view text_;  // of one valid value, without space around it
};

}  // namespace groma::daemon
