#include "host/ros2/message.hpp"

#include <fmt/format.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>

#include <initializer_list>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

#include "host/ros2/cdr_writer.hpp"
#include "host/ros2/schemas.hpp"
#include "test/support/random.hpp"

namespace groma::ros2 {
namespace {

// Every kind of field, a contained type, a constant, a default and comments.
constexpr const char* kDefinition =
    "# a comment\n"
    "uint8 KIND=3  # a constant\n"
    "string NAME = \"a=b\"\n"
    "std_msgs/Header header\n"
    "uint8 kind 3\n"
    "int64 time_ns\n"
    "Anchor[] anchors\n"
    "string<=10[<=5] words\n"
    "uint8[3] bytes\n"
    "float32[] distances\n"
    "bool done\n"
    "================================================================================\n"
    "MSG: pkg/Anchor\n"
    "uint16 id\n"
    "float64 distance\n";

std::string message(const std::vector<double>& distances) {
  CdrWriter out;
  out.put(std::int32_t{5}).put(std::uint32_t{250000000}).put("map");
  out.put(std::uint8_t{4}).put(std::int64_t{-1234567890123456789});
  out.length(distances.size());
  for (std::size_t i = 0; i < distances.size(); ++i)
    out.put(static_cast<std::uint16_t>(10 + i)).put(distances[i]);
  out.length(2).put("one").put("");
  out.put(std::uint8_t{1}).put(std::uint8_t{2}).put(std::uint8_t{255});
  out.length(2).put(1.5F).put(-2.5F);
  out.put(true);
  return out.message();
}

std::vector<double> numbers_at(const MessageValue& message, const char* path) {
  std::vector<double> out;
  for (const MessageValue* value : values_at(message, *FieldPath::parse(path))) {
    if (const auto* whole = std::get_if<std::int64_t>(&value->content)) {
      out.push_back(static_cast<double>(*whole));
    } else {
      out.push_back(std::get<double>(value->content));
    }
  }
  return out;
}

TEST(Ros2Message, ReadsEachKindOfField) {
  const MessageDefinition definition("pkg/msg/Ranges", kDefinition);
  const std::optional<MessageValue> value = definition.read(message({3.25, 4.5, 5.75}));
  ASSERT_TRUE(value);
  using Numbers = std::vector<double>;
  EXPECT_EQ(numbers_at(*value, "header.stamp.nanosec"), Numbers{250000000});
  EXPECT_EQ(numbers_at(*value, "kind"), Numbers{4});
  EXPECT_EQ(std::get<std::int64_t>(field_of(*value, "time_ns")->content), -1234567890123456789);
  EXPECT_EQ(numbers_at(*value, "anchors[].id"), (Numbers{10, 11, 12}));
  EXPECT_EQ(numbers_at(*value, "anchors[].distance"), (Numbers{3.25, 4.5, 5.75}));
  EXPECT_EQ(numbers_at(*value, "anchors[1].distance"), Numbers{4.5});
  EXPECT_EQ(numbers_at(*value, "anchors[3].distance"), Numbers{}) << "there is no such element";
  EXPECT_EQ(numbers_at(*value, "bytes[]"), (Numbers{1, 2, 255}));
  EXPECT_EQ(numbers_at(*value, "distances[]"), (Numbers{1.5, -2.5}));
  EXPECT_EQ(numbers_at(*value, "done"), Numbers{1});
  const auto words = values_at(*value, *FieldPath::parse("words[]"));
  ASSERT_EQ(words.size(), 2U);
  EXPECT_EQ(std::get<std::string>(words[0]->content), "one");
}

TEST(Ros2Message, ReadsBigEndian) {
  const MessageDefinition definition("pkg/msg/One", "uint16 a\nfloat64 b\n");
  const std::string bytes("\0\0\0\0\x01\x02\0\0\0\0\0\0\x3F\xF8\0\0\0\0\0\0", 20);
  const std::optional<MessageValue> value = definition.read(bytes);
  ASSERT_TRUE(value);
  EXPECT_EQ(numbers_at(*value, "a"), std::vector<double>{258});
  EXPECT_EQ(numbers_at(*value, "b"), std::vector<double>{1.5});
}

TEST(Ros2Message, SaysWhatIsWrongWithAPath) {
  const MessageDefinition definition("pkg/msg/Ranges", kDefinition);
  const auto problem = [&](const char* path) { return definition.problem_of(*FieldPath::parse(path)); };
  EXPECT_EQ(problem("anchors[].distance"), "");
  EXPECT_EQ(problem("header.stamp"), "");
  EXPECT_EQ(problem("anchors[].range"), "has no field range; its fields are id, distance");
  EXPECT_NE(problem("anchors.id"), "");
  EXPECT_NE(problem("kind[]"), "");
  EXPECT_NE(problem("kind.value"), "");
  for (const char* text : {"", "a..b", "a[", "a[x]", ".a"}) EXPECT_FALSE(FieldPath::parse(text)) << text;
}

TEST(Ros2Message, RejectsDefinitionsThatCannotBeRead) {
  const auto define = [](const char* text) { MessageDefinition("pkg/msg/A", text); };
  EXPECT_THROW(define("Unknown field\n"), std::invalid_argument);
  EXPECT_THROW(define("uint8\n"), std::invalid_argument);
  EXPECT_THROW(define("uint8[x] a\n"), std::invalid_argument);
  EXPECT_THROW(define("A again\n"), std::invalid_argument);
  EXPECT_THROW(define("A[0] none\n"), std::invalid_argument) << "elements without bytes have no end";
  EXPECT_NO_THROW(define("")) << "an empty message";
  // Ten of each next level: 10^19 types, if each were looked at.
  std::string wide;
  for (int level = 0; level < 20; ++level) {
    if (level > 0) wide += fmt::format("==========\nMSG: pkg/L{}\n", level);
    for (int i = 0; i < 10; ++i)
      wide += level < 19 ? fmt::format("pkg/L{} a{}\n", level + 1, i) : fmt::format("uint8 a{}\n", i);
  }
  EXPECT_NO_THROW(define(wide.c_str()));
  std::string deep;
  for (int level = 0; level < 100; ++level)
    deep += fmt::format("pkg/L{} a\n==========\nMSG: pkg/L{}\n", level, level);
  EXPECT_THROW(define((deep + "uint8 a\n").c_str()), std::invalid_argument);
}

TEST(Ros2Message, IsReadToItsEnd) {
  const MessageDefinition definition("pkg/msg/One", "uint8 a\n");
  const std::string bytes("\0\1\0\0\x05", 5);
  EXPECT_TRUE(definition.read(bytes));
  EXPECT_TRUE(definition.read(bytes + std::string(3, '\0'))) << "filled to 4 bytes";
  EXPECT_FALSE(definition.read(bytes + std::string(4, '\0'))) << "the message of another type";
}

std::string many(std::uint32_t count) {
  CdrWriter out;
  out.length(count);
  return out.message() + std::string(2 * std::size_t{count}, '\0');
}

TEST(Ros2Message, HasAsManyElementsAsItsBound) {
  EXPECT_TRUE(MessageDefinition("pkg/msg/Many", "int16[] a\n").read(many(1 << 20)));
}

TEST(Ros2Message, HasNoMoreElementsThanItsBound) {
  const MessageDefinition definition("pkg/msg/Many", "int16[] a\n");
  EXPECT_FALSE(definition.read(many((1 << 20) + 1)));
  CdrWriter lie;
  lie.length(0xFFFFFFFF);
  EXPECT_FALSE(definition.read(lie.message()));
  EXPECT_FALSE(MessageDefinition("pkg/msg/Text", "string a\n").read(lie.message()));
  EXPECT_FALSE(MessageDefinition("pkg/msg/Text", "wstring a\n").read(lie.message()));
}

TEST(Ros2Message, ReadsEachTypeThatConvertWrites) {
  for (const char* type : {"nav_msgs/msg/Odometry", "sensor_msgs/msg/Imu", "groma_msgs/msg/Ranges",
                           "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage",
                           "visualization_msgs/msg/MarkerArray", "diagnostic_msgs/msg/DiagnosticArray"})
    EXPECT_NO_THROW(MessageDefinition(type, schema_of(type))) << type;
}

TEST(Ros2Message, SurvivesRandomBytesAndDefinitions) {
  const MessageDefinition definition("pkg/msg/Ranges", kDefinition);
  const std::string good = message({1.0, 2.0, 3.0});
  test::Random random(7);
  std::size_t read = 0;
  for (int i = 0; i < 20000; ++i) {
    std::string bytes = good;
    bytes[4 + random.next() % (bytes.size() - 4)] = static_cast<char>(random.next());
    bytes.resize(random.next() % (bytes.size() + 1));
    if (definition.read(bytes)) ++read;
  }
  EXPECT_LT(read, 2000U) << "a cut message is no message";
  for (int i = 0; i < 2000; ++i) {
    std::string text = kDefinition;
    for (int change = 0; change < 5; ++change)
      text[random.next() % text.size()] = static_cast<char>(random.next() % 96 + 32);
    try {
      static_cast<void>(MessageDefinition("pkg/msg/Ranges", text).read(good));
    } catch (const std::invalid_argument&) {
    }
  }
}

TEST(CdrWriter, AlignsFromTheEndOfItsHeader) {
  const auto bytes = [](std::initializer_list<int> values) {
    std::string all;
    for (const int value : values) all += static_cast<char>(value);
    return all;
  };
  CdrWriter out;
  out.put(true).put(std::uint16_t{0x0201}).put("a").put(1.0);
  EXPECT_EQ(out.message(),
            bytes({0, 1, 0, 0,                                 // little-endian CDR
                   1, 0, 1, 2,                                 // bool, padding, uint16
                   2, 0, 0, 0, 'a', 0, 0,    0,   0, 0, 0, 0,  // string with its zero; padding to 16
                   0, 0, 0, 0, 0,   0, 0xF0, 0x3F}));
}

TEST(Ros2Schema, HasTheDefinitionsOfAllTypesThatItContains) {
  const std::string schema = schema_of("nav_msgs/msg/Odometry");
  EXPECT_THAT(schema, testing::StartsWith("std_msgs/Header header\nstring child_frame_id\n"));
  const std::string line(80, '=');
  for (const char* type : {"std_msgs/Header", "builtin_interfaces/Time", "geometry_msgs/Quaternion"}) {
    const std::string head = line + "\nMSG: " + type + "\n";
    EXPECT_THAT(schema, testing::HasSubstr(head));
    EXPECT_EQ(schema.find(head), schema.rfind(head)) << type << " once";
  }
  EXPECT_THAT(schema, testing::Not(testing::HasSubstr("Marker")));
}

}  // namespace
}  // namespace groma::ros2
