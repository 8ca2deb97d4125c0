// Heap use of the program's own objects. Link with live_heap.cpp and allocations.cpp, and with the linker's
// --wrap for malloc, calloc, realloc, posix_memalign and free. Allocations of shared libraries are not
// counted.
#pragma once

#include <cstddef>

namespace groma::test {

// Sets the current heap use as the zero level, and resets the peak.
void watch_heap() noexcept;
// The peak heap use since watch_heap(), above its zero level, in bytes.
[[nodiscard]] std::size_t peak_heap_bytes() noexcept;

}  // namespace groma::test
