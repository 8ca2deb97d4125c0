// Runs a program to its end and captures its exit code and output.
#pragma once

#include <fcntl.h>
#include <poll.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <csignal>
#include <cstdlib>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace groma::test {

struct ChildOptions {
  std::optional<rlim_t> max_file_bytes{};   // file size limit: simulates a full disk
  std::string stdout_path{};                // redirects standard output; ChildResult::out is then empty
  std::optional<unsigned> kill_after_us{};  // by SIGKILL
};

struct ChildResult {
  int exit_code = -1;  // -1: ended by a signal
  std::string out;
  std::string err;
};

// arguments[0] is the program's path. There is no timeout except the test's own.
inline ChildResult run_child(const std::vector<std::string>& arguments, const ChildOptions& options = {}) {
  std::array<int, 2> out{};
  std::array<int, 2> err{};
  if (::pipe(out.data()) != 0 || ::pipe(err.data()) != 0) throw std::runtime_error("no pipe");
  std::vector<std::string> copies = arguments;
  std::vector<char*> argv;
  argv.reserve(copies.size() + 1);
  for (std::string& argument : copies) argv.push_back(argument.data());
  argv.push_back(nullptr);

  const pid_t child = ::fork();
  if (child < 0) throw std::runtime_error("no process");
  if (child == 0) {
    const int out_fd = options.stdout_path.empty() ? out[1] : ::open(options.stdout_path.c_str(), O_WRONLY);
    ::dup2(out_fd, STDOUT_FILENO);
    ::dup2(err[1], STDERR_FILENO);
    for (const int fd : {out[0], out[1], err[0], err[1]}) ::close(fd);
    if (options.max_file_bytes) {
      const rlimit limit{*options.max_file_bytes, *options.max_file_bytes};
      ::setrlimit(RLIMIT_FSIZE, &limit);
    }
    ::execv(argv[0], argv.data());
    ::_exit(127);
  }
  ::close(out[1]);
  ::close(err[1]);
  if (options.kill_after_us) {
    ::usleep(*options.kill_after_us);
    ::kill(child, SIGKILL);
  }

  ChildResult result;
  std::array<pollfd, 2> streams{{{out[0], POLLIN, 0}, {err[0], POLLIN, 0}}};
  std::array<std::string*, 2> texts{&result.out, &result.err};
  std::array<char, 65536> buffer{};
  for (int open_streams = 2; open_streams > 0;) {
    if (::poll(streams.data(), streams.size(), -1) < 0) break;
    for (std::size_t i = 0; i < streams.size(); ++i) {
      if (streams.at(i).fd < 0 || streams.at(i).revents == 0) continue;
      const ssize_t count = ::read(streams.at(i).fd, buffer.data(), buffer.size());
      if (count > 0) {
        texts.at(i)->append(buffer.data(), static_cast<std::size_t>(count));
      } else {
        streams.at(i).fd = -1;
        --open_streams;
      }
    }
  }
  ::close(out[0]);
  ::close(err[0]);
  int status = 0;
  ::waitpid(child, &status, 0);
  if (WIFEXITED(status)) result.exit_code = WEXITSTATUS(status);
  return result;
}

}  // namespace groma::test
