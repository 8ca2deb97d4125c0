#include "host/daemon/event_loop.hpp"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <cstddef>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "host/io/descriptor.hpp"
#include "test/support/allocations.hpp"

namespace groma::daemon {
namespace {

using ::testing::ElementsAre;

struct SocketPair {
  SocketPair() {
    int ends[2];
    if (::socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0, ends) != 0) {
      throw std::runtime_error("socketpair");
    }
    here = io::Descriptor(ends[0]);
    there = io::Descriptor(ends[1]);
  }
  void send(const std::string& text) const {
    ASSERT_EQ(::write(there.get(), text.data(), text.size()), static_cast<ssize_t>(text.size()));
  }
  std::string receive(std::size_t most = 100) const {
    std::string text(most, '\0');
    const ssize_t n = ::read(here.get(), text.data(), text.size());
    text.resize(n > 0 ? static_cast<std::size_t>(n) : 0);
    return text;
  }

  io::Descriptor here;
  io::Descriptor there;
};

TEST(EventLoop, ServesWhatIsReadable) {
  EventLoop loop;
  const SocketPair first;
  const SocketPair second;
  std::vector<std::string> received;
  const EventLoop::Watch watches[] = {
      {loop, first.here.get(), [&] { received.push_back("first " + first.receive(2)); }},
      {loop, second.here.get(), [&] { received.push_back("second " + second.receive(2)); }},
  };
  loop.poll();
  EXPECT_TRUE(received.empty());
  // What is left is read later, and does not keep the other one waiting.
  first.send("abcd");
  second.send("ef");
  loop.poll();
  ASSERT_EQ(received.size(), 3U);
  EXPECT_THAT(received, ::testing::UnorderedElementsAre("first ab", "first cd", "second ef"));
  EXPECT_EQ(received.back(), "first cd");
}

TEST(EventLoop, AnActionMayDestroyItsWatch) {
  EventLoop loop;
  SocketPair pair;
  int calls = 0;
  std::optional<EventLoop::Watch> watch;
  watch.emplace(loop, pair.here.get(), [&] {
    ++calls;
    watch.reset();
    pair.here.close();
  });
  pair.send("x");
  loop.poll();
  loop.poll();
  EXPECT_EQ(calls, 1);
  // The next descriptor has the number of the closed one.
  SocketPair next;
  watch.emplace(loop, next.here.get(), [&] { calls += static_cast<int>(next.receive().size()); });
  next.send("yz");
  loop.poll();
  EXPECT_EQ(calls, 3);
}

TEST(EventLoop, ReportsOnceThatADescriptorIsWritable) {
  EventLoop loop;
  const SocketPair pair;
  int calls = 0;
  EventLoop::Watch watch(
      loop, pair.here.get(), [] {}, [&] { ++calls; });
  const std::string block(100'000, 'x');
  while (::write(pair.here.get(), block.data(), block.size()) > 0) {
  }
  watch.await_writable();
  watch.await_writable();
  loop.poll();
  EXPECT_EQ(calls, 0);
  std::string sink(1'000'000, '\0');
  while (::read(pair.there.get(), sink.data(), sink.size()) > 0) {
  }
  loop.poll();
  loop.poll();
  EXPECT_EQ(calls, 1);
}

TEST(EventLoop, TimersFollowTheInjectedClock) {
  double now_s = 100.0;
  EventLoop loop([&] { return now_s; });
  std::vector<double> often_s;
  std::vector<double> each_s;
  std::optional<EventLoop::Timer> often;
  const EventLoop::Timer each(loop, 0.0, [&] {
    each_s.push_back(now_s);
    if (now_s > 101.0) often.reset();
  });
  often.emplace(loop, 0.5, [&] { often_s.push_back(now_s); });
  for (int i = 0; i < 8; ++i) {
    loop.poll();
    loop.poll();  // the time stands still
    now_s += 0.25;
  }
  EXPECT_THAT(often_s, ElementsAre(100.0, 100.5, 101.0));
  EXPECT_EQ(each_s.size(), 16U);
}

TEST(EventLoop, RunsUntilItIsStoppedAndPassesExceptionsOn) {
  EventLoop loop;
  int ticks = 0;
  const EventLoop::Timer timer(loop, 0.0, [&] {
    if (++ticks == 3) loop.stop();
    if (ticks == 5) throw std::runtime_error("of an action");
  });
  loop.run();
  EXPECT_EQ(ticks, 3);
  EXPECT_THROW(loop.run(), std::runtime_error);
  EXPECT_EQ(ticks, 5);
}

TEST(EventLoop, ServesWithoutTheHeap) {
  EventLoop loop;
  const SocketPair pair;
  std::size_t before = 0;
  std::size_t after = 0;
  int calls = 0;
  std::array<char, 8> bytes{};
  const EventLoop::Timer timer(loop, 0.0, [&] { static_cast<void>(!::write(pair.there.get(), "x", 1)); });
  const EventLoop::Watch watch(loop, pair.here.get(), [&] {
    static_cast<void>(!::read(pair.here.get(), bytes.data(), bytes.size()));
    if (++calls == 3) before = groma::test::allocations();
    if (calls < 20) return;
    after = groma::test::allocations();
    loop.stop();
  });
  loop.run();
  EXPECT_GT(before, 0U);
  EXPECT_EQ(after, before);
}

}  // namespace
}  // namespace groma::daemon
