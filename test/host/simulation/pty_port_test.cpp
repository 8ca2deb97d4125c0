#include "host/simulation/pty_port.hpp"

#include <gtest/gtest.h>

#include <array>
#include <chrono>
#include <numeric>
#include <thread>
#include <vector>

#include "host/link/byte_link.hpp"

namespace groma::simulation {
namespace {

std::vector<std::uint8_t> read_for(link::ByteLink& link, std::size_t wanted) {
  std::vector<std::uint8_t> all;
  std::array<std::uint8_t, 4096> chunk{};
  for (int tries = 0; tries < 2000 && all.size() < wanted; ++tries) {
    const link::ReadResult read = link.read(chunk);
    all.insert(all.end(), chunk.begin(), chunk.begin() + static_cast<std::ptrdiff_t>(read.bytes));
    if (read.bytes == 0) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
  return all;
}

TEST(PtyPort, PassesEveryByteValueBothWays) {
  PtyPort port;
  const link::OpenedLink opened = link::open_link(port.path(), 1'000'000);
  ASSERT_TRUE(opened.link) << opened.error.message;
  std::vector<std::uint8_t> all(256);
  std::iota(all.begin(), all.end(), std::uint8_t{0});
  EXPECT_TRUE(port.listened());
  EXPECT_EQ(port.write(all), all.size());
  EXPECT_EQ(read_for(*opened.link, all.size()), all);

  EXPECT_EQ(opened.link->write(all), all.size());
  std::vector<std::uint8_t> back;
  std::array<std::uint8_t, 512> chunk{};
  for (int tries = 0; tries < 2000 && back.size() < all.size(); ++tries) {
    const std::size_t size = port.read(chunk);
    back.insert(back.end(), chunk.begin(), chunk.begin() + static_cast<std::ptrdiff_t>(size));
    if (size == 0) std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
  EXPECT_EQ(back, all);
}

TEST(PtyPort, BytesWithoutAListenerAreLost) {
  PtyPort port;
  const std::vector<std::uint8_t> early(100, 0x11);
  const std::vector<std::uint8_t> late(50, 0x22);
  EXPECT_FALSE(port.listened());
  EXPECT_EQ(port.write(early), 0U);
  {
    const link::OpenedLink opened = link::open_link(port.path(), 1'000'000);
    ASSERT_TRUE(opened.link);
    EXPECT_EQ(port.write(late), late.size());
    EXPECT_EQ(read_for(*opened.link, late.size()), late);
  }
  EXPECT_FALSE(port.listened()) << "the reader is gone";
  EXPECT_EQ(port.write(early), 0U);
  EXPECT_TRUE(link::open_link(port.path(), 1'000'000).link) << "a reader may reconnect";
}

TEST(PtyPort, AReaderThatSleepsLosesBytesButDoesNotBlock) {
  PtyPort port;
  const link::OpenedLink opened = link::open_link(port.path(), 1'000'000);
  ASSERT_TRUE(opened.link);
  const std::vector<std::uint8_t> much(1 << 20, 0x33);
  EXPECT_LT(port.write(much), much.size());
}

}  // namespace
}  // namespace groma::simulation
