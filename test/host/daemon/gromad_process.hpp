// gromad as a process, and a client of its pose stream, for tests. GROMAD_PATH is the program.
#pragma once

#include <fcntl.h>
#include <sys/resource.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include <nlohmann/json.hpp>

#include "host/io/descriptor.hpp"
#include "test/support/tcp_client.hpp"

namespace groma::daemon::test {

using groma::test::TcpClient;

constexpr auto kPatience = std::chrono::seconds(40);

// A gromad process; killed at the end if it still runs.
class Gromad {
 public:
  // as_nobody: drops root's rights if the test has them. max_file_bytes: as of ulimit -f.
  explicit Gromad(const std::vector<std::string>& arguments, bool as_nobody = false,
                  std::optional<rlim_t> max_file_bytes = {}) {
    int pipe_ends[2];
    if (::pipe2(pipe_ends, O_CLOEXEC) != 0) throw std::runtime_error("pipe2");
    std::vector<const char*> argv{GROMAD_PATH};
    for (const std::string& argument : arguments) argv.push_back(argument.c_str());
    argv.push_back(nullptr);
    pid_ = ::fork();
    if (pid_ == 0) {
      ::dup2(pipe_ends[1], STDERR_FILENO);
      ::dup2(pipe_ends[1], STDOUT_FILENO);
      if (as_nobody && ::geteuid() == 0 && (::setgid(65534) != 0 || ::setuid(65534) != 0)) ::_exit(126);
      if (max_file_bytes) {
        const rlimit limit{*max_file_bytes, *max_file_bytes};
        ::setrlimit(RLIMIT_FSIZE, &limit);
      }
      ::execv(GROMAD_PATH, const_cast<char* const*>(argv.data()));
      ::_exit(127);
    }
    ::close(pipe_ends[1]);
    errors_ = io::Descriptor(pipe_ends[0]);
    ::fcntl(errors_.get(), F_SETFL, O_NONBLOCK);
  }
  Gromad(const Gromad&) = delete;
  Gromad& operator=(const Gromad&) = delete;
  ~Gromad() {
    if (!exit_code_) {
      ::kill(pid_, SIGKILL);
      ::waitpid(pid_, nullptr, 0);
    }
  }

  // Nothing more fits into the pipe of its output.
  void fill_log() const {
    const io::Descriptor end(::open(("/proc/self/fd/" + std::to_string(errors_.get())).c_str(),
                                    O_WRONLY | O_NONBLOCK | O_CLOEXEC));
    const std::string line(100, '.');
    while (::write(end.get(), line.data(), line.size()) > 0) continue;
    while (::write(end.get(), line.data(), 1) > 0) continue;
  }

  [[nodiscard]] pid_t pid() const { return pid_; }
  void terminate() const { ::kill(pid_, SIGTERM); }
  void hang_up() const { ::kill(pid_, SIGHUP); }

  // Its whole output so far.
  const std::string& log() {
    char buffer[4096];
    ssize_t n = 0;
    while ((n = ::read(errors_.get(), buffer, sizeof(buffer))) > 0)
      log_.append(buffer, static_cast<std::size_t>(n));
    return log_;
  }

  bool running() {
    if (exit_code_) return false;
    int status = 0;
    if (::waitpid(pid_, &status, WNOHANG) != pid_) return true;
    exit_code_ = WIFEXITED(status) ? WEXITSTATUS(status) : -WTERMSIG(status);
    return false;
  }

  // Waits until it exits; none after kPatience.
  std::optional<int> exit_code() {
    const auto deadline = std::chrono::steady_clock::now() + kPatience;
    while (running() && std::chrono::steady_clock::now() < deadline) {
      log();
      std::this_thread::sleep_for(std::chrono::milliseconds(5));
    }
    log();
    return exit_code_;
  }

 private:
  pid_t pid_ = -1;
  io::Descriptor errors_;
  std::string log_;
  std::optional<int> exit_code_;
};

// Objects of the pose stream.
class StreamClient {
 public:
  explicit StreamClient(std::uint16_t port) : client_(port) {}

  std::vector<nlohmann::json> read() {
    text_ += client_.receive();
    std::vector<nlohmann::json> objects;
    std::size_t end = 0;
    while ((end = text_.find('\n')) != std::string::npos) {
      objects.push_back(nlohmann::json::parse(text_.substr(0, end)));
      if (objects.back().at("class") == "POSE") pose_lines_.append(text_, 0, end + 1);
      text_.erase(0, end + 1);
    }
    return objects;
  }

  // The POSE lines that were read, byte for byte.
  [[nodiscard]] const std::string& pose_lines() const noexcept { return pose_lines_; }

 private:
  TcpClient client_;
  std::string text_;  // an incomplete line
  std::string pose_lines_;
};

// The port of that server, once gromad's log names it.
inline std::optional<std::uint16_t> port_in_log(Gromad& gromad, const std::string& server) {
  const std::string key = server + " on 127.0.0.1 port ";
  const std::string& log = gromad.log();
  const std::size_t at = log.find(key);
  if (at == std::string::npos || log.find('\n', at) == std::string::npos) return std::nullopt;
  return static_cast<std::uint16_t>(std::stoi(log.substr(at + key.size())));
}

inline std::optional<std::uint16_t> pose_stream_port(Gromad& gromad) {
  return port_in_log(gromad, "pose stream");
}

}  // namespace groma::daemon::test
