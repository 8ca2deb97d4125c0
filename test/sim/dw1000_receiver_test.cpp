// What the chip model's receiver hears, timestamps and reports.
#include <gtest/gtest.h>

#include <cmath>
#include <functional>

#include "firmware/sim/frame_check.hpp"
#include "firmware/sim/keyed_random.hpp"
#include "firmware/sim/transmitter.hpp"
#include "test/sim/radio_bench.hpp"

namespace groma::sim {
namespace {

constexpr std::uint64_t kGood =
    status::kRxprd | status::kRxsfdd | status::kRxphd | status::kLdedone | status::kRxdfr | status::kRxfcg;

struct Dw1000ReceiverTest : testing::Test {
  RadioBench bench;
  HandDriven& sender = bench.add({.id = 1});
  HandDriven& receiver = bench.add({.id = 2});

  void bring_up(std::uint16_t preamble = 128) {
    sender.bring_up(preamble);
    receiver.bring_up(preamble);
  }
  // Sends a frame whose RMARKER leaves in 1 ms. Returns its DX_TIME.
  std::uint64_t send(const std::vector<std::uint8_t>& payload = {0x41, 0x88, 7}) {
    sender.write(0x0F, 0, kMask40, 5);
    sender.load(payload);
    const std::uint64_t target = (sender.system_time() + 63'897'600) & kMask40 & ~std::uint64_t{0x1FF};
    sender.send_at(target);
    return target;
  }
  void pass() { bench.run_until(receiver.t + 2 * kMillisecond); }
  std::uint64_t hear() {
    receiver.receive_now();
    send();
    pass();
    return receiver.status();
  }
};

TEST_F(Dw1000ReceiverTest, ReceivesAWholeFrame) {
  bring_up();
  receiver.receive_now();
  send({1, 2, 3, 4, 5});
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, kGood);
  EXPECT_EQ(receiver.read(0x10, 0, 4) & 0x3FF, 7U);
  EXPECT_NE(receiver.read(0x10, 0, 4) & 0x8000, 0U) << "ranging bit";
  EXPECT_EQ(receiver.read_bytes(0x11, 0, 5), (std::vector<std::uint8_t>{1, 2, 3, 4, 5}));
  EXPECT_EQ(receiver.chip().fault(), "");
  EXPECT_EQ(sender.chip().fault(), "");
}

TEST_F(Dw1000ReceiverTest, TheFrameCheckIsThatOfIeee802154) {
  bring_up();
  receiver.receive_now();
  // "123456789" has CRC-16/KERMIT 0x2189.
  send({'1', '2', '3', '4', '5', '6', '7', '8', '9'});
  pass();
  EXPECT_EQ(receiver.read(0x11, 9, 2), 0x2189U);
}

// With equal, nominal clocks the receiver's timestamp is the sender's plus a whole number of ticks of flight.
TEST_F(Dw1000ReceiverTest, TimestampsAreExactToTheTick) {
  bring_up();
  for (const int flight_ticks : {0, 1, 213, 2132, 21321}) {
    bench.space.set(1, 2, {.audible = true, .flight_m = flight_ticks * kMetresPerTick});
    receiver.receive_now();
    const std::uint64_t target = send();
    pass();
    ASSERT_EQ(receiver.status() & status::kAllRx, kGood);
    EXPECT_EQ(receiver.receive_timestamp(), target + 16436 + static_cast<std::uint64_t>(flight_ticks));
    EXPECT_EQ(sender.transmit_timestamp(), target + 16436);
    // The raw timestamp includes the antenna delay and is on the coarse grid.
    const std::uint64_t raw = receiver.read(0x15, 9, 5);
    EXPECT_EQ(raw % 512, 0U);
    EXPECT_LT(receiver.receive_timestamp() + 16436 - raw, 512U);
  }
}

TEST_F(Dw1000ReceiverTest, TimestampsSubtractTheConfiguredAntennaDelays) {
  bring_up();
  sender.write(0x18, 0, 16000, 2);
  receiver.write(0x2E, 0x1804, 17000, 2);
  receiver.receive_now();
  const std::uint64_t target = send();
  pass();
  // The true delays are 16436 at either end.
  EXPECT_EQ(sender.transmit_timestamp(), target + 16000);
  EXPECT_EQ(receiver.receive_timestamp(), target + 16436 + 16436 - 17000);
}

TEST(Dw1000Timestamps, FollowBothClocksOverTheWrap) {
  for (const double ppm : {-20.0, -1.3, 0.0, 7.7, 20.0}) {
    RadioBench bench;
    const ClockSpec fast{.offset_ppm = ppm, .first_tick = (std::uint64_t{1} << 40) - 800'000'000};
    const ClockSpec slow{.offset_ppm = -ppm / 2, .first_tick = 0x12'3456'7890};
    HandDriven& sender = bench.add({.id = 1, .clock = fast});
    HandDriven& receiver = bench.add({.id = 2, .clock = slow});
    const double flight_m = 37.25;
    bench.space.set_default({.audible = true, .flight_m = flight_m});
    sender.bring_up();
    receiver.bring_up();
    // Both were reset at time 0: from then on the counters equal the clocks.
    bool wrapped = false;
    for (int i = 0; i < 20; ++i) {
      receiver.receive_now();
      sender.load({1});
      const std::uint64_t target = (sender.system_time() + 63'897'600) & kMask40 & ~std::uint64_t{0x1FF};
      wrapped = wrapped || target < 100'000'000;
      sender.send_at(target);
      bench.run_until(sender.t + 2 * kMillisecond);
      ASSERT_EQ(receiver.status() & status::kAllRx, kGood);
      const std::uint64_t timestamp = sender.transmit_timestamp();
      ASSERT_EQ(timestamp, (target + 16436) & kMask40);
      // In exact arithmetic: t = (timestamp - first) / (1 + e1); received = first2 + (t + f) (1 + e2).
      const long double local = static_cast<long double>((timestamp - fast.first_tick) & kMask40);
      const long double t_ticks = local / (1.0L + static_cast<long double>(ppm) * 1e-6L);
      const long double flight = static_cast<long double>(flight_m / 299'792'458.0 * 63.8976e9);
      const long double heard = (t_ticks + flight) * (1.0L - static_cast<long double>(ppm) * 0.5e-6L);
      const auto offset = static_cast<std::uint64_t>(std::llround(heard));
      const std::uint64_t expected = (slow.first_tick + offset) & kMask40;
      const auto difference = static_cast<std::int64_t>(receiver.receive_timestamp() - expected);
      EXPECT_LE(std::abs(difference), 1) << ppm;
    }
    EXPECT_TRUE(wrapped);
  }
}

TEST_F(Dw1000ReceiverTest, SwitchedOnLateInAPreambleItHearsNothing) {
  bring_up();
  const std::uint64_t target = send();
  const SimTime begins = (static_cast<SimTime>(target) - preamble_ticks(128) + 16436) * 5;
  bench.run_until(begins + 100 * kMicrosecond);
  receiver.receive_now();
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, 0U);

