// Threads that share out short pieces of work, over and over.
#pragma once

#include <atomic>
#include <cstdint>
#include <functional>
#include <thread>
#include <vector>

namespace groma::sim {

class WorkerPool {
 public:
  // The caller of run() is one of the threads; 1: all is done by it.
  explicit WorkerPool(unsigned threads);
  WorkerPool(const WorkerPool&) = delete;
  WorkerPool& operator=(const WorkerPool&) = delete;
  ~WorkerPool();

  // Calls work(0) to work(count - 1), each once, in any order and by any thread; returns when all are done.
  // At most 65535 at once.
  // `work` does not throw.
  void run(std::uint16_t count, const std::function<void(std::uint16_t)>& work);

 private:
  void serve(const std::stop_token& stop);
  // Does what is left of that round.
  void take_part(std::uint32_t round);

  const std::function<void(std::uint16_t)>* work_ = nullptr;
  std::atomic<std::uint32_t> done_ = 0;
  // From the top: the round (32 bits), how many pieces it has (16), the next one to be taken (16).
  std::atomic<std::uint64_t> ticket_ = 0;
  std::vector<std::jthread> threads_;
};

}  // namespace groma::sim
