// The lines of gromad's log.
#pragma once

#include <chrono>
#include <cstddef>
#include <memory>
#include <string_view>

namespace groma::daemon {

// Writes lines to a descriptor in a thread of its own: a full pipe, a stopped terminal or a slow disk delays
// no one else.
class LogOutput {
 public:
  // Bytes that may wait. Lines beyond are left out; their number is written once there is room.
  static constexpr std::size_t kMaxWaiting = 65'536;
  // The destructor waits at most this long for the lines that wait.
  static constexpr std::chrono::milliseconds kPatience{1000};

  // The descriptor stays open, also after the destructor.
  explicit LogOutput(int fd);
  ~LogOutput();
  LogOutput(const LogOutput&) = delete;
  LogOutput& operator=(const LogOutput&) = delete;

  // Writes "gromad: " and the line, which has no line feed. From any thread.
  void write(std::string_view line);

 private:
  struct State;
  std::shared_ptr<State> state_;  // also of the thread, which may wait for the descriptor for ever
};

}  // namespace groma::daemon
