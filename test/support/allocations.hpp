// Counts the program's heap allocations.
#pragma once

#include <cstddef>

namespace groma::test {

// Calls of operator new since the program began. Linked with allocations.cpp.
std::size_t allocations();

}  // namespace groma::test