  receiver.off();
  const std::uint64_t again = send();
  bench.run_until((static_cast<SimTime>(again) - preamble_ticks(128) + 16436) * 5 - 1);
  receiver.receive_now();
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, kGood);
}

TEST_F(Dw1000ReceiverTest, TheInterruptOfAGoodFrameComesAtItsEnd) {
  bring_up();
  receiver.write(0x0E, 0, status::kRxfcg, 4);
  receiver.receive_now();
  const std::uint64_t target = send({1, 2, 3, 4, 5, 6, 7, 8, 9, 10});
  const SimTime end = (static_cast<SimTime>(target) + 16436 + kHeaderTicks + data_ticks(12)) * 5;
  bench.run_until(end - 1);
  EXPECT_FALSE(receiver.chip().irq());
  bench.run_until(end);
  EXPECT_TRUE(receiver.chip().irq());
}

TEST_F(Dw1000ReceiverTest, AReceiverListensToOneFrameOnly) {
  bring_up();
  EXPECT_EQ(hear() & status::kAllRx, kGood);
  receiver.write(0x0F, 0, kMask40, 5);
  send();
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, 0U) << "it has to be switched on again";
}

TEST_F(Dw1000ReceiverTest, CarriesFramesOfEachLength) {
  bring_up();
  for (std::size_t payload = 1; payload <= 125; payload += 31) {
    std::vector<std::uint8_t> bytes(payload);
    for (std::size_t i = 0; i < payload; ++i) bytes[i] = static_cast<std::uint8_t>(i * 7 + payload);
    receiver.receive_now();
    send(bytes);
    pass();
    ASSERT_EQ(receiver.status() & status::kAllRx, kGood);
    EXPECT_EQ(receiver.read(0x10, 0, 2) & 0x3FF, payload + 2);
    EXPECT_EQ(receiver.read_bytes(0x11, 0, payload), bytes);
  }
}

TEST_F(Dw1000ReceiverTest, TheFrameIsWhatTheBufferHoldsWhenItStarts) {
  bring_up();
  receiver.receive_now();
  send({1, 2, 3});
  sender.write_bytes(0x09, 1, {9});
  pass();
  EXPECT_EQ(receiver.read_bytes(0x11, 0, 3), (std::vector<std::uint8_t>{1, 9, 3}));
  // It is taken from the offset in TX_FCTRL.
  receiver.receive_now();
  sender.write_bytes(0x09, 100, {7, 8, 9});
  sender.write(0x0F, 0, kMask40, 5);
  sender.write(0x08, 0, 100U << 22 | 0x0016C000 | 5, 5);
  sender.send_at(sender.system_time() + 63'897'600);
  pass();
  EXPECT_EQ(receiver.read_bytes(0x11, 0, 3), (std::vector<std::uint8_t>{7, 8, 9}));
}

TEST_F(Dw1000ReceiverTest, CountsItsEventsOnceEnabled) {
  bring_up();
  hear();
  EXPECT_EQ(receiver.read(0x2F, 0x08, 2), 0U);
  receiver.write(0x2F, 0, 1, 4);
  hear();
  hear();
  EXPECT_EQ(receiver.read(0x2F, 0x08, 2), 2U);
  receiver.write(0x27, 0x24, 5, 2);
  receiver.receive_now();
  pass();
  EXPECT_EQ(receiver.read(0x2F, 0x12, 2), 1U);
  receiver.write(0x2F, 0, 3, 4);
  EXPECT_EQ(receiver.read(0x2F, 0x08, 2), 0U);
  EXPECT_EQ(receiver.read(0x2F, 0x12, 2), 0U);
}

TEST_F(Dw1000ReceiverTest, WithoutPowerItHearsNothingAndForgets) {
  bring_up();
  receiver.receive_now();
  receiver.chip().set_power(false, receiver.t);
  send();
  pass();
  EXPECT_FALSE(receiver.chip().irq());
  EXPECT_EQ(receiver.status(), 0U);
  receiver.bring_up();
  bench.run_until(receiver.t);
  EXPECT_EQ(hear() & status::kAllRx, kGood);
}

