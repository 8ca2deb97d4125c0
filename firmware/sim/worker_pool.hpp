// Threads that repeatedly share short pieces of work.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <thread>
#include <vector>

namespace groma::sim {

class WorkerPool {
 public:
  // The caller of run() counts as one of the threads; with 1 it does all the work.
  explicit WorkerPool(unsigned threads);
  WorkerPool(const WorkerPool&) = delete;
  WorkerPool& operator=(const WorkerPool&) = delete;
  ~WorkerPool();

  // Calls work(0) to work(count - 1), each once, in any order and on any thread. Returns when all are done.
  // `work` must not throw.
  void run(std::uint16_t count, const std::function<void(std::uint16_t)>& work);

 private:
  void serve(const std::stop_token& stop);
  // Takes pieces of that round until none is left.
  void take_part(std::uint32_t round);

  const std::function<void(std::uint16_t)>* work_ = nullptr;
  std::atomic<std::uint32_t> done_ = 0;
  // From the most significant bit: round (32 bits), number of its pieces (16), next piece to take (16).
  std::atomic<std::uint64_t> ticket_ = 0;
  std::vector<std::jthread> threads_;
};

}  // namespace groma::sim
