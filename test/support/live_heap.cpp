#include "test/support/live_heap.hpp"

#include <malloc.h>

#include <algorithm>
#include <atomic>
#include <cstdint>

namespace {

std::atomic<std::int64_t> live_bytes{0};
std::atomic<std::int64_t> peak_bytes{0};
std::atomic<std::int64_t> base_bytes{0};

void* taken(void* memory) noexcept {
  if (memory != nullptr) {
    live_bytes += static_cast<std::int64_t>(malloc_usable_size(memory));
    peak_bytes = std::max(peak_bytes.load(), live_bytes.load());
  }
  return memory;
}

void given_back(void* memory) noexcept {
  if (memory != nullptr) live_bytes -= static_cast<std::int64_t>(malloc_usable_size(memory));
}

}  // namespace

// Names given by the linker's --wrap.
// NOLINTBEGIN(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp,readability-identifier-naming)
extern "C" {
void* __real_malloc(std::size_t size);
void* __real_calloc(std::size_t count, std::size_t size);
void* __real_realloc(void* memory, std::size_t size);
int __real_posix_memalign(void** memory, std::size_t alignment, std::size_t size);
void __real_free(void* memory);

void* __wrap_malloc(std::size_t size) {
  return taken(__real_malloc(size));
}
void* __wrap_calloc(std::size_t count, std::size_t size) {
  return taken(__real_calloc(count, size));
}
void* __wrap_realloc(void* memory, std::size_t size) {
  given_back(memory);
  return taken(__real_realloc(memory, size));
}
int __wrap_posix_memalign(void** memory, std::size_t alignment, std::size_t size) {
  const int error = __real_posix_memalign(memory, alignment, size);
  if (error == 0) taken(*memory);
  return error;
}
void __wrap_free(void* memory) {
  given_back(memory);
  __real_free(memory);
}
}
// NOLINTEND(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp,readability-identifier-naming)

namespace groma::test {

void watch_heap() noexcept {
  base_bytes = live_bytes.load();
  peak_bytes = live_bytes.load();
}

std::size_t peak_heap_bytes() noexcept {
  return static_cast<std::size_t>(peak_bytes - base_bytes);
}

}  // namespace groma::test
