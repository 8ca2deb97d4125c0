// Counts what the program takes from the heap.
#pragma once

#include <cstddef>

namespace groma::test {

// Calls of operator new since the program began. Linked with allocations.cpp.
std::size_t allocations();

}  // namespace groma::test
