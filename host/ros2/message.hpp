// Reads messages of ROS 2 (CDR) by the definition of their type: fields in the syntax of .msg files, as
// schemas.hpp and MCAP files (ros2msg) have it.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

namespace groma::ros2 {

struct MessageField {
  enum class Count { kOne, kFixed, kSequence };
  std::string name;
  std::string type;  // a primitive type's name, or "package/Name"
  Count count = Count::kOne;
  std::size_t size = 0;  // of a fixed array
};
using MessageFields = std::vector<MessageField>;

struct MessageValue;
using MessageValues = std::vector<MessageValue>;
// A number, a whole number (also bool), a text (also a long array of bytes), the elements of an array, or the
// fields of a message in the order of `fields`.
struct MessageValue {
  std::variant<double, std::int64_t, std::string, MessageValues> content;
  const MessageFields* fields = nullptr;  // null: no message
};

// A place in a message, such as "header.stamp", "ranges[].distance_m" (of each element) or "covariance[35]".
class FieldPath {
 public:
  struct Step {
    std::string field;
    bool each = false;                 // of all elements
    std::optional<std::size_t> index;  // of one element
  };

  // None: the text is no path.
  [[nodiscard]] static std::optional<FieldPath> parse(std::string_view text);

  [[nodiscard]] const std::vector<Step>& steps() const noexcept { return steps_; }
  // Whether it stands for a value of each element of an array.
  [[nodiscard]] bool is_of_each() const noexcept;

 private:
  std::vector<Step> steps_;
};

class MessageDefinition {
 public:
  // type: such as "nav_msgs/msg/Odometry". text: its fields, then the types that it contains, each after a
  // line of "=" and a line "MSG: package/Name"; types that the text lacks are those of schemas.hpp.
  // Throws std::invalid_argument with the problem.
  MessageDefinition(std::string_view type, std::string_view text);

  // None: the bytes are no such message, are longer than one, or have more than 2^20 elements in arrays.
  [[nodiscard]] std::optional<MessageValue> read(std::string_view cdr) const;

  // What is wrong with a path, such as "has no field x; its fields are y, z"; empty: it exists.
  [[nodiscard]] std::string problem_of(const FieldPath& path) const;
  [[nodiscard]] bool has(std::string_view field) const;

 private:
  void parse(std::string_view type, std::string_view text);
  // The levels of types within the type. open: the types that contain it; depths: those of known types.
  // Throws std::invalid_argument if a type is unknown, contains itself, or has too many levels.
  std::size_t expect_types(const std::string& type, std::set<std::string>& open,
                           std::map<std::string, std::size_t>& depths) const;

  std::map<std::string, MessageFields, std::less<>> types_;
  std::string root_;
};

// The values at the path, one unless it is of each element; empty if an element does not exist.
[[nodiscard]] std::vector<const MessageValue*> values_at(const MessageValue& message, const FieldPath& path);

// The field of this name; null if there is none.
[[nodiscard]] const MessageValue* field_of(const MessageValue& message, std::string_view name);

}  // namespace groma::ros2
