// Heap allocations of a program, counted by the library allocation_counter.cpp, which the dynamic loader
// preloads.
#pragma once

#include <atomic>
#include <cstdint>

namespace groma::latency {

// Names the file that the library maps, at least as large as AllocationCounts.
inline constexpr const char* kCountsVariable = "GROMA_ALLOCATION_COUNTS";

// The content of that file. The main thread is the one that runs gromad's loop.
struct AllocationCounts {
  std::atomic<std::uint64_t> main_thread{0};
  std::atomic<std::uint64_t> other_threads{0};
  std::atomic<std::uint64_t> poses{0};     // POSE lines that the main thread has sent
  std::atomic<std::uint64_t> in_poses{0};  // of main_thread, since the main thread last read an input
};

}  // namespace groma::latency
