// Types of the values in a YAML file: the keys of a map, the values that a key may have. One definition gives
// the check of a file, with all its errors, and the JSON schema for editors.
#pragma once

#include <cstdint>
#include <limits>
#include <string>
#include <string_view>
#include <vector>

#include <nlohmann/json_fwd.hpp>

#include "host/io/error.hpp"
#include "host/io/yaml_reader.hpp"

namespace groma::io {

struct YamlKey;

struct YamlType {
  enum class Kind {
    kText,
    kWord,     // one of `words`
    kSwitch,   // true or false
    kNumber,   // finite, from `min` to `max`; without `with_min`: above `min`
    kInteger,  // from `min` to `max`
    kMap,      // with `keys`; with what each of `choices` demands
    kTextOr,   // a text, or `of.front()`
    kVariant,  // one of the maps `of`: each has the key `type`, which takes a single word
    kList,     // of `of.front()`; `size` entries, 0: any number
  };

  Kind kind = Kind::kText;
  double min = -std::numeric_limits<double>::infinity();
  double max = std::numeric_limits<double>::infinity();
  bool with_min = true;
  std::size_t size = 0;
  std::vector<std::string> words;
  std::vector<YamlKey> keys;
  std::vector<YamlType> of;
  // All keys of one of these sets of optional keys: for the schema; the parser checks them.
  struct Choice {
    std::vector<std::vector<std::string>> of;
    bool combines = false;  // several sets may be given
  };
  std::vector<Choice> choices;

  [[nodiscard]] static YamlType text();
  [[nodiscard]] static YamlType word(std::vector<std::string> words);
  [[nodiscard]] static YamlType boolean();
  [[nodiscard]] static YamlType number();
  [[nodiscard]] static YamlType positive();
  [[nodiscard]] static YamlType between(double min, double max);
  [[nodiscard]] static YamlType integer(std::int64_t min, std::int64_t max);
  [[nodiscard]] static YamlType numbers(std::size_t size);
  [[nodiscard]] static YamlType list(YamlType entries);
  [[nodiscard]] static YamlType map(std::vector<YamlKey> keys, std::vector<Choice> choices = {});
  [[nodiscard]] static YamlType text_or(YamlType other);
  [[nodiscard]] static YamlType variant(std::vector<YamlType> maps);

  // All errors of the value, in the order of the keys. It may still violate rules that no type states.
  [[nodiscard]] std::vector<ConfigError> errors_of(const YamlValue& value) const;
  // Those of the keys alone, for a map: unknown, repeated, missing.
  [[nodiscard]] std::vector<ConfigError> key_errors_of(const YamlValue& value) const;
  // Throws the first of errors_of().
  void expect(const YamlValue& value) const;
  // As JSON Schema, draft 7.
  [[nodiscard]] nlohmann::ordered_json schema() const;

 private:
  void check(const YamlValue& value, std::vector<ConfigError>& errors) const;
  void check_scalar(const YamlValue& value) const;
  void check_map(const YamlValue& value, std::vector<ConfigError>& errors) const;
  void check_list(const YamlValue& value, std::vector<ConfigError>& errors) const;
  void check_variant(const YamlValue& value, std::vector<ConfigError>& errors) const;
};

struct YamlKey {
  std::string name;
  YamlType type;
  std::string meaning;  // one sentence, for editors
  bool required = true;
};

}  // namespace groma::io
