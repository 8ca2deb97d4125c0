// Keeps gromad's memory out of the swap, so that no pose waits for the disk.
#pragma once

#include <string>

namespace groma::daemon {

// Locks the memory that the process has and will have, and lets freed memory go back to the system. Returns a
// warning if that is not permitted; empty: locked. Without an unlimited right to lock nothing is locked: an
// allocation beyond the limit would fail later.
[[nodiscard]] std::string lock_memory();

}  // namespace groma::daemon
