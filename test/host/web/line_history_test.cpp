#include "host/web/line_history.hpp"

#include <gtest/gtest.h>

#include <deque>
#include <random>
#include <string>

#include "test/support/allocations.hpp"

namespace groma::web {
namespace {

std::deque<std::string> all_of(const LineHistory& history) {
  std::deque<std::string> out;
  for (std::uint64_t i = history.begin(); i < history.end(); ++i) out.emplace_back(history.at(i));
  return out;
}

TEST(LineHistory, KeepsWhatFitsItsMemory) {
  LineHistory history(10, 100, 1000.0);
  EXPECT_TRUE(all_of(history).empty());
  history.push("abc", 0.0);
  history.push("defg", 0.0);
  EXPECT_EQ(all_of(history), (std::deque<std::string>{"abc", "defg"}));
  history.push("hijk", 0.0);  // where "abc" and a part of "defg" were
  EXPECT_EQ(all_of(history), (std::deque<std::string>{"hijk"}));
  history.push("0123456789", 0.0);
  EXPECT_EQ(all_of(history), (std::deque<std::string>{"0123456789"}));
  history.push("0123456789x", 0.0);  // longer than all the memory
  history.push("", 0.0);
  EXPECT_EQ(all_of(history), (std::deque<std::string>{"0123456789"}));
}

TEST(LineHistory, KeepsNothingOld) {
  LineHistory history(1000, 100, 10.0);
  for (int i = 0; i <= 20; ++i) history.push(std::to_string(i), i);
  EXPECT_EQ(all_of(history).front(), "10");
  EXPECT_EQ(all_of(history).back(), "20");
}

TEST(LineHistory, KeepsAsManyAsItIsFor) {
  LineHistory history(1000, 3, 10.0);
  for (int i = 0; i < 20; ++i) history.push(std::to_string(i), 0.0);
  EXPECT_EQ(all_of(history), (std::deque<std::string>{"17", "18", "19"}));
  EXPECT_EQ(history.begin(), 17U);
}

// What it has is always the end of all that was pushed, whole, and at least half of its memory is used.
TEST(LineHistory, HasTheEndOfTheStream) {
  std::mt19937 random(1);  // NOLINT(cert-msc51-cpp): the same texts each time
  std::deque<std::string> pushed;
  LineHistory history(1000, 200, 1e9);
  for (int i = 0; i < 20'000; ++i) {
    pushed.emplace_back(1 + random() % 100, static_cast<char>('a' + i % 26));
    history.push(pushed.back(), 0.0);
    const std::deque<std::string> kept = all_of(history);
    ASSERT_FALSE(kept.empty());
    std::size_t bytes = 0;
    for (const std::string& text : kept) bytes += text.size();
    ASSERT_LE(bytes, 1000U);
    if (pushed.size() > 300) {
      ASSERT_GT(bytes, 500U);
      pushed.pop_front();
    }
    const std::deque<std::string> end(pushed.end() - static_cast<std::ptrdiff_t>(kept.size()), pushed.end());
    ASSERT_EQ(kept, end);
  }
}

TEST(LineHistory, NeedsNoHeap) {
  LineHistory history(1000, 20, 10.0);
  const std::string text(90, 'x');
  const std::size_t before = test::allocations();
  for (int i = 0; i < 1000; ++i) history.push(text, 0.1 * i);
  EXPECT_EQ(test::allocations(), before);
}

}  // namespace
}  // namespace groma::web
