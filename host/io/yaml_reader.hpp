// Strict reader of YAML: unknown keys, repeated keys and wrong types are errors with line and column.
#pragma once

#include <yaml-cpp/yaml.h>

#include <cstddef>
#include <cstdint>
#include <filesystem>
#include <initializer_list>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "host/io/error.hpp"

namespace groma::io {

// A value in a YAML file. Each access throws ConfigError at the value's place if the value does not match.
class YamlValue {
 public:
  // Parses a document that is a map.
  static YamlValue parse(const std::filesystem::path& path, const std::string& text);

  // A map with these keys and no others.
  struct Keys {
    std::vector<std::string_view> required;
    std::vector<std::string_view> optional = {};
  };
  void expect_keys(const Keys& keys) const;
  // The value is no map, or its keys are unknown, repeated or missing: all such errors.
  [[nodiscard]] std::vector<ConfigError> key_errors(const Keys& keys) const;
  [[nodiscard]] YamlValue at(std::string_view key) const;  // a required key
  [[nodiscard]] std::optional<YamlValue> find(std::string_view key) const;

  [[nodiscard]] std::vector<YamlValue> list() const;
  [[nodiscard]] std::vector<YamlValue> list_of(std::size_t size) const;
  [[nodiscard]] std::vector<double> numbers(std::size_t size) const;  // a list of `size` finite numbers

  [[nodiscard]] bool is_null() const { return node_.IsNull(); }
  [[nodiscard]] bool is_scalar() const { return node_.IsScalar(); }
  [[nodiscard]] bool is_map() const { return node_.IsMap(); }
  [[nodiscard]] std::string text() const;
  [[nodiscard]] double number() const;           // finite
  [[nodiscard]] double positive_number() const;  // finite, > 0
  [[nodiscard]] std::int64_t integer(std::int64_t min, std::int64_t max) const;
  // The index of the value in `words`.
  [[nodiscard]] std::size_t one_of(std::span<const std::string_view> words) const;

  [[nodiscard]] FilePlace place() const;
  [[noreturn]] void fail(std::string_view problem, std::string_view remedy) const;
  // The same content in the same style has the same text, whatever its comments and its place.
  [[nodiscard]] std::string dump() const { return YAML::Dump(node_); }

 private:
  YamlValue(std::shared_ptr<const std::filesystem::path> path, std::string name, const YAML::Node& node)
      : path_(std::move(path)), name_(std::move(name)), node_(node) {}
  [[nodiscard]] ConfigError error(std::string_view problem, std::string_view remedy) const;
  [[nodiscard]] YAML::Node child(std::string_view key) const;
  [[nodiscard]] std::string plain_scalar(std::string_view wanted) const;

  std::shared_ptr<const std::filesystem::path> path_;
  std::string name_;  // as in odometry.sigma_vx_mps; empty for the document
  YAML::Node node_;
};

}  // namespace groma::io
