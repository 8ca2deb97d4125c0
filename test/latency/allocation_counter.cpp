// Replaces functions of the C library. What they do is left to the library's own names and to the kernel.
#include "test/latency/allocation_counter.hpp"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <cerrno>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <new>
#include <string_view>

// NOLINTBEGIN(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp,readability-identifier-naming)
extern "C" {
void* __libc_malloc(std::size_t size);
void* __libc_calloc(std::size_t count, std::size_t size);
void* __libc_realloc(void* memory, std::size_t size);
void* __libc_memalign(std::size_t alignment, std::size_t size);
}
// NOLINTEND(bugprone-reserved-identifier,cert-dcl37-c,cert-dcl51-cpp,readability-identifier-naming)

namespace groma::latency {
namespace {

AllocationCounts unmapped;
AllocationCounts* counts = &unmapped;
std::uint64_t at_input = 0;  // of main_thread, when it last read an input

// The loader's own storage for thread-local variables needs no heap.
enum class Thread : char { kUnknown, kMain, kOther };
__attribute__((tls_model("initial-exec"))) thread_local Thread thread = Thread::kUnknown;

bool is_main_thread() noexcept {
  if (thread == Thread::kUnknown)
    thread = ::syscall(SYS_gettid) == ::syscall(SYS_getpid) ? Thread::kMain : Thread::kOther;
  return thread == Thread::kMain;
}

void* count(void* memory) noexcept {
  auto& of = is_main_thread() ? counts->main_thread : counts->other_threads;
  of.fetch_add(1, std::memory_order_relaxed);
  return memory;
}

void note_input(ssize_t bytes) noexcept {
  if (bytes > 0 && is_main_thread()) at_input = counts->main_thread;
}

void note_output(const void* bytes, std::size_t size) noexcept {
  constexpr std::string_view kPose = R"({"class":"POSE",)";
  if (!is_main_thread() || size < kPose.size() || std::memcmp(bytes, kPose.data(), kPose.size()) != 0) return;
  const std::uint64_t now = counts->main_thread;
  counts->in_poses.fetch_add(now - at_input, std::memory_order_relaxed);
  counts->poses.fetch_add(1, std::memory_order_relaxed);
  at_input = now;
}

__attribute__((constructor)) void map_counts() {
  const char* const path = std::getenv(kCountsVariable);
  const int fd = path == nullptr ? -1 : ::open(path, O_RDWR | O_CLOEXEC);
  if (fd < 0) return;
  void* const memory = ::mmap(nullptr, sizeof(AllocationCounts), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  ::close(fd);
  if (memory != MAP_FAILED) counts = new (memory) AllocationCounts;
}

}  // namespace
}  // namespace groma::latency

using groma::latency::count;

extern "C" {

void* malloc(std::size_t size) noexcept {
  return count(__libc_malloc(size));
}
void* calloc(std::size_t number, std::size_t size) noexcept {
  return count(__libc_calloc(number, size));
}
void* realloc(void* memory, std::size_t size) noexcept {
  return count(__libc_realloc(memory, size));
}
void* memalign(std::size_t alignment, std::size_t size) noexcept {
  return count(__libc_memalign(alignment, size));
}
void* aligned_alloc(std::size_t alignment, std::size_t size) noexcept {
  return count(__libc_memalign(alignment, size));
}
int posix_memalign(void** memory, std::size_t alignment, std::size_t size) noexcept {
  *memory = count(__libc_memalign(alignment, size));
  return *memory == nullptr ? ENOMEM : 0;
}

ssize_t read(int fd, void* buffer, std::size_t size) {
  const ssize_t bytes = ::syscall(SYS_read, fd, buffer, size);
  groma::latency::note_input(bytes);
  return bytes;
}
ssize_t recv(int fd, void* buffer, std::size_t size, int flags) {
  const ssize_t bytes = ::syscall(SYS_recvfrom, fd, buffer, size, flags, nullptr, nullptr);
  groma::latency::note_input(bytes);
  return bytes;
}
ssize_t send(int fd, const void* bytes, std::size_t size, int flags) {
  groma::latency::note_output(bytes, size);
  return ::syscall(SYS_sendto, fd, bytes, size, flags, nullptr, 0);
}

}  // extern "C"
