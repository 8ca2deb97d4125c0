#include "host/daemon/json_view.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cmath>
#include <cstddef>
#include <random>
#include <string>
#include <string_view>

#include <nlohmann/json.hpp>

namespace groma::daemon {
namespace {

bool accepts(std::string_view text) {
  return JsonView::parse(text).has_value();
}

TEST(JsonView, FindsMembers) {
  const auto object =
      JsonView::parse(R"( {"a":1.5,"b":{"a":2},"c":"x\"}","d":[1,null,-3e2],"a":-2,"e":null} )");
  ASSERT_TRUE(object);
  EXPECT_TRUE(object->is_object());
  EXPECT_EQ(object->find("a")->number(), -2.0);  // the last one
  EXPECT_EQ(object->find("b")->find("a")->number(), 2.0);
  EXPECT_FALSE(object->find("b")->number());
  EXPECT_EQ(object->find("c")->string(), R"(x\"})");
  EXPECT_FALSE(object->find("a")->string());
  EXPECT_TRUE(object->find("e")->is_null());
  EXPECT_FALSE(object->find("f"));
  EXPECT_FALSE(object->find("c")->find("a"));
  std::array<double, 3> three{};
  ASSERT_TRUE(object->find("d")->numbers(three));
  EXPECT_EQ(three[0], 1.0);
  EXPECT_TRUE(std::isnan(three[1]));
  EXPECT_EQ(three[2], -300.0);
  std::array<double, 2> two{};
  std::array<double, 4> four{};
  EXPECT_FALSE(object->find("d")->numbers(two));
  EXPECT_FALSE(object->find("d")->numbers(four));
  EXPECT_FALSE(object->find("a")->numbers(two));
  EXPECT_FALSE(JsonView::parse("[1,\"2\"]")->numbers(two));
  EXPECT_TRUE(JsonView::parse("{}")->is_object());
  EXPECT_FALSE(JsonView::parse("{}")->find(""));
}

TEST(JsonView, ReadsNumbersAsTheyAreWritten) {
  for (const std::string_view text :
       {"0", "-0.0", "0.1", "1764180750.1234567", "-1e-3", "2E+8", "1.7976931348623157e308", "4.9e-324",
        "0.30000000000000004", "12345678901234567890"}) {
    EXPECT_EQ(JsonView::parse(text)->number(), nlohmann::json::parse(text).get<double>()) << text;
  }
  for (const std::string_view text : {"1e999", "-1e999", "\"1\"", "null", "true", "[1]"}) {
    EXPECT_FALSE(JsonView::parse(text)->number()) << text;
  }
}

TEST(JsonView, BoundsTheDepth) {
  const std::string deepest =
      std::string(JsonView::kMaxDepth, '[') + "1" + std::string(JsonView::kMaxDepth, ']');
  EXPECT_TRUE(accepts(deepest));
  EXPECT_FALSE(accepts("[" + deepest + "]"));
  EXPECT_FALSE(accepts(std::string(100'000, '[')));
  EXPECT_FALSE(accepts(std::string(100'000, '{')));
}

// Random texts of JSON's characters, and valid texts with one character changed, removed or added, against
// another parser.
TEST(JsonView, AcceptsWhatAnotherParserAccepts) {
  constexpr std::string_view kAlphabet = "{}[]\",:\\ \t01-+.eEnulltruefalse/bx";
  constexpr std::string_view kValid =
      R"({"a":[-1.5e+2,0,{}],"b\u00e4\n":{"c":null,"d":[true,false]},"e":"x y","f":0.0E-1,"g":[],"h":""})";
  std::mt19937 random(1);
  const auto below = [&](std::size_t n) { return static_cast<std::size_t>(random()) % n; };
  std::size_t accepted = 0;
  for (int i = 0; i < 200'000; ++i) {
    std::string text;
    if (i % 4 == 0) {
      for (std::size_t n = 1 + below(6); n > 0; --n) text += kAlphabet[below(kAlphabet.size())];
    } else {
      text = kValid;
      const std::size_t at = below(text.size());
      const char c = kAlphabet[below(kAlphabet.size())];
      if (i % 4 == 1) text[at] = c;
      if (i % 4 == 2) text.insert(at, 1, c);
      if (i % 4 == 3) text.erase(at, 1);
    }
    const bool valid = nlohmann::json::accept(text);
    EXPECT_EQ(accepts(text), valid) << text;
    accepted += valid ? 1U : 0U;
  }
  EXPECT_GT(accepted, 10'000U);
}

}  // namespace
}  // namespace groma::daemon