TEST_F(Dw1000ReceiverTest, SwitchingOnClearsTheOldEvents) {
  bring_up();
  EXPECT_EQ(hear() & status::kAllRx, kGood);
  receiver.receive_now();
  EXPECT_EQ(receiver.status() & status::kAllRx, 0U);
}

TEST_F(Dw1000ReceiverTest, ARetractedFrameIsNeverHeard) {
  bring_up();
  receiver.receive_now();
  send();
  bench.run_until(sender.t + 500 * kMicrosecond);
  sender.off();
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, 0U);
  EXPECT_EQ(sender.status() & status::kTxfrb, 0U);
  send();
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, kGood);
}

TEST_F(Dw1000ReceiverTest, ATruncatedFrameFailsItsCheck) {
  bring_up();
  receiver.receive_now();
  const std::uint64_t target = send(std::vector<std::uint8_t>(100));
  bench.run_until((static_cast<SimTime>(target) + kHeaderTicks + 2'000'000) * 5);
  sender.off();
  pass();
  EXPECT_NE(receiver.status() & (status::kRxfce | status::kRxrfsl), 0U);
  EXPECT_EQ(receiver.status() & status::kRxfcg, 0U);
}

// ---- time-outs ------------------------------------------------------------------------------------

struct Dw1000TimeoutTest : Dw1000ReceiverTest {
  // Microseconds from `from` until the receiver ends with that event, in steps of 0.1 us; -1: not within 100
  // ms.
  double ends_after_us(std::uint64_t event, SimTime from) {
    while (receiver.t < from + 100 * kMillisecond) {
      bench.run_until(receiver.t + kMicrosecond / 10);
      if ((receiver.status() & event) != 0)
        return static_cast<double>(receiver.t - from) / static_cast<double>(kMicrosecond);
    }
    return -1.0;
  }
};

TEST_F(Dw1000TimeoutTest, FrameWaitIsInUnitsOf1026Nanoseconds) {
  bring_up();
  receiver.limit_frame_wait(500);
  const SimTime on = receiver.t;
  receiver.receive_now();
  EXPECT_NEAR(ends_after_us(status::kRxrfto, on), 500 * 1.02564, 0.11);
}

TEST_F(Dw1000TimeoutTest, FrameWaitIsOffUnlessEnabled) {
  bring_up();
  receiver.write(0x0C, 0, 500, 2);
  const SimTime on = receiver.t;
  receiver.receive_now();
  EXPECT_LT(ends_after_us(status::kRxrfto, on), 0.0);
}

TEST_F(Dw1000TimeoutTest, FrameWaitEndsAReceptionInProgress) {
  bring_up();
  // The wait starts 20 us before the preamble and is shorter than the frame.
  receiver.limit_frame_wait(100);
  const std::uint64_t target = send();
  receiver.receive_at(target - static_cast<std::uint64_t>(preamble_ticks(128)) -
                      20 * std::uint64_t{kTicksPerUus});
  pass();
  EXPECT_EQ(receiver.status() & (status::kRxprd | status::kRxrfto | status::kRxfcg),
            status::kRxprd | status::kRxrfto);
}

TEST_F(Dw1000TimeoutTest, PreambleWaitCountsChunksAndOneMore) {
  bring_up();
  receiver.write(0x27, 0x24, 9, 2);
  const SimTime on = receiver.t;
  receiver.receive_now();
  EXPECT_NEAR(ends_after_us(status::kRxpto, on), 10 * 8 * 1.01763, 0.11);
}

TEST_F(Dw1000TimeoutTest, PreambleWaitIsOverOnceAPreambleIsFound) {
  bring_up();
  receiver.write(0x27, 0x24, 4, 2);  // 40 symbols
  const std::uint64_t target = send();
  const auto begins = target - static_cast<std::uint64_t>(preamble_ticks(128));
  receiver.receive_at(begins - 20 * std::uint64_t{kTicksPerUus});
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, kGood);

  receiver.receiver_reset();
  const std::uint64_t late = send() - static_cast<std::uint64_t>(preamble_ticks(128));
  receiver.receive_at(late - 50 * std::uint64_t{kTicksPerUus});
  pass();
  EXPECT_EQ(receiver.status() & status::kAllRx, status::kRxpto);
}

TEST_F(Dw1000TimeoutTest, ADelayedReceiveStartsItsTimeOutsWhenItBegins) {
  bring_up();
  receiver.limit_frame_wait(200);
  const std::uint64_t at = (receiver.system_time() + 30'000'000) & ~std::uint64_t{0x1FF};
  receiver.receive_at(at | 0x1F0);
  const SimTime begins = static_cast<SimTime>(at) * 5;
  EXPECT_NEAR(ends_after_us(status::kRxrfto, begins), 200 * 1.02564, 0.11);
}

TEST_F(Dw1000TimeoutTest, ALateDelayedReceiveWarns) {
  bring_up();
  receiver.receive_at(receiver.system_time() - 512);
  EXPECT_NE(receiver.status() & status::kHpdwarn, 0U);
  receiver.off();
  EXPECT_EQ(receiver.status() & status::kHpdwarn, 0U);
  receiver.receive_at(receiver.system_time() + 1024);
  EXPECT_EQ(receiver.status() & status::kHpdwarn, 0U);
}

