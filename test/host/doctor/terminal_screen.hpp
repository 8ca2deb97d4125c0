// A program on a pseudo-terminal, and what its screen shows: the codes of ECMA-48 that groma monitor uses.
#pragma once

#include <fcntl.h>
#include <poll.h>
#include <pty.h>
#include <sys/ioctl.h>
#include <sys/wait.h>
#include <termios.h>
#include <unistd.h>

#include <algorithm>
#include <csignal>
#include <cstdlib>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "host/io/descriptor.hpp"

namespace groma::doctor::test {

class TerminalProgram {
 public:
  TerminalProgram(const std::vector<std::string>& arguments, unsigned short rows, unsigned short columns,
                  const std::vector<std::pair<std::string, std::string>>& environment = {})
      : screen_(rows, std::string(columns, ' ')) {
    winsize size{rows, columns, 0, 0};
    std::vector<const char*> argv;
    argv.reserve(arguments.size() + 1);
    for (const std::string& argument : arguments) argv.push_back(argument.c_str());
    argv.push_back(nullptr);
    int master = -1;
    pid_ = ::forkpty(&master, nullptr, nullptr, &size);
    if (pid_ < 0) throw std::runtime_error("forkpty");
    if (pid_ == 0) {
      ::setenv("TERM", "xterm", 1);
      ::unsetenv("NO_COLOR");
      for (const auto& [name, value] : environment) ::setenv(name.c_str(), value.c_str(), 1);
      ::execv(argv.front(), const_cast<char* const*>(argv.data()));
      ::_exit(127);
    }
    master_ = io::Descriptor(master);
    ::fcntl(master, F_SETFL, O_NONBLOCK);
    ::fcntl(master, F_SETFD, FD_CLOEXEC);
  }
  TerminalProgram(const TerminalProgram&) = delete;
  TerminalProgram& operator=(const TerminalProgram&) = delete;
  ~TerminalProgram() {
    if (running()) {
      ::kill(pid_, SIGKILL);
      ::waitpid(pid_, nullptr, 0);
    }
  }

  void resize(unsigned short rows, unsigned short columns) {
    winsize size{rows, columns, 0, 0};
    ::ioctl(master_.get(), TIOCSWINSZ, &size);
    screen_.assign(rows, std::string(columns, ' '));
    row_ = column_ = 0;
  }
  void type(const std::string& keys) const {
    static_cast<void>(!::write(master_.get(), keys.data(), keys.size()));
  }
  [[nodiscard]] termios settings() const {
    termios out{};
    ::tcgetattr(master_.get(), &out);
    return out;
  }

  // Takes what the program has written.
  void update() {
    char buffer[4096];
    ssize_t n = 0;
    while ((n = ::read(master_.get(), buffer, sizeof(buffer))) > 0) {
      output_.append(buffer, static_cast<std::size_t>(n));
    }
    while (taken_ < output_.size() && take()) {
    }
  }
  bool running() {
    if (exit_code_) return false;
    int status = 0;
    if (::waitpid(pid_, &status, WNOHANG) != pid_) return true;
    exit_code_ = WIFEXITED(status) ? WEXITSTATUS(status) : -WTERMSIG(status);
    return false;
  }
  [[nodiscard]] std::optional<int> exit_code() const { return exit_code_; }

  // All that it has written.
  [[nodiscard]] const std::string& output() const { return output_; }
  // The last complete frame, without spaces at the ends of lines.
  [[nodiscard]] std::string screen() const {
    std::string out;
    for (std::string line : shown_) {
      line.erase(line.find_last_not_of(' ') + 1);
      out += line + '\n';
    }
    return out;
  }
  [[nodiscard]] bool is_alternate() const { return alternate_; }
  // Lines that were longer than the screen, and line feeds on its last line.
  [[nodiscard]] int overflows() const { return overflows_; }
  void forget_overflows() { overflows_ = 0; }
  // How often the cursor went to the top left.
  [[nodiscard]] int frames() const { return frames_; }

 private:
  // The next character or code; false if it is incomplete.
  bool take() {
    const char c = output_.at(taken_);
    if (c == '\x1b') return take_code();
    ++taken_;
    if (c == '\r') {
      column_ = 0;
    } else if (c == '\n') {
      if (row_ + 1 < screen_.size()) {
        ++row_;
      } else {
        ++overflows_;
      }
    } else if (column_ < screen_.at(row_).size()) {
      screen_.at(row_).at(column_++) = c;
    } else {
      ++overflows_;
    }
    return true;
  }
  bool take_code() {
    std::size_t end = taken_ + 2;
    while (end < output_.size() && (output_[end] < '@' || output_[end] > '~')) ++end;
    if (end >= output_.size()) return false;
    const std::string code = output_.substr(taken_ + 2, end - taken_ - 1);
    taken_ = end + 1;
    if (code == "H") {
      shown_ = screen_;
      row_ = column_ = 0;
      ++frames_;
    }
    if (code == "K" || code == "J")
      std::fill(screen_.at(row_).begin() + position(), screen_.at(row_).end(), ' ');
    for (std::size_t row = row_ + 1; code == "J" && row < screen_.size(); ++row) {
      std::fill(screen_.at(row).begin(), screen_.at(row).end(), ' ');
    }
    if (code == "?1049h") alternate_ = true;
    if (code == "?1049l") alternate_ = false;
    return true;
  }
  [[nodiscard]] std::ptrdiff_t position() const { return static_cast<std::ptrdiff_t>(column_); }

  io::Descriptor master_;
  pid_t pid_ = -1;
  std::optional<int> exit_code_;
  std::string output_;
  std::size_t taken_ = 0;
  std::vector<std::string> screen_;  // as it is being drawn
  std::vector<std::string> shown_;   // as it was when the next frame began
  std::size_t row_ = 0;
  std::size_t column_ = 0;
  bool alternate_ = false;
  int overflows_ = 0;
  int frames_ = 0;
};

}  // namespace groma::doctor::test
