#include "host/daemon/log_output.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <unistd.h>

#include <cerrno>
#include <condition_variable>
#include <csignal>
#include <mutex>
#include <string>
#include <thread>
#include <utility>

namespace groma::daemon {
namespace {

// What cannot be written is lost.
void write_all(int fd, std::string_view bytes) {
  while (!bytes.empty()) {
    const ssize_t n = ::write(fd, bytes.data(), bytes.size());
    if (n >= 0) {
      bytes.remove_prefix(static_cast<std::size_t>(n));
    } else if (errno == EAGAIN) {
      pollfd room{fd, POLLOUT, 0};
      ::poll(&room, 1, -1);
    } else if (errno != EINTR) {
      return;
    }
  }
}

}  // namespace

struct LogOutput::State {
  // Until `ending`, and all lines are written.
  void run() {
    std::unique_lock lock(mutex);
    while (true) {
      changed.wait(lock, [this] { return ending || !waiting.empty(); });
      if (waiting.empty()) break;
      if (const std::size_t count = std::exchange(left_out, 0); count > 0)
        append(fmt::format("{} lines are missing here, because stderr was not read", count));
      const std::string lines = std::exchange(waiting, {});
      lock.unlock();
      write_all(fd, lines);
      lock.lock();
    }
    ended = true;
    changed.notify_all();
  }

  void append(std::string_view line) {
    waiting += "gromad: ";
    waiting += line;
    waiting += '\n';
  }

  int fd = -1;
  std::mutex mutex;
  std::condition_variable changed;
  std::string waiting;
  std::size_t left_out = 0;  // lines
  bool ending = false;
  bool ended = false;
};

LogOutput::LogOutput(int fd) : state_(std::make_shared<State>()) {
  state_->fd = fd;
  // The thread inherits the mask: signals are for the others.
  sigset_t all;
  sigset_t before;
  sigfillset(&all);
  pthread_sigmask(SIG_SETMASK, &all, &before);
  std::thread([state = state_] { state->run(); }).detach();
  pthread_sigmask(SIG_SETMASK, &before, nullptr);
}

LogOutput::~LogOutput() {
  std::unique_lock lock(state_->mutex);
  state_->ending = true;
  state_->changed.notify_all();
  state_->changed.wait_for(lock, kPatience, [this] { return state_->ended; });
}

void LogOutput::write(std::string_view line) {
  const std::lock_guard lock(state_->mutex);
  if (state_->waiting.size() + line.size() >= kMaxWaiting) {
    ++state_->left_out;
    return;
  }
  state_->append(line);
  state_->changed.notify_all();
}

}  // namespace groma::daemon
