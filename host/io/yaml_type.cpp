#include "host/io/yaml_type.hpp"

#include <fmt/format.h>

#include <array>
#include <cmath>
#include <optional>
#include <utility>

#include <nlohmann/json.hpp>

namespace groma::io {

namespace {

constexpr std::array<std::string_view, 2> kSwitch{"false", "true"};
constexpr std::string_view kVariantKey = "type";

std::vector<std::string_view> views_of(const std::vector<std::string>& words) {
  return {words.begin(), words.end()};
}

// The words of the maps' own keys `type`.
std::vector<std::string> variant_words(const std::vector<YamlType>& maps) {
  std::vector<std::string> words;
  words.reserve(maps.size());
  for (const YamlType& map : maps) words.push_back(map.keys.front().type.words.front());
  return words;
}

}  // namespace

YamlType YamlType::text() {
  return {};
}

YamlType YamlType::word(std::vector<std::string> words) {
  YamlType type;
  type.kind = Kind::kWord;
  type.words = std::move(words);
  return type;
}

YamlType YamlType::boolean() {
  YamlType type;
  type.kind = Kind::kSwitch;
  return type;
}

YamlType YamlType::number() {
  YamlType type;
  type.kind = Kind::kNumber;
  return type;
}

YamlType YamlType::positive() {
  YamlType type = number();
  type.min = 0.0;
  type.with_min = false;
  return type;
}

YamlType YamlType::between(double min, double max) {
  YamlType type = number();
  type.min = min;
  type.max = max;
  return type;
}

YamlType YamlType::integer(std::int64_t min, std::int64_t max) {
  YamlType type = between(static_cast<double>(min), static_cast<double>(max));
  type.kind = Kind::kInteger;
  return type;
}

YamlType YamlType::numbers(std::size_t size) {
  YamlType type = list(number());
  type.size = size;
  return type;
}

YamlType YamlType::list(YamlType entries) {
  YamlType type;
  type.kind = Kind::kList;
  type.of.push_back(std::move(entries));
  return type;
}

YamlType YamlType::map(std::vector<YamlKey> keys, std::vector<Choice> choices) {
  YamlType type;
  type.kind = Kind::kMap;
  type.keys = std::move(keys);
  type.choices = std::move(choices);
  return type;
}

YamlType YamlType::text_or(YamlType other) {
  YamlType type;
  type.kind = Kind::kTextOr;
  type.of.push_back(std::move(other));
  return type;
}

YamlType YamlType::variant(std::vector<YamlType> maps) {
  YamlType type;
  type.kind = Kind::kVariant;
  type.of = std::move(maps);
  return type;
}

std::vector<ConfigError> YamlType::errors_of(const YamlValue& value) const {
  std::vector<ConfigError> errors;
  check(value, errors);
  return errors;
}

std::vector<ConfigError> YamlType::key_errors_of(const YamlValue& value) const {
  YamlValue::Keys names;
  for (const YamlKey& key : keys) (key.required ? names.required : names.optional).emplace_back(key.name);
  return value.key_errors(names);
}

void YamlType::expect(const YamlValue& value) const {
  if (const std::vector<ConfigError> errors = errors_of(value); !errors.empty())
    throw ConfigError(errors.front());
}

void YamlType::check(const YamlValue& value, std::vector<ConfigError>& errors) const {
  try {
    switch (kind) {
      case Kind::kMap:
        return check_map(value, errors);
      case Kind::kTextOr:
        if (!value.is_scalar()) of.front().check(value, errors);
        return;
      case Kind::kVariant:
        return check_variant(value, errors);
      case Kind::kList:
        return check_list(value, errors);
      default:
        check_scalar(value);
    }
  } catch (const ConfigError& error) {
    errors.push_back(error);
  }
}

void YamlType::check_scalar(const YamlValue& value) const {
  if (kind == Kind::kWord) {
    static_cast<void>(value.one_of(views_of(words)));
  } else if (kind == Kind::kSwitch) {
    static_cast<void>(value.one_of(kSwitch));
  } else if (kind == Kind::kInteger) {
    static_cast<void>(value.integer(static_cast<std::int64_t>(min), static_cast<std::int64_t>(max)));
  } else if (kind == Kind::kText) {
    static_cast<void>(value.text());
  } else if (!with_min) {
    static_cast<void>(value.positive_number());
  } else {
    const double number = value.number();
    if (!(number >= min && number <= max)) {
      value.fail(fmt::format("is {}", number), fmt::format("it has to be from {} to {}", min, max));
    }
  }
}

void YamlType::check_map(const YamlValue& value, std::vector<ConfigError>& errors) const {
  std::vector<ConfigError> own = key_errors_of(value);
  errors.insert(errors.end(), own.begin(), own.end());
  for (const YamlKey& key : keys) {
    if (const std::optional<YamlValue> child = value.find(key.name)) key.type.check(*child, errors);
  }
}

void YamlType::check_list(const YamlValue& value, std::vector<ConfigError>& errors) const {
  for (const YamlValue& entry : size > 0 ? value.list_of(size) : value.list())
    of.front().check(entry, errors);
}

void YamlType::check_variant(const YamlValue& value, std::vector<ConfigError>& errors) const {
  const std::vector<std::string> types = variant_words(of);
  // A map without a type is taken for the first, which then reports it.
  const std::optional<YamlValue> type = value.find(kVariantKey);
  const std::size_t index = type ? type->one_of(views_of(types)) : 0;
  of[index].check(value, errors);
}

nlohmann::ordered_json YamlType::schema() const {
  using Json = nlohmann::ordered_json;
  Json out;
  switch (kind) {
    case Kind::kText:
      out["type"] = "string";
      return out;
    case Kind::kSwitch:
      out["type"] = "boolean";
      return out;
    case Kind::kWord:
      out["enum"] = words;
      return out;
    case Kind::kInteger:
      out["type"] = "integer";
      out["minimum"] = static_cast<std::int64_t>(min);
      out["maximum"] = static_cast<std::int64_t>(max);
      return out;
    case Kind::kNumber:
      out["type"] = "number";
      if (std::isfinite(min)) out[with_min ? "minimum" : "exclusiveMinimum"] = min;
      if (std::isfinite(max)) out["maximum"] = max;
      return out;
    case Kind::kList:
      out["type"] = "array";
      out["items"] = of.front().schema();
      if (size == 0) return out;
      out["minItems"] = size;
      out["maxItems"] = size;
      return out;
    case Kind::kTextOr:
      out["anyOf"] = {text().schema(), of.front().schema()};
      return out;
    case Kind::kVariant:
      for (const YamlType& map : of) out["anyOf"].push_back(map.schema());
      return out;
    case Kind::kMap:
      break;
  }
  out["type"] = "object";
  out["additionalProperties"] = false;
  for (const Choice& choice : choices) {
    Json& demand = choices.size() == 1 ? out : out["allOf"].emplace_back();
    for (const std::vector<std::string>& names : choice.of)
      demand[choice.combines ? "anyOf" : "oneOf"].push_back({{"required", names}});
  }
  for (const YamlKey& key : keys) {
    if (key.required) out["required"].push_back(key.name);
    Json& property = out["properties"][key.name] = key.type.schema();
    if (!key.meaning.empty()) property["description"] = key.meaning;
  }
  return out;
}

}  // namespace groma::io