TEST_F(Dw1000TimeoutTest, TooShortAnSfdWaitLosesGoodFrames) {
  bring_up();
  receiver.write(0x27, 0x20, 100, 2);
  EXPECT_EQ(hear() & (status::kRxsfdto | status::kRxfcg), status::kRxsfdto);
  receiver.receiver_reset();
  receiver.write(0x27, 0x20, 129, 2);
  EXPECT_EQ(hear() & status::kAllRx, kGood);
}

TEST_F(Dw1000TimeoutTest, WaitForResponseSwitchesOnAfterItsTime) {
  bring_up();
  sender.write(0x1A, 0, 300, 4);
  sender.limit_frame_wait(100);
  sender.write(0x27, 0x24, 0, 2);
  sender.load({1});
  sender.write(0x36, 0x00, 0x0220, 2);
  const std::uint64_t target = (sender.system_time() + 63'897'600) & ~std::uint64_t{0x1FF};
  sender.write(0x0A, 0, target, 5);
  sender.write(0x0D, 0, 0x86, 4);
  const SimTime end = (static_cast<SimTime>(target) + kHeaderTicks + data_ticks(3)) * 5;
  bench.run_until(end + static_cast<SimTime>(399.9 * 1.02564 * static_cast<double>(kMicrosecond)));
  EXPECT_EQ(sender.status() & status::kRxrfto, 0U);
  bench.run_until(end + static_cast<SimTime>(400.1 * 1.02564 * static_cast<double>(kMicrosecond)));
  EXPECT_NE(sender.status() & status::kRxrfto, 0U);
}

// ---- start-up -----------------------------------------------------------------------------------------

// Symbols that a receiver accumulates of a preamble if it is switched on this long after the preamble's
// begin; 0: it does not receive the frame.
int symbols_heard(int late_us, std::uint16_t preamble = 128) {
  RadioBench bench;
  HandDriven& sender = bench.add({.id = 1});
  HandDriven& receiver = bench.add({.id = 2, .quirks = {.receiver_start_up = true}});
  sender.bring_up(preamble);
  receiver.bring_up(preamble);
  sender.load({1, 2, 3});
  const std::uint64_t target = (sender.system_time() + 63'897'600) & ~std::uint64_t{0x1FF};
  sender.send_at(target);
  const auto begins = static_cast<std::int64_t>(target) + 16436 - preamble_ticks(preamble);
  receiver.receive_at(static_cast<std::uint64_t>(begins + late_us * std::int64_t{kTicksPerMicrosecond}));
  bench.run_until(receiver.t + 2 * kMillisecond);
  EXPECT_EQ(receiver.chip().fault(), "");
  if ((receiver.status() & status::kAllRx) != kGood) return 0;
  constexpr int kOfTheSfd = 5;
  return static_cast<int>(receiver.read(0x10, 0, 4) >> 20) - kOfTheSfd;
}

TEST(Dw1000StartUp, TheHuntBegins16MicrosecondsAfterTheReceiverIsOn) {
  // A chunk of 8 symbols, and what of one passes before the preamble.
  EXPECT_GE(symbols_heard(-50), 112);
  EXPECT_GE(symbols_heard(-17), 112);
  EXPECT_LE(symbols_heard(0), 128 - 15 - 8);
  EXPECT_GE(symbols_heard(0), 128 - 17 - 8);
}

TEST(Dw1000StartUp, APreambleIsDetectedWhileTwoChunksAreLeft) {
  // From begin to SFD: 130.3 us; two chunks: 16.3 us, or 32.6 us where they have 16 symbols.
  EXPECT_GT(symbols_heard(97), 8);
  EXPECT_EQ(symbols_heard(99), 0);
  EXPECT_GT(symbols_heard(31, 64), 8);
  EXPECT_EQ(symbols_heard(34, 64), 0);
  EXPECT_GT(symbols_heard(210, 256), 16);
  EXPECT_EQ(symbols_heard(213, 256), 0);
}

TEST(Dw1000StartUp, OfTwoPreamblesUnderWayTheStrongerIsDetected) {
  for (const std::uint16_t stronger : std::array<std::uint16_t, 2>{1, 2}) {
    RadioBench bench;
    HandDriven& first = bench.add({.id = 1});
    HandDriven& second = bench.add({.id = 2});
    HandDriven& receiver = bench.add({.id = 3, .quirks = {.receiver_start_up = true}});
    bench.space.set_default({.audible = true, .receive_power_dbm = -80.0});
    bench.space.set(stronger, 3, {.audible = true, .receive_power_dbm = -73.0});
    for (HandDriven* node : {&first, &second, &receiver}) node->bring_up();
    const std::uint64_t target = first.system_time() + 63'897'600;
    first.load({1, 1, 1});
    second.load({2, 2, 2});
    first.send_at(target);
    second.send_at(target + 20 * kTicksPerMicrosecond);
    receiver.receive_at(target - 100 * kTicksPerMicrosecond);
    bench.run_until(receiver.t + 3 * kMillisecond);
    EXPECT_EQ(receiver.status() & status::kAllRx, kGood);
    EXPECT_EQ(receiver.read(0x11, 0, 1), stronger);
  }
}

// ---- what makes a timestamp wrong or a receiver deaf ---------------------------------------------------

