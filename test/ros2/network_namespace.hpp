// A network of the test's own: a loopback interface and one end of a virtual cable, whose other end is up but
// leads nowhere. So nothing that DDS sends leaves this computer, and several tests at once do not see each
// other.
#pragma once

#include <sched.h>
#include <unistd.h>

#include <cstdlib>
#include <fstream>
#include <string>

namespace groma::test {

// Of this process and its children; call it before threads are started. False if that is not permitted here.
inline bool enter_network_namespace() {
  const uid_t user = ::geteuid();
  const gid_t group = ::getegid();
  if (::unshare(CLONE_NEWNET | (user == 0 ? 0 : CLONE_NEWUSER)) != 0) return false;
  if (user != 0) {
    std::ofstream("/proc/self/setgroups") << "deny";
    std::ofstream("/proc/self/uid_map") << "0 " << user << " 1";
    std::ofstream("/proc/self/gid_map") << "0 " << group << " 1";
  }
  return std::system(
             "ip link set lo up && ip link add test0 type veth peer name test1 && "  // NOLINT(cert-env33-c)
             "ip addr add 198.51.100.2/24 dev test0 && ip link set test0 up && ip link set test1 up && "
             "ip route add default dev test0") == 0;
}

}  // namespace groma::test
