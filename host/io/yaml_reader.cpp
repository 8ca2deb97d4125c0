#include "host/io/yaml_reader.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <set>
#include <system_error>
#include <utility>

#include "host/io/spelling.hpp"

namespace groma::io {

namespace {

FilePlace place_of(const std::filesystem::path& path, const YAML::Mark& mark) {
  if (mark.is_null()) return {path};
  return {path, static_cast<std::size_t>(mark.line) + 1, static_cast<std::size_t>(mark.column) + 1};
}

template <typename Words>
std::string joined(const Words& words) {
  std::string text;
  for (const std::string_view word : words) text += (text.empty() ? "" : ", ") + std::string(word);
  return text;
}

}  // namespace

YamlValue YamlValue::parse(const std::filesystem::path& path, const std::string& text) {
  YAML::Node node;
  try {
    node = YAML::Load(text);
  } catch (const YAML::Exception& error) {
    throw ConfigError(place_of(path, error.mark), fmt::format("invalid YAML ({})", error.msg),
                      "correct the syntax at this place");
  }
  if (!node.IsMap()) {
    throw ConfigError({path, 1, 1}, node.IsNull() ? "the file is empty" : "the document is not a map",
                      "write lines such as 'schema: 1'");
  }
  return {std::make_shared<const std::filesystem::path>(path), "", node};
}

FilePlace YamlValue::place() const {
  return place_of(*path_, node_.Mark());
}

ConfigError YamlValue::error(std::string_view problem, std::string_view remedy) const {
  const std::string subject = name_.empty() ? std::string(problem) : fmt::format("{} {}", name_, problem);
  return {place(), subject, remedy};
}

void YamlValue::fail(std::string_view problem, std::string_view remedy) const {
  throw ConfigError(error(problem, remedy));
}

void YamlValue::expect_keys(const Keys& keys) const {
  if (const std::vector<ConfigError> errors = key_errors(keys); !errors.empty()) {
    throw ConfigError(errors.front());
  }
}

std::vector<ConfigError> YamlValue::key_errors(const Keys& keys) const {
  std::vector<std::string_view> all = keys.required;
  all.insert(all.end(), keys.optional.begin(), keys.optional.end());
  if (!node_.IsMap()) {
    const auto& wanted = keys.required.empty() ? all : keys.required;
    const char* const is = node_.IsScalar() ? "a single value" : node_.IsSequence() ? "a list" : "empty";
    return {error(fmt::format("needs keys, and is {}", is),
                  fmt::format("write it as {{{}: ...}}; its keys are {}", wanted.front(), joined(wanted)))};
  }
  std::vector<ConfigError> errors;
  std::set<std::string> seen;
  for (const auto& entry : node_) {
    const FilePlace key_place = place_of(*path_, entry.first.Mark());
    const std::string key = entry.first.IsScalar() ? entry.first.Scalar() : std::string();
    if (std::find(all.begin(), all.end(), key) == all.end()) {
      const std::string meant = did_you_mean(key, all);
      errors.emplace_back(
          key_place, fmt::format("unknown key {}", shown(key)),
          fmt::format("{}known here: {}", meant.empty() ? "remove it; " : meant, joined(all)));
    } else if (!seen.insert(key).second) {
      errors.emplace_back(key_place, fmt::format("key {} occurs twice", key), "keep one of them");
    }
  }
  for (const std::string_view key : keys.required) {
    if (seen.contains(std::string(key))) continue;
    errors.push_back(
        error(name_.empty() ? fmt::format("key {} is missing", key) : fmt::format("lacks the key {}", key),
              "add it"));
  }
  return errors;
}

YAML::Node YamlValue::child(std::string_view key) const {
  for (const auto& entry : node_) {
    if (entry.first.IsScalar() && entry.first.Scalar() == key) return entry.second;
  }
  return YAML::Node(YAML::NodeType::Undefined);
}

YamlValue YamlValue::at(std::string_view key) const {
  std::optional<YamlValue> value = find(key);
  if (!value) fail(fmt::format("lacks the key {}", key), "add it");
  return *std::move(value);
}

std::optional<YamlValue> YamlValue::find(std::string_view key) const {
  if (!node_.IsMap()) return std::nullopt;
  const YAML::Node node = child(key);
  if (!node.IsDefined()) return std::nullopt;
  return YamlValue(path_, name_.empty() ? std::string(key) : fmt::format("{}.{}", name_, key), node);
}

std::vector<YamlValue> YamlValue::list() const {
  if (!node_.IsSequence()) fail("has to be a list", "write it as [a, b] or as lines that begin with '-'");
  std::vector<YamlValue> values;
  values.reserve(node_.size());
  for (const auto& entry : node_) {
    values.push_back(YamlValue(path_, fmt::format("{}[{}]", name_, values.size()), entry));
  }
  return values;
}

std::vector<YamlValue> YamlValue::list_of(std::size_t size) const {
  std::vector<YamlValue> values = list();
  if (values.size() != size) {
    fail(fmt::format("has {} entries", values.size()), fmt::format("give it {}", size));
  }
  return values;
}

std::vector<double> YamlValue::numbers(std::size_t size) const {
  std::vector<double> numbers;
  numbers.reserve(size);
  for (const YamlValue& value : list_of(size)) numbers.push_back(value.number());
  return numbers;
}

std::string YamlValue::plain_scalar(std::string_view wanted) const {
  // A quoted scalar has the tag "!": it is text, even if it looks like a number.
  if (!node_.IsScalar() || node_.Tag() == "!")
    fail(fmt::format("is not {}", wanted), fmt::format("write {}", wanted));
  return node_.Scalar();
}

std::string YamlValue::text() const {
  if (!node_.IsScalar()) fail("is not text", "write a word or a quoted text");
  return node_.Scalar();
}

double YamlValue::number() const {
  const std::string scalar = plain_scalar("a number");
  const char* begin = scalar.data();
  const char* const end = begin + scalar.size();
  if (scalar.size() > 1 && *begin == '+' && begin[1] != '-') ++begin;
  double value = 0.0;
  const auto [last, error] = std::from_chars(begin, end, value);
  if (error != std::errc() || last != end)
    fail(fmt::format("is not a number: {}", shown(scalar)), "write a number");
  if (!std::isfinite(value)) fail(fmt::format("is not finite: {}", shown(scalar)), "write a finite number");
  return value;
}

double YamlValue::positive_number() const {
  const double value = number();
  if (!(value > 0.0)) fail(fmt::format("is {}", value), "it has to be above 0");
  return value;
}

std::int64_t YamlValue::integer(std::int64_t min, std::int64_t max) const {
  const std::string scalar = plain_scalar("a whole number");
  std::int64_t value = 0;
  const auto [last, error] = std::from_chars(scalar.data(), scalar.data() + scalar.size(), value);
  if (error != std::errc() || last != scalar.data() + scalar.size()) {
    fail(fmt::format("is not a whole number: {}", shown(scalar)), "write a whole number");
  }
  if (value < min || value > max)
    fail(fmt::format("is {}", value), fmt::format("it has to be {} to {}", min, max));
  return value;
}

std::size_t YamlValue::one_of(std::span<const std::string_view> words) const {
  const std::string word = text();
  const auto found = std::find(words.begin(), words.end(), word);
  if (found == words.end())
    fail(fmt::format("is {}", shown(word)),
         fmt::format("{}it has to be one of {}", did_you_mean(word, words), joined(words)));
  return static_cast<std::size_t>(found - words.begin());
}

}  // namespace groma::io