TEST_F(Dw1000ReceiverTest, WithoutMicrocodeThereIsNoTimestamp) {
  sender.bring_up();
  receiver.bring_up(128, false);
  receiver.receive_now();
  const std::uint64_t target = send();
  pass();
  EXPECT_EQ(receiver.status() & (status::kRxfcg | status::kLdedone), status::kRxfcg);
  EXPECT_GT((receiver.receive_timestamp() - target) & kMask40, 1'000'000U);
}

TEST_F(Dw1000ReceiverTest, MicrocodeNeedsItsClocksAndItsTime) {
  sender.bring_up();
  for (const auto& [clocks, wait_us, loaded] :
       {std::tuple{0x0301U, 150, true}, std::tuple{0x0301U, 100, false}, std::tuple{0x0201U, 150, false}}) {
    receiver.t = sender.t;
    receiver.chip().set_power(false, receiver.t);
    receiver.chip().set_power(true, receiver.t);
    receiver.t += 4 * kMillisecond;
    receiver.hz = 2'000'000;
    receiver.write(0x36, 0x00, clocks, 2);
    receiver.write(0x2D, 0x06, 0x8000, 2);
    receiver.t += wait_us * kMicrosecond;
    receiver.write(0x36, 0x00, 0x0200, 2);
    receiver.hz = 8'000'000;
    receiver.configure(128);
    bench.run_until(receiver.t);
    EXPECT_EQ((hear() & status::kLdedone) != 0, loaded) << clocks << ' ' << wait_us;
  }
}

TEST_F(Dw1000ReceiverTest, LdeRunEnableIsNeeded) {
  bring_up();
  receiver.write(0x36, 0x04, 0x81000738, 4);
  EXPECT_EQ(hear() & (status::kRxfcg | status::kLdedone), status::kRxfcg);
}

TEST_F(Dw1000ReceiverTest, AfterATimeOutTheTimestampIsWrongUntilTheReceiverIsReset) {
  bring_up();
  for (const bool reset : {false, true}) {
    receiver.limit_frame_wait(50);
    receiver.receive_now();
    pass();
    ASSERT_NE(receiver.status() & status::kRxrfto, 0U);
    receiver.write(0x04, 0, 0x00041200, 4);
    if (reset) receiver.receiver_reset();
    receiver.receive_now();
    const std::uint64_t target = send();
    pass();
    ASSERT_EQ(receiver.status() & status::kAllRx, kGood);
    const auto error = std::abs(static_cast<std::int64_t>(receiver.receive_timestamp() - target - 16436));
    if (reset) {
      EXPECT_EQ(error, 0);
    } else {
      EXPECT_GE(error, 64);
    }
  }
}

TEST_F(Dw1000ReceiverTest, AResetWithoutTurningTheReceiverOffLeavesTimestampsWrong) {
  bring_up();
  for (const bool turn_off : {false, true}) {
    receiver.limit_frame_wait(50);
    receiver.receive_now();
    pass();
    ASSERT_NE(receiver.status() & status::kRxrfto, 0U);
    receiver.write(0x04, 0, 0x00041200, 4);
    receiver.receiver_reset(turn_off);
    receiver.receive_now();
    const std::uint64_t target = send();
    pass();
    ASSERT_EQ(receiver.status() & status::kAllRx, kGood);
    const auto error = std::abs(static_cast<std::int64_t>(receiver.receive_timestamp() - target - 16436));
    EXPECT_EQ(error >= 64, !turn_off);
  }
}

TEST_F(Dw1000ReceiverTest, AGoodFrameIsNoReset) {
  bring_up();
  receiver.limit_frame_wait(50);
  receiver.receive_now();
  pass();
  receiver.write(0x04, 0, 0x00041200, 4);
  for (int i = 0; i < 3; ++i) {
    receiver.receive_now();
    const std::uint64_t target = send();
    pass();
    ASSERT_EQ(receiver.status() & status::kAllRx, kGood);
    EXPECT_GE(std::abs(static_cast<std::int64_t>(receiver.receive_timestamp() - target - 16436)), 64);
  }
}

TEST_F(Dw1000ReceiverTest, EachPreambleCodeHasItsLeadingEdgeSetting) {
  bring_up();
  for (const auto& [code, coefficient] :
       {std::pair{9U, 0x28F4U}, std::pair{10U, 0x3332U}, std::pair{11U, 0x3AE0U}, std::pair{12U, 0x3D70U}}) {
    for (HandDriven* node : {&sender, &receiver}) {
      node->write(0x1F, 0, 0x00080055 | code << 22 | code << 27, 4);
      node->write(0x2E, 0x2804, coefficient, 2);
    }
    receiver.receive_now();
    const std::uint64_t target = send();
    pass();
    ASSERT_EQ(receiver.status() & status::kAllRx, kGood) << code;
    EXPECT_EQ(receiver.receive_timestamp(), target + 16436);
  }
}

// A receiving node may be ahead of the sender in simulated time: what it did until then counts.
TEST_F(Dw1000ReceiverTest, AFrameAnnouncedLateIsHeardOnlyIfTheReceiverWasOnInTime) {
  bring_up();
  sender.load({1, 2, 3});
  for (const int after_us : {0, 25, 110}) {
    receiver.t = sender.t + after_us * kMicrosecond;
    receiver.receive_now();
    receiver.chip().advance(sender.t + 40 * kMicrosecond);
    sender.write(0x0F, 0, kMask40, 5);
    sender.send_now();
    bench.run_until(sender.t + kMillisecond);
    EXPECT_EQ(receiver.status() & status::kAllRx, after_us < 100 ? kGood : 0U);
    EXPECT_EQ(receiver.chip().late_announcements(), 0U);
    receiver.off();
  }
}

