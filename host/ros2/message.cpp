#include "host/ros2/message.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <bit>
#include <charconv>
#include <cstring>
#include <span>
#include <stdexcept>
#include <type_traits>
#include <utility>

#include "host/ros2/schemas.hpp"

namespace groma::ros2 {

namespace {

// By hand: deeper than any message.
constexpr std::size_t kMaxDepth = 20;
// By hand: more than any message that has ranges or poses. An element takes up to 50 times its bytes here.
constexpr std::size_t kMaxElements = 1 << 20;
// Some middlewares fill a message to a multiple of 4 bytes.
constexpr std::size_t kMostPadding = 3;
// Longer arrays of bytes are images and the like: one text.
constexpr std::size_t kMaxByteElements = 1024;

constexpr std::array<std::string_view, 16> kPrimitives{
    "bool",   "byte",  "char",   "int8",    "uint8",   "int16",  "uint16",  "int32",
    "uint32", "int64", "uint64", "float32", "float64", "string", "wstring", ""};

bool is_primitive(std::string_view type) {
  return !type.empty() && std::find(kPrimitives.begin(), kPrimitives.end(), type) != kPrimitives.end();
}
bool is_byte(std::string_view type) {
  return type == "uint8" || type == "byte" || type == "char" || type == "int8" || type == "bool";
}

std::string_view trimmed(std::string_view text) {
  const std::size_t first = text.find_first_not_of(" \t\r");
  if (first == std::string_view::npos) return {};
  return text.substr(first, text.find_last_not_of(" \t\r") + 1 - first);
}

std::string_view take_line(std::string_view& text) {
  const std::size_t end = text.find('\n');
  const std::string_view line = text.substr(0, end);
  text.remove_prefix(end == std::string_view::npos ? text.size() : end + 1);
  return trimmed(line);
}

// "package/msg/Name" as "package/Name".
std::string short_name(std::string_view type) {
  std::string name(type);
  if (const std::size_t at = name.find("/msg/"); at != std::string::npos) name.replace(at, 5, "/");
  return name;
}

std::optional<std::size_t> whole_number(std::string_view text) {
  std::size_t value = 0;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (text.empty() || error != std::errc() || end != text.data() + text.size()) return std::nullopt;
  return value;
}

// A line of a definition as a field; none if it is empty or a constant.
std::optional<MessageField> parse_field(std::string_view line, std::string_view package) {
  line = trimmed(line.substr(0, line.find('#')));
  if (line.empty()) return std::nullopt;
  const std::size_t type_end = line.find_first_of(" \t");
  std::string_view type = line.substr(0, type_end);
  const std::string_view rest = type_end == std::string_view::npos ? "" : trimmed(line.substr(type_end));
  const std::size_t name_end = rest.find_first_of(" \t=");
  const std::string_view name = rest.substr(0, name_end);
  const std::string_view value = name_end == std::string_view::npos ? "" : trimmed(rest.substr(name_end));
  if (name.empty()) throw std::invalid_argument(fmt::format("'{}' is no field", line));
  if (value.starts_with('=')) return std::nullopt;

  MessageField field{.name = std::string(name), .type = {}};
  if (const std::size_t open = type.find('['); open != std::string_view::npos) {
    const std::string_view bounds = type.substr(open + 1, type.size() - open - 2);
    if (!type.ends_with(']')) throw std::invalid_argument(fmt::format("'{}' is no field", line));
    field.count = MessageField::Count::kSequence;
    if (!bounds.empty() && !bounds.starts_with("<=")) {
      const std::optional<std::size_t> size = whole_number(bounds);
      if (!size || *size == 0) throw std::invalid_argument(fmt::format("'{}' is no field", line));
      field.count = MessageField::Count::kFixed;
      field.size = *size;
    }
    type = type.substr(0, open);
  }
  type = type.substr(0, type.find("<="));  // of a bounded string
  field.type = short_name(type);
  if (type == "Header") {
    field.type = "std_msgs/Header";
  } else if (!is_primitive(type) && type.find('/') == std::string_view::npos) {
    field.type = fmt::format("{}/{}", package, type);
  }
  return field;
}

std::string names_of(const MessageFields& fields) {
  std::string names;
  for (const MessageField& field : fields) names += (names.empty() ? "" : ", ") + field.name;
  return names;
}

// CDR, of either byte order.
class CdrReader {
 public:
  // False: the bytes are no CDR.
  bool open(std::string_view bytes) {
    if (bytes.size() < 4 || bytes[0] != 0 || (bytes[1] != 0 && bytes[1] != 1)) return false;
    swaps_ = (bytes[1] == 1) != (std::endian::native == std::endian::little);
    body_ = bytes.substr(4);
    return true;
  }

