#include "host/daemon/memory_lock.hpp"

#include <fmt/format.h>
#include <linux/capability.h>
#include <malloc.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <cerrno>
#include <system_error>

namespace groma::daemon {
namespace {

// CAP_IPC_LOCK exempts from the limit.
bool is_exempt() {
  __user_cap_header_struct header{.version = _LINUX_CAPABILITY_VERSION_3, .pid = 0};
  __user_cap_data_struct data[_LINUX_CAPABILITY_U32S_3]{};
  if (::syscall(SYS_capget, &header, data) != 0) return false;
  return (data[CAP_TO_INDEX(CAP_IPC_LOCK)].effective & CAP_TO_MASK(CAP_IPC_LOCK)) != 0;
}

}  // namespace

std::string lock_memory() {
  // The allocator's value at the start, but fixed: larger blocks go back to the system when they are freed.
  // It cannot trim locked memory, because madvise() fails there.
  constexpr int kLargeBlock = 128 * 1024;
  ::mallopt(M_MMAP_THRESHOLD, kLargeBlock);
  rlimit limit{};
  ::getrlimit(RLIMIT_MEMLOCK, &limit);
  limit.rlim_cur = limit.rlim_max;
  ::setrlimit(RLIMIT_MEMLOCK, &limit);
  if (limit.rlim_max != RLIM_INFINITY && !is_exempt()) {
    return fmt::format(
        "memory is not locked, because the limit is {} KiB: if this computer swaps, poses can be late; set "
        "LimitMEMLOCK=infinity in the systemd unit, or 'ulimit -l unlimited'",
        limit.rlim_max / 1024);
  }
  // First with all pages that there are. From then on a page is locked when it is first used: the stacks of
  // threads are large.
  if (::mlockall(MCL_CURRENT) != 0 || ::mlockall(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT) != 0) {
    return fmt::format("memory is not locked ({}): if this computer swaps, poses can be late",
                       std::generic_category().message(errno));
  }
  return {};
}

}  // namespace groma::daemon