TEST_F(Dw1000ReceiverTest, AFrameAnnouncedTooLateIsCounted) {
  bring_up();
  sender.load({1, 2, 3});
  receiver.receive_now();
  receiver.t += 40 * kMicrosecond;
  receiver.off();  // it would have been within the frame's preamble
  sender.send_now();
  EXPECT_EQ(receiver.chip().late_announcements(), 1U);
}

TEST_F(Dw1000ReceiverTest, LeadingEdgeSettingsOfAnotherCodeBiasTheTimestamp) {
  bring_up();
  receiver.write(0x2E, 0x2804, 0x3332, 2);
  receiver.receive_now();
  const std::uint64_t target = send();
  pass();
  EXPECT_GE(std::abs(static_cast<std::int64_t>(receiver.receive_timestamp() - target - 16436)), 64);
}

struct WrongSetting {
  const char* name;
  bool at_sender;
  std::uint8_t file;
  std::uint16_t offset;
  std::uint64_t value;
  std::size_t count;
};

class Dw1000WrongSetting : public Dw1000ReceiverTest, public testing::WithParamInterface<WrongSetting> {};

TEST_P(Dw1000WrongSetting, IsNotHeard) {
  bring_up();
  EXPECT_EQ(hear() & status::kAllRx, kGood);
  const WrongSetting& wrong = GetParam();
  (wrong.at_sender ? sender : receiver).write(wrong.file, wrong.offset, wrong.value, wrong.count);
  EXPECT_EQ(hear() & status::kAllRx, 0U);
}

INSTANTIATE_TEST_SUITE_P(EachRegister, Dw1000WrongSetting,
                         testing::Values(WrongSetting{"channel", false, 0x1F, 0, 0x4A480022, 4},
                                         WrongSetting{"prf", false, 0x1F, 0, 0x4A440055, 4},
                                         WrongSetting{"receive_code", false, 0x1F, 0, 0x52480055, 4},
                                         WrongSetting{"transmit_code", true, 0x1F, 0, 0x4A880055, 4},
                                         WrongSetting{"transmit_channel", true, 0x1F, 0, 0x4A480052, 4},
                                         WrongSetting{"pac", false, 0x27, 0x08, 0x333B00BE, 4},
                                         WrongSetting{"tune1b", false, 0x27, 0x06, 0x0010, 2},
                                         WrongSetting{"tune4h", false, 0x27, 0x26, 0x0010, 2},
                                         WrongSetting{"tune0b", false, 0x27, 0x02, 0x000A, 2},
                                         WrongSetting{"tune1a", false, 0x27, 0x04, 0x0087, 2},
                                         WrongSetting{"agc1", false, 0x23, 0x04, 0x8870, 2},
                                         WrongSetting{"agc2", false, 0x23, 0x0C, 0, 4},
                                         WrongSetting{"agc3", false, 0x23, 0x12, 0x0055, 2},
                                         WrongSetting{"rxctrlh", false, 0x28, 0x0B, 0xBC, 1},
                                         WrongSetting{"pllcfg", false, 0x2B, 0x07, 0x08401009, 4},
                                         WrongSetting{"plltune_stale", false, 0x2B, 0x0B, 0xA6, 1},
                                         WrongSetting{"transmit_pllcfg", true, 0x2B, 0x07, 0x08401009, 4},
                                         WrongSetting{"txctrl", true, 0x28, 0x0C, 0x00086CC0, 4},
                                         WrongSetting{"pgdelay", true, 0x2A, 0x0B, 0xC0, 1}),
                         [](const auto& test) { return test.param.name; });

TEST_F(Dw1000ReceiverTest, EachPreambleLengthWorksWithItsOwnSettings) {
  for (const std::uint16_t preamble : std::array<std::uint16_t, 3>{64, 128, 256}) {
    RadioBench pair;
    HandDriven& a = pair.add({.id = 1});
    HandDriven& b = pair.add({.id = 2});
    a.bring_up(preamble);
    b.bring_up(preamble);
    // For each phase of the preamble within a chunk of symbols.
    for (int phase = 0; phase < 40; ++phase) {
      pair.run_until(a.t + phase * kMicrosecond / 2);
      b.receive_now();
      a.load({1, 2});
      a.write(0x0F, 0, kMask40, 5);
      a.send_now();
      pair.run_until(b.t + kMillisecond);
      ASSERT_EQ(b.status() & status::kAllRx, kGood) << preamble << ' ' << phase;
    }
  }
}

// ---- diagnostics ----------------------------------------------------------------------------------