  template <typename Number>
  Number number() {
    at_ = (at_ + sizeof(Number) - 1) / sizeof(Number) * sizeof(Number);
    std::array<char, sizeof(Number)> bytes{};
    const std::string_view from = take(sizeof(Number));
    if (from.size() == bytes.size()) std::memcpy(bytes.data(), from.data(), bytes.size());
    if (swaps_) std::reverse(bytes.begin(), bytes.end());
    return std::bit_cast<Number>(bytes);
  }
  std::string_view take(std::size_t count) {
    if (at_ > body_.size() || count > body_.size() - at_) {
      ok_ = false;
      at_ = body_.size();
      return {};
    }
    at_ += count;
    return body_.substr(at_ - count, count);
  }
  // A count of elements, each of which has a byte or more.
  std::size_t length() {
    const auto count = number<std::uint32_t>();
    if (at_ > body_.size() || count > body_.size() - at_) ok_ = false;
    return ok_ ? count : 0;
  }
  // Call it for each element of an array that is kept: a message may have only so many.
  void count_element() {
    if (++elements_ > kMaxElements) ok_ = false;
  }
  [[nodiscard]] bool ok() const { return ok_; }
  [[nodiscard]] bool is_at_end() const { return body_.size() - at_ <= kMostPadding; }

 private:
  std::string_view body_;
  std::size_t at_ = 0;
  std::size_t elements_ = 0;
  bool swaps_ = false;
  bool ok_ = true;
};

template <typename Number>
MessageValue value_of(CdrReader& cdr) {
  if constexpr (std::is_floating_point_v<Number>) {
    return {static_cast<double>(cdr.number<Number>())};
  } else {
    return {static_cast<std::int64_t>(cdr.number<Number>())};
  }
}

MessageValue read_primitive(CdrReader& cdr, std::string_view type) {
  if (type == "float64") return value_of<double>(cdr);
  if (type == "float32") return value_of<float>(cdr);
  if (type == "int8") return value_of<std::int8_t>(cdr);
  if (is_byte(type)) return value_of<std::uint8_t>(cdr);
  if (type == "int16") return value_of<std::int16_t>(cdr);
  if (type == "uint16") return value_of<std::uint16_t>(cdr);
  if (type == "int32") return value_of<std::int32_t>(cdr);
  if (type == "uint32") return value_of<std::uint32_t>(cdr);
  if (type == "int64") return value_of<std::int64_t>(cdr);
  if (type == "uint64") return value_of<std::uint64_t>(cdr);
  if (type == "wstring") return {std::string(cdr.take(2 * cdr.length()))};
  std::string_view text = cdr.take(cdr.length());
  if (text.ends_with('\0')) text.remove_suffix(1);
  return {std::string(text)};
}

using Types = std::map<std::string, MessageFields, std::less<>>;

MessageValue read_fields(CdrReader& cdr, const Types& types, const MessageFields& fields);

MessageValue read_one(CdrReader& cdr, const Types& types, const std::string& type) {
  if (is_primitive(type)) return read_primitive(cdr, type);
  return read_fields(cdr, types, types.find(type)->second);
}

MessageValue read_field(CdrReader& cdr, const Types& types, const MessageField& field) {
  if (field.count == MessageField::Count::kOne) return read_one(cdr, types, field.type);
  const std::size_t count = field.count == MessageField::Count::kFixed ? field.size : cdr.length();
  if (is_byte(field.type) && count > kMaxByteElements) return {std::string(cdr.take(count))};
  MessageValues elements;
  for (std::size_t i = 0; i < count && cdr.ok(); ++i) {
    elements.push_back(read_one(cdr, types, field.type));
    cdr.count_element();
  }
  return {std::move(elements)};
}

MessageValue read_fields(CdrReader& cdr, const Types& types, const MessageFields& fields) {
  MessageValues values;
  values.reserve(fields.size());
  for (const MessageField& field : fields) {
    if (!cdr.ok()) break;
    values.push_back(read_field(cdr, types, field));
  }
  if (fields.empty()) cdr.take(1);  // ROS 2 gives an empty message one byte
  return {std::move(values), &fields};
}

}  // namespace

std::optional<FieldPath> FieldPath::parse(std::string_view text) {
  FieldPath path;
  for (bool more = true; more;) {
    const std::size_t dot = text.find('.');
    std::string_view part = text.substr(0, dot);
    more = dot != std::string_view::npos;
    if (more) text.remove_prefix(dot + 1);
    Step step;
    if (const std::size_t open = part.find('['); open != std::string_view::npos) {
      if (!part.ends_with(']')) return std::nullopt;
      const std::string_view inside = part.substr(open + 1, part.size() - open - 2);
      step.each = inside.empty();
      if (!step.each) {
        step.index = whole_number(inside);
        if (!step.index) return std::nullopt;
      }
      part = part.substr(0, open);
    }
    if (part.empty()) return std::nullopt;
    step.field = part;
    path.steps_.push_back(std::move(step));
  }
  return path;
}

bool FieldPath::is_of_each() const noexcept {
  return std::any_of(steps_.begin(), steps_.end(), [](const Step& step) { return step.each; });
}

MessageDefinition::MessageDefinition(std::string_view type, std::string_view text) : root_(short_name(type)) {
  parse(root_, text);
  std::set<std::string> open;
  std::map<std::string, std::size_t> depths;
  expect_types(root_, open, depths);
}

void MessageDefinition::parse(std::string_view type, std::string_view text) {
  std::string name(type);
  MessageFields fields;
  const auto finish = [&] { types_.try_emplace(std::move(name), std::exchange(fields, {})); };
  while (!text.empty()) {
    const std::string_view line = take_line(text);
    if (line.size() > 8 && line.find_first_not_of('=') == std::string_view::npos) continue;
    if (line.starts_with("MSG:")) {
      finish();
      name = short_name(trimmed(line.substr(4)));
      continue;
    }
    const std::string_view package = std::string_view(name).substr(0, name.find('/'));
    std::optional<MessageField> field = parse_field(line, package);
    if (!field) continue;
    if (!is_primitive(field->type) && !types_.contains(field->type)) {
      const std::string known = schema_of(field->type);
      // The text's own definition, further down, replaces it.
      if (!known.empty() && text.find(fmt::format("MSG: {}", field->type)) == std::string_view::npos)
        parse(field->type, known);
    }
    fields.push_back(*std::move(field));
  }
  finish();
}

// Each type is visited once, because types that contain many of one another would take for ever.
std::size_t MessageDefinition::expect_types(const std::string& type, std::set<std::string>& open,
                                            std::map<std::string, std::size_t>& depths) const {
  if (const auto known = depths.find(type); known != depths.end()) return known->second;
  if (!open.insert(type).second)
    throw std::invalid_argument(fmt::format("the type {} contains itself", type));
  std::size_t depth = 0;
  for (const MessageField& field : types_.find(type)->second) {
    if (is_primitive(field.type)) continue;
    if (!types_.contains(field.type))
      throw std::invalid_argument(fmt::format("the type {} of {} is not defined", field.type, field.name));
    if (open.size() > kMaxDepth) throw std::invalid_argument(fmt::format("{} has too many levels", root_));
    depth = std::max(depth, 1 + expect_types(field.type, open, depths));
  }
  open.erase(type);
  if (depth > kMaxDepth) throw std::invalid_argument(fmt::format("{} has too many levels", root_));
  depths[type] = depth;
  return depth;
}

std::optional<MessageValue> MessageDefinition::read(std::string_view cdr) const {
  CdrReader reader;
  if (!reader.open(cdr)) return std::nullopt;
  MessageValue value = read_fields(reader, types_, types_.find(root_)->second);
  if (!reader.ok() || !reader.is_at_end()) return std::nullopt;
  return value;
}

std::string MessageDefinition::problem_of(const FieldPath& path) const {
  const MessageFields* fields = &types_.find(root_)->second;
  for (const FieldPath::Step& step : path.steps()) {
    if (fields == nullptr) return fmt::format("has no field {}: what is before it is no message", step.field);
    const auto field = std::find_if(fields->begin(), fields->end(),
                                    [&](const MessageField& of) { return of.name == step.field; });
    if (field == fields->end())
      return fmt::format("has no field {}; its fields are {}", step.field, names_of(*fields));
    const bool is_array = field->count != MessageField::Count::kOne;
    if (is_array != (step.each || step.index.has_value()))
      return fmt::format("has {} as {}", step.field,
                         is_array ? "an array: write it with [] or the index of an element"
                                  : "no array: write it without []");
    fields = is_primitive(field->type) ? nullptr : &types_.find(field->type)->second;
  }
  return {};
}

bool MessageDefinition::has(std::string_view field) const {
  const MessageFields& fields = types_.find(root_)->second;
  return std::any_of(fields.begin(), fields.end(), [&](const MessageField& of) { return of.name == field; });
}

const MessageValue* field_of(const MessageValue& message, std::string_view name) {
  const auto* values = std::get_if<MessageValues>(&message.content);
  if (message.fields == nullptr || values == nullptr) return nullptr;
  for (std::size_t i = 0; i < values->size(); ++i)
    if ((*message.fields)[i].name == name) return &(*values)[i];
  return nullptr;
}

namespace {

void collect(const MessageValue& message, std::span<const FieldPath::Step> steps,
             std::vector<const MessageValue*>& out) {
  if (steps.empty()) {
    out.push_back(&message);
    return;
  }
  const FieldPath::Step& step = steps.front();
  const MessageValue* field = field_of(message, step.field);
  if (field == nullptr) return;
  if (!step.each && !step.index) return collect(*field, steps.subspan(1), out);
  const auto* elements = std::get_if<MessageValues>(&field->content);
  if (elements == nullptr) return;
  for (std::size_t i = 0; i < elements->size(); ++i)
    if (step.each || *step.index == i) collect((*elements)[i], steps.subspan(1), out);
}

}  // namespace

std::vector<const MessageValue*> values_at(const MessageValue& message, const FieldPath& path) {
  std::vector<const MessageValue*> out;
  collect(message, path.steps(), out);
  return out;
}

}  // namespace groma::ros2
