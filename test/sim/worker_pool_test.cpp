#include "firmware/sim/worker_pool.hpp"

#include <gtest/gtest.h>

#include <chrono>
#include <thread>
#include <vector>

namespace groma::sim {
namespace {

TEST(WorkerPool, RunsEachItemOncePerRound) {
  for (const unsigned threads : {1U, 2U, 5U}) {
    WorkerPool pool(threads);
    std::vector<int> done(64, 0);
    int expected = 0;
    for (std::uint16_t round = 0; round < 2'000; ++round) {
      const auto count = static_cast<std::uint16_t>(round % 65);
      // Each item writes its own element, and the next round sees what this one wrote.
      pool.run(count, [&](std::uint16_t item) { ++done[item]; });
      expected += count;
    }
    int sum = 0;
    for (const int times : done) sum += times;
    EXPECT_EQ(sum, expected) << threads;
  }
}

TEST(WorkerPool, WakesSleepingThreads) {
  WorkerPool pool(2);
  std::vector<std::thread::id> ids(2);
  // Long enough that one thread does not run both items.
  for (int tries = 0; tries < 50 && ids[0] == ids[1]; ++tries) {
    std::this_thread::sleep_for(std::chrono::milliseconds(5));
    pool.run(2, [&](std::uint16_t item) {
      ids[item] = std::this_thread::get_id();
      std::this_thread::sleep_for(std::chrono::milliseconds(20));
    });
  }
  EXPECT_NE(ids[0], ids[1]);
}

}  // namespace
}  // namespace groma::sim