TEST(Dw1000Diagnostics, TheManualsFormulasGiveBackThePowers) {
  for (const std::uint16_t preamble : std::array<std::uint16_t, 2>{64, 128}) {
    for (const double power_dbm : {-92.0, -85.5, -80.0, -76.0}) {
      RadioBench bench;
      HandDriven& a = bench.add({.id = 1});
      HandDriven& b = bench.add({.id = 2});
      bench.space.set_default({.audible = true,
                               .flight_m = 5.0,
                               .receive_power_dbm = power_dbm,
                               .first_path_power_dbm = power_dbm - 4.0});
      a.bring_up(preamble);
      b.bring_up(preamble);
      b.receive_now();
      a.load({1, 2});
      a.send_now();
      bench.run_until(b.t + kMillisecond);
      ASSERT_EQ(b.status() & status::kAllRx, kGood);
      double n = static_cast<double>(b.read(0x10, 0, 4) >> 20);
      if (b.read(0x10, 0, 4) >> 20 == b.read(0x27, 0x2C, 2)) n -= 5.0;
      EXPECT_GT(n, preamble * 0.7);
      EXPECT_LE(n, preamble);
      const auto f1 = static_cast<double>(b.read(0x15, 7, 2));
      const auto f2 = static_cast<double>(b.read(0x12, 2, 2));
      const auto f3 = static_cast<double>(b.read(0x12, 4, 2));
      const auto c = static_cast<double>(b.read(0x12, 6, 2));
      EXPECT_NEAR(10.0 * std::log10((f1 * f1 + f2 * f2 + f3 * f3) / (n * n)) - 121.74, power_dbm - 4.0, 0.1);
      EXPECT_NEAR(10.0 * std::log10(c * 131072.0 / (n * n)) - 121.74, power_dbm, 0.2);
      // The peak follows the first path, the later the more power is outside it.
      const auto first = static_cast<double>(b.read(0x15, 5, 2)) / 64.0;
      const auto peak = static_cast<double>(b.read(0x2E, 0x1000, 2));
      EXPECT_NEAR(peak - first, 2.5, 0.6);
    }
  }
}

TEST(Dw1000Diagnostics, CarrierAndTrackingGiveTheClockOffset) {
  for (const auto& [from_ppm, to_ppm] :
       {std::pair{12.0, -5.0}, std::pair{-20.0, 20.0}, std::pair{0.1, 0.0}}) {
    RadioBench bench;
    HandDriven& a = bench.add({.id = 1, .clock = {.offset_ppm = from_ppm}});
    HandDriven& b = bench.add({.id = 2, .clock = {.offset_ppm = to_ppm}});
    a.bring_up();
    b.bring_up();
    b.receive_now();
    a.load({1, 2});
    a.send_now();
    bench.run_until(b.t + kMillisecond);
    ASSERT_EQ(b.status() & status::kAllRx, kGood);
    auto car_int = static_cast<std::int32_t>(b.read(0x27, 0x28, 3) << 11) >> 11;
    EXPECT_NEAR(car_int * -5.7312e-4, from_ppm - to_ppm, 0.002);
    const auto tofs = static_cast<std::int32_t>(b.read(0x14, 0, 3) << 13) >> 13;
    EXPECT_EQ(b.read(0x13, 0, 4), 0x01FC0000U);
    EXPECT_NEAR(tofs / static_cast<double>(0x01FC0000) * 1e6, from_ppm - to_ppm, 0.02);
  }
}

// ---- overlaps -------------------------------------------------------------------------------------

struct Dw1000CollisionTest : testing::Test {
  RadioBench bench;
  HandDriven& first = bench.add({.id = 1});
  HandDriven& second = bench.add({.id = 2});
  HandDriven& receiver = bench.add({.id = 3});

  // The second frame begins that many microseconds after the first and is that much stronger; returns status.
  std::uint64_t collide(int later_us, double stronger_db, std::size_t length = 100) {
    bench.space.set(1, 3, {.audible = true, .flight_m = 3.0, .receive_power_dbm = -80.0});
    bench.space.set(2, 3, {.audible = true, .flight_m = 3.0, .receive_power_dbm = -80.0 + stronger_db});
    for (HandDriven* node : {&first, &second, &receiver}) node->bring_up();
    receiver.receive_now();
    const std::uint64_t target = first.system_time() + 63'897'600;
    first.load(std::vector<std::uint8_t>(length - 2, 1));
    second.load(std::vector<std::uint8_t>(length - 2, 2));
    first.send_at(target);
    second.send_at(target + static_cast<std::uint64_t>(later_us) * kTicksPerMicrosecond);
    bench.run_until(receiver.t + 3 * kMillisecond);
    return receiver.status();
  }
  std::uint64_t heard() { return receiver.read(0x11, 0, 1); }
};

