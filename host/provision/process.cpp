#include "host/provision/process.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/prctl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <csignal>
#include <cstdlib>
#include <system_error>

#include "host/io/descriptor.hpp"
#include "host/io/error.hpp"

namespace groma::provision {

namespace {

[[noreturn]] void fail(const std::string& program, int error) {
  throw io::DeviceError({program},
                        fmt::format("cannot be started ({})", std::generic_category().message(error)),
                        "check that it is a program of this computer");
}

struct Pipe {
  io::Descriptor read;
  io::Descriptor write;
};

Pipe make_pipe(const std::string& program) {
  std::array<int, 2> ends{};
  if (::pipe2(ends.data(), O_CLOEXEC) != 0) fail(program, errno);
  return {io::Descriptor(ends[0]), io::Descriptor(ends[1])};
}

bool is_program(const std::filesystem::path& path) {
  std::error_code error;
  return std::filesystem::is_regular_file(path, error) && ::access(path.c_str(), X_OK) == 0;
}

// In the child: only calls that are safe between fork and exec.
[[noreturn]] void exec_child(char* const* argv, int output, int failure, pid_t parent) {
  // OpenOCD defers SIGTERM until it is done, and the next run would find the probe in use.
  (void)::prctl(PR_SET_PDEATHSIG, SIGKILL);
  if (::getppid() != parent) ::_exit(127);
  ::dup2(output, STDOUT_FILENO);
  ::dup2(output, STDERR_FILENO);
  const int input = ::open("/dev/null", O_RDONLY);
  if (input >= 0) ::dup2(input, STDIN_FILENO);
  // Ignored signals stay ignored after exec.
  (void)::signal(SIGPIPE, SIG_DFL);
  (void)::signal(SIGXFSZ, SIG_DFL);
  ::execv(argv[0], argv);
  const int error = errno;
  (void)!::write(failure, &error, sizeof error);
  ::_exit(127);
}

}  // namespace

ProcessResult run_process(const std::vector<std::string>& arguments,
                          const std::function<void(std::string_view)>& on_line) {
  std::vector<std::string> copies = arguments;
  std::vector<char*> argv;
  argv.reserve(copies.size() + 1);
  for (std::string& argument : copies) argv.push_back(argument.data());
  argv.push_back(nullptr);

  Pipe output = make_pipe(arguments.front());
  Pipe failure = make_pipe(arguments.front());
  const pid_t parent = ::getpid();
  const pid_t child = ::fork();
  if (child < 0) fail(arguments.front(), errno);
  if (child == 0) exec_child(argv.data(), output.write.get(), failure.write.get(), parent);
  output.write.close();
  failure.write.close();

  ProcessResult result;
  std::array<char, 4096> chunk{};
  std::size_t seen = 0;
  for (;;) {
    const ssize_t count = ::read(output.read.get(), chunk.data(), chunk.size());
    if (count < 0 && errno == EINTR) continue;
    if (count <= 0) break;
    result.output.append(chunk.data(), static_cast<std::size_t>(count));
    for (std::size_t end = 0; (end = result.output.find('\n', seen)) != std::string::npos; seen = end + 1) {
      if (on_line) on_line(std::string_view(result.output).substr(seen, end - seen));
    }
  }
  int status = 0;
  while (::waitpid(child, &status, 0) < 0 && errno == EINTR) {
  }
  int error = 0;
  if (::read(failure.read.get(), &error, sizeof error) == static_cast<ssize_t>(sizeof error)) {
    fail(arguments.front(), error);
  }
  if (WIFEXITED(status)) result.exit_code = WEXITSTATUS(status);
  return result;
}

std::optional<std::filesystem::path> find_program(const std::string& name) {
  if (name.find('/') != std::string::npos) {
    return is_program(name) ? std::optional<std::filesystem::path>(name) : std::nullopt;
  }
  const char* path = std::getenv("PATH");
  std::string_view folders = path != nullptr ? path : "";
  while (!folders.empty()) {
    const std::size_t end = folders.find(':');
    const std::filesystem::path candidate = std::filesystem::path(folders.substr(0, end)) / name;
    if (is_program(candidate)) return candidate;
    folders.remove_prefix(end == std::string_view::npos ? folders.size() : end + 1);
  }
  return std::nullopt;
}

}  // namespace groma::provision
