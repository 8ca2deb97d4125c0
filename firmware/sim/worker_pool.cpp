#include "firmware/sim/worker_pool.hpp"

namespace groma::sim {

namespace {

// Rounds follow each other quickly or not at all. A thread polls this often for the next round before it
// sleeps, and for the end of a round before it yields.
constexpr int kPolls = 500;

constexpr std::uint32_t round_of(std::uint64_t ticket) noexcept {
  return static_cast<std::uint32_t>(ticket >> 32);
}

constexpr std::uint64_t ticket_of(std::uint32_t round, std::uint16_t count) noexcept {
  return std::uint64_t{round} << 32 | std::uint64_t{count} << 16;
}

void pause() noexcept {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#endif
}

}  // namespace

WorkerPool::WorkerPool(unsigned threads) {
  for (unsigned i = 1; i < threads; ++i)
    threads_.emplace_back([this](const std::stop_token& stop) { serve(stop); });
}

WorkerPool::~WorkerPool() {
  for (std::jthread& thread : threads_) thread.request_stop();
  ticket_ = ticket_of(round_of(ticket_) + 1, 0);
  ticket_.notify_all();
}

void WorkerPool::run(std::uint16_t count, const std::function<void(std::uint16_t)>& work) {
  if (count < 2 || threads_.empty()) {
    for (std::uint16_t i = 0; i < count; ++i) work(i);
    return;
  }
  work_ = &work;
  done_ = 0;
  const std::uint32_t round = round_of(ticket_) + 1;
  ticket_ = ticket_of(round, count);
  ticket_.notify_all();
  take_part(round);
  for (int poll = 0; done_ != count; ++poll) {
    if (poll < kPolls) {
      pause();
    } else {
      std::this_thread::yield();
    }
  }
}

void WorkerPool::take_part(std::uint32_t round) {
  std::uint64_t ticket = ticket_;
  while (round_of(ticket) == round) {
    const auto piece = static_cast<std::uint16_t>(ticket);
    if (piece >= static_cast<std::uint16_t>(ticket >> 16)) return;
    // Once this thread has taken a piece, the round cannot end before the piece is done.
    if (!ticket_.compare_exchange_weak(ticket, ticket + 1)) continue;
    (*work_)(piece);
    ++done_;
    ticket = ticket_;
  }
}

void WorkerPool::serve(const std::stop_token& stop) {
  std::uint64_t seen = 0;
  while (!stop.stop_requested()) {
    std::uint64_t ticket = ticket_;
    for (int poll = 0; round_of(ticket) == round_of(seen) && poll < kPolls; ++poll) {
      pause();
      ticket = ticket_;
    }
    if (round_of(ticket) == round_of(seen)) {
      ticket_.wait(ticket);
      continue;
    }
    take_part(round_of(ticket));
    seen = ticket;
  }
}

}  // namespace groma::sim
