// How much of the heap the program's own objects hold. Linked with live_heap.cpp and allocations.cpp, and
// with the linker's --wrap for malloc, calloc, realloc, posix_memalign and free: what shared libraries take
// for themselves is not in it.
#pragma once

#include <cstddef>

namespace groma::test {

// Takes what is held now for nothing.
void watch_heap() noexcept;
// The most that has been held since, in bytes.
[[nodiscard]] std::size_t peak_heap_bytes() noexcept;

}  // namespace groma::test
