// A network of the test's own: a loopback interface and one end of a virtual cable, whose other end is up but
// leads nowhere. So nothing that DDS sends leaves this computer, and several tests at once do not see each
// other.
#pragma once

#include <fmt/format.h>
#include <sched.h>
#include <sys/wait.h>
#include <unistd.h>

#include <csignal>
#include <cstdlib>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

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

// A second computer, at the other end of the cable, while this object exists. After
// enter_network_namespace().
class OtherHost {
 public:
  OtherHost() : pid_(::fork()) {
    if (pid_ == 0) {
      if (::unshare(CLONE_NEWNET) != 0) ::_exit(1);
      ::raise(SIGSTOP);
      ::_exit(0);
    }
    int status = 0;
    if (::waitpid(pid_, &status, WUNTRACED) != pid_ || !WIFSTOPPED(status))
      throw std::runtime_error("no second network namespace");
    if (!run(fmt::format("ip link set test1 netns {0} && nsenter -n -t {0} sh -c 'ip link set lo up && "
                         "ip addr add 198.51.100.3/24 dev test1 && ip link set test1 up'",
                         pid_)))
      throw std::runtime_error("the cable cannot be moved to the second network namespace");
  }
  ~OtherHost() {
    run(fmt::format("nsenter -n -t {} ip link set test1 netns {} && ip link set test1 up", pid_, ::getpid()));
    ::kill(pid_, SIGKILL);
    ::waitpid(pid_, nullptr, 0);
  }
  OtherHost(const OtherHost&) = delete;
  OtherHost& operator=(const OtherHost&) = delete;

  // Comes before the words of a command that is to run there.
  [[nodiscard]] std::vector<std::string> prefix() const {
    return {"nsenter", "-n", "-t", std::to_string(pid_)};
  }

 private:
  static bool run(const std::string& command) {
    return std::system(command.c_str()) == 0;  // NOLINT(cert-env33-c)
  }

  pid_t pid_;
};

}  // namespace groma::test
