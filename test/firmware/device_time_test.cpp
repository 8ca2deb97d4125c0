#include "firmware/core/ranging/device_time.hpp"

#include <gtest/gtest.h>

#include <concepts>
#include <random>
#include <type_traits>

namespace groma::ranging {
namespace {

constexpr std::int64_t kWrap = std::int64_t{1} << 40;

template <class A, class B>
concept Addable = requires(A a, B b) {
  a + b;
};

TEST(Ticks, AreNotNumbersAndNotInstants) {
  static_assert(!std::is_convertible_v<std::int64_t, Ticks>);
  static_assert(!std::is_convertible_v<Ticks, std::int64_t>);
  static_assert(!std::is_convertible_v<std::uint64_t, DeviceTime>);
  static_assert(!std::is_constructible_v<ClockTime, DeviceTime>);
  static_assert(!Addable<Ticks, std::int64_t>);
  static_assert(!Addable<DeviceTime, DeviceTime>);
  static_assert(!Addable<ClockTime, ClockTime>);
  static_assert(!Addable<DeviceTime, std::int64_t>);
  SUCCEED();
}

TEST(Ticks, ConvertToMicrosecondsAndBack) {
  EXPECT_EQ(Ticks::from_us(1'000'000).count(), Ticks::kPerSecond);
  EXPECT_EQ(Ticks::from_us(1).count(), 63'898);  // 63897.6
  EXPECT_EQ(Ticks::from_us(-1).count(), -63'898);
  for (const std::int64_t us : {0LL, 1LL, 7LL, 999'999LL, 17'207'401LL, 9'000'000'000'000LL}) {
    EXPECT_NEAR(static_cast<double>(Ticks::from_us(us).to_us()), static_cast<double>(us), 1.0) << us;
  }
  EXPECT_EQ(Ticks(638'976).to_us(), 10);
  EXPECT_EQ(Ticks(638'975).to_us(), 9);
  EXPECT_EQ(Ticks(-1).to_us(), -1);
  EXPECT_EQ(Ticks(-638'976).to_us(), -10);
  EXPECT_EQ(Ticks(-638'977).to_us(), -11);
}

TEST(DeviceTime, DifferencesTakeTheShorterWayAroundTheWrap) {
  const DeviceTime before(static_cast<std::uint64_t>(kWrap - 10));
  const DeviceTime after(5);
  EXPECT_EQ((after - before).count(), 15);
  EXPECT_EQ((before - after).count(), -15);
  EXPECT_EQ((before + Ticks(15)).count(), 5U);
  EXPECT_EQ((after - Ticks(15)).count(), before.count());
  EXPECT_EQ((DeviceTime(static_cast<std::uint64_t>(kWrap / 2)) - DeviceTime(0)).count(), -kWrap / 2);
  EXPECT_EQ((DeviceTime(static_cast<std::uint64_t>(kWrap / 2 - 1)) - DeviceTime(0)).count(), kWrap / 2 - 1);
}

TEST(Unwrapper, FollowsManyWrapsAndToleratesTimestampsOutOfOrder) {
  std::mt19937_64 random(3);
  Unwrapper clock;
  std::int64_t truth = 0;
  for (int i = 0; i < 2000; ++i) {
    truth += static_cast<std::int64_t>(random() % static_cast<std::uint64_t>(kWrap * 45 / 100));
    EXPECT_EQ(clock.unwrap(DeviceTime(static_cast<std::uint64_t>(truth))).count(), truth);
    const std::int64_t earlier = truth - static_cast<std::int64_t>(random() % 1'000'000);
    EXPECT_EQ(clock.unwrap(DeviceTime(static_cast<std::uint64_t>(earlier))).count(), earlier);
    EXPECT_EQ(clock.latest().count(), truth);
    EXPECT_EQ(clock.wrap(ClockTime(truth)), DeviceTime(static_cast<std::uint64_t>(truth)));
  }
}

TEST(Unwrapper, ARestartedCounterContinuesWithoutAStepBackAndOnTheSameGrid) {
  Unwrapper clock;
  const ClockTime last = clock.unwrap(DeviceTime(123'456'789'012));
  clock.restart(DeviceTime(777), Ticks(1'000'000));
  EXPECT_GE(clock.latest(), last + Ticks(1'000'000));
  const ClockTime next = clock.unwrap(DeviceTime(777 + 5'000));
  EXPECT_NEAR(static_cast<double>((next - last).count()), 1'005'000.0, 512.0);
  EXPECT_EQ(next.count() & 0x1FF, (777 + 5'000) & 0x1FF);
  EXPECT_EQ(clock.wrap(next), DeviceTime(777 + 5'000));
}

TEST(TransmitGrid, TheTimestampIsTheLastOnTheGridWithTheAntennaDelayAdded) {
  for (std::int64_t latest = 40'000; latest < 42'000; latest += 7) {
    for (const std::int64_t grid : {512, 64, 1}) {
      const ClockTime timestamp = transmit_timestamp_not_after(ClockTime(latest), Ticks(16'436), Ticks(grid));
      EXPECT_LE(timestamp.count(), latest);
      EXPECT_GT(timestamp.count() + grid, latest);
      EXPECT_EQ((timestamp.count() - 16'436) % grid, 0);
    }
  }
  EXPECT_EQ(round_up_to_grid(Ticks(512)).count(), 512);
  EXPECT_EQ(round_up_to_grid(Ticks(513)).count(), 1024);
}

}  // namespace
}  // namespace groma::ranging