TEST_F(Dw1000CollisionTest, SeparateFramesDoNotCollide) {
  EXPECT_NE(collide(300, 0.0) & status::kRxfcg, 0U);
  EXPECT_EQ(heard(), 1U);
}
TEST_F(Dw1000CollisionTest, AWeakLatecomerDoesNoHarm) {
  EXPECT_NE(collide(100, -6.5) & status::kRxfcg, 0U);
  EXPECT_EQ(heard(), 1U);
}
TEST_F(Dw1000CollisionTest, AStrongerFrameInThePreambleTakesOver) {
  EXPECT_NE(collide(50, 6.5) & status::kRxfcg, 0U);
  EXPECT_EQ(heard(), 2U);
}
TEST_F(Dw1000CollisionTest, AStrongerFrameTakesOverDuringThePreambleWaitToo) {
  bench.space.set(1, 3, {.audible = true, .receive_power_dbm = -80.0});
  bench.space.set(2, 3, {.audible = true, .receive_power_dbm = -70.0});
  for (HandDriven* node : {&first, &second, &receiver}) node->bring_up();
  receiver.write(0x27, 0x24, 4, 2);  // 40 symbols
  const std::uint64_t target = first.system_time() + 63'897'600;
  first.load({1, 1, 1});
  second.load({2, 2, 2});
  first.send_at(target);
  second.send_at(target + 60 * kTicksPerMicrosecond);
  receiver.receive_at(target - static_cast<std::uint64_t>(preamble_ticks(128)) - 5 * kTicksPerMicrosecond);
  bench.run_until(receiver.t + 3 * kMillisecond);
  EXPECT_EQ(receiver.status() & status::kAllRx, kGood);
  EXPECT_EQ(heard(), 2U);
}
TEST_F(Dw1000CollisionTest, TwoEqualFramesInThePreambleAreBothLost) {
  EXPECT_EQ(collide(50, 0.0) & (status::kRxsfdto | status::kRxfcg | status::kRxdfr), status::kRxsfdto);
}
TEST_F(Dw1000CollisionTest, AnOverlapInTheHeaderCorruptsIt) {
  EXPECT_EQ(collide(145, 3.0) & (status::kRxphe | status::kRxfcg), status::kRxphe);
}
TEST_F(Dw1000CollisionTest, AnOverlapInTheDataFailsTheCheck) {
  const std::uint64_t status = collide(200, 20.0);
  EXPECT_NE(status & (status::kRxfce | status::kRxrfsl), 0U);
  EXPECT_EQ(status & status::kRxfcg, 0U);
}
TEST_F(Dw1000CollisionTest, AnInaudibleFrameDoesNotCollide) {
  bench.space.set(2, 3, {.audible = false});
  for (HandDriven* node : {&first, &second, &receiver}) node->bring_up();
  receiver.receive_now();
  first.load({1, 1, 1});
  second.load({2, 2, 2});
  const std::uint64_t target = first.system_time() + 63'897'600;
  first.send_at(target);
  second.send_at(target);
  bench.run_until(receiver.t + 3 * kMillisecond);
  EXPECT_NE(receiver.status() & status::kRxfcg, 0U);
  EXPECT_EQ(heard(), 1U);
}
TEST_F(Dw1000CollisionTest, AFrameUnderWayMasksAWeakerOneForALateReceiver) {
  for (const auto& [stronger_db, hears] : {std::pair{0.0, false}, std::pair{7.0, true}}) {
    bench.space.set(1, 3, {.audible = true, .receive_power_dbm = -80.0});
    bench.space.set(2, 3, {.audible = true, .receive_power_dbm = -80.0 + stronger_db});
    for (HandDriven* node : {&first, &second, &receiver}) node->bring_up();
    const std::uint64_t target = first.system_time() + 63'897'600;
    first.load(std::vector<std::uint8_t>(120, 1));
    second.load({2, 2, 2});
    first.send_at(target);
    second.send_at(target + 100 * kTicksPerMicrosecond);
    receiver.receive_at(target - 25 * kTicksPerMicrosecond);  // too late for the first frame's preamble
    bench.run_until(receiver.t + 3 * kMillisecond);
    EXPECT_EQ((receiver.status() & status::kRxfcg) != 0, hears);
  }
}

// Records which frame was lost to which, by their first bytes.
class OverlapList final : public Witness {
 public:
  void overlapped(const AirFrame& lost, const AirFrame& by, std::uint16_t receiver) override {
    EXPECT_EQ(receiver, 3U);
    seen.emplace_back(lost.data[0], by.data[0]);
  }
  std::vector<std::pair<int, int>> seen;
};

TEST_F(Dw1000CollisionTest, AWitnessSeesEachFrameLostToAnOverlap) {
  using Seen = std::vector<std::pair<int, int>>;
  struct Case {
    int later_us;
    double stronger_db;
    Seen expected;
  };
  for (const Case& c : {Case{300, 0.0, {}}, Case{100, -6.5, {{2, 1}}}, Case{50, 6.5, {{1, 2}}},
                        Case{50, 0.0, {{2, 1}, {1, 2}}}, Case{200, 20.0, {{2, 1}, {1, 2}}}}) {
    Dw1000CollisionTest_AWitnessSeesEachFrameLostToAnOverlap_Test collision;
    OverlapList witness;
    collision.bench.medium.set_witness(&witness);
    (void)collision.collide(c.later_us, c.stronger_db);
    EXPECT_EQ(witness.seen, c.expected) << c.later_us << ' ' << c.stronger_db;
  }
}

TEST_F(Dw1000CollisionTest, ASenderWithoutAChipIsHeardLikeAnyOther) {
  Transmitter sender(4, bench.medium);
  bench.space.set(3, 4, {.audible = true, .flight_m = 3.0});
  for (HandDriven* node : {&first, &second, &receiver}) node->bring_up();
  receiver.receive_now();
  const std::vector<std::uint8_t> bytes{9, 8, 7};
  const SimTime at = receiver.t + 2 * kMillisecond;
  sender.send(at, bytes);
  bench.run_until(at + kMillisecond);
  ASSERT_EQ(receiver.status() & status::kAllRx, kGood);
  EXPECT_EQ(receiver.read(0x10, 0, 1), 5U);
  EXPECT_EQ(receiver.read_bytes(0x11, 0, 3), bytes);
  EXPECT_EQ(receiver.read(0x11, 3, 2), frame_check(bytes));
  // After the preamble's 128 symbols, the SFD's 8 and 3 m of flight; nominal clocks.
  const std::int64_t rmarker = at / kUnitsPerTick + std::int64_t{136} * 508 * 128;
  const double flight_ticks = 3.0 / kMetresPerTick;
  EXPECT_NEAR(static_cast<double>(receiver.receive_timestamp()),
              std::fmod(static_cast<double>(rmarker) + flight_ticks, 0x1.0p40), 1.01);
}

}  // namespace
}  // namespace groma::sim
