// Chips driven ahead of each other by a quantum of time, as processors in an emulator drive them. Receptions
// and timestamps are the same for all quanta below the lookahead.
#include <gtest/gtest.h>

#include "test/sim/radio_bench.hpp"

namespace groma::sim {
namespace {

// Polls every 3 ms, or answers a poll after 500 us with a delayed frame. Logs each status, timestamp and
// payload.
class Talker {
 public:
  Talker(const ChipSpec& spec, Medium& medium, bool polls) : radio(spec, medium), polls_(polls) {}

  void start(SimTime t) {
    radio.t = t;
    radio.bring_up();
    radio.write(0x0F, 0, kMask40, 5);
    radio.write(0x0E, 0, status::kTxfrs | status::kRxfcg | status::kRxfce | status::kRxpto | status::kRxrfto,
                4);
    next_poll_ = radio.t + kMillisecond;
    if (!polls_) radio.receive_now();
  }

  // Works as an interrupt-driven processor does, up to `end`.
  void run_until(SimTime end) {
    Dw1000Chip& chip = radio.chip();
    for (;;) {
      if (chip.irq()) {
        on_interrupt();
        continue;
      }
      const SimTime next = std::min(chip.next_event(), polls_ ? next_poll_ : kNever);
      if (next > end) break;
      radio.t = std::max(radio.t, next);
      if (polls_ && next == next_poll_) {
        poll();
      } else {
        chip.advance(next);
      }
    }
    chip.advance(end);
    radio.t = std::max(radio.t, end);
  }

  HandDriven radio;
  std::vector<std::uint64_t> log;

 private:
  void poll() {
    next_poll_ += 3 * kMillisecond;
    radio.off();
    radio.load({1, static_cast<std::uint8_t>(log.size())});
    radio.send_now();
  }

  void on_interrupt() {
    const std::uint64_t status = radio.status();
    radio.write(0x0F, 0, kMask40, 5);
    log.push_back(status);
    if ((status & status::kTxfrs) != 0) {
      log.push_back(radio.transmit_timestamp());
      radio.write(0x36, 0, 0x0200, 2);
      radio.limit_frame_wait(1000);
      radio.receive_now();
      return;
    }
    if ((status & status::kRxfcg) != 0) {
      log.push_back(radio.receive_timestamp());
      log.push_back(radio.read(0x11, 0, 2));
      if (!polls_) {
        radio.load({2, static_cast<std::uint8_t>(log.size())});
        radio.send_at(radio.receive_timestamp() + 500 * kTicksPerMicrosecond);
        return;
      }
    } else {
      radio.receiver_reset();
    }
    if (!polls_) radio.receive_now();
  }

  bool polls_;
  SimTime next_poll_ = kNever;
};

std::vector<std::vector<std::uint64_t>> logs_with(SimTime quantum, bool reversed) {
  DistanceTable space;
  space.set_default({.audible = true, .flight_m = 20.0, .receive_power_dbm = -85.0});
  space.set(1, 2, {.audible = true, .flight_m = 4.0, .receive_power_dbm = -75.0});
  Medium medium(space, {.loss_probability = 0.1}, 3);
  Talker first({.id = 1, .clock = {.offset_ppm = 11.0}}, medium, true);
  Talker second({.id = 2, .clock = {.offset_ppm = -7.0}}, medium, false);
  Talker third({.id = 3, .clock = {.offset_ppm = 2.0}}, medium, false);
  std::array<Talker*, 3> talkers{&first, &second, &third};
  for (Talker* talker : talkers) talker->start(0);
  if (reversed) std::reverse(talkers.begin(), talkers.end());
  for (SimTime t = 6 * kMillisecond; t < 300 * kMillisecond; t += quantum)
    for (Talker* talker : talkers) talker->run_until(t);
  std::vector<std::vector<std::uint64_t>> logs{first.log, second.log, third.log};
  for (Talker* talker : talkers) {
    EXPECT_EQ(talker->radio.chip().late_announcements(), 0U);
    EXPECT_EQ(talker->radio.chip().fault(), "");
  }
  // What lies in the last, partial quantum is not compared.
  for (auto& log : logs) log.resize(log.size() * 9 / 10);
  return logs;
}

TEST(Dw1000Quantum, NothingDependsOnIt) {
  const auto finest = logs_with(kMicrosecond, false);
  EXPECT_GT(finest[0].size(), 200U);
  EXPECT_GT(finest[1].size(), 200U);
  for (const SimTime quantum_us : {7, 50, 130})
    for (const bool reversed : {false, true})
      EXPECT_EQ(logs_with(quantum_us * kMicrosecond, reversed), finest) << quantum_us;
}

}  // namespace
}  // namespace groma::sim
