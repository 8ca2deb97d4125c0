#include "host/cli/terminal.hpp"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <csignal>
#include <cstdio>
#include <mutex>
#include <system_error>
#include <thread>
#include <utility>

#include "host/io/error.hpp"

namespace groma::cli {

namespace {

[[noreturn]] void throw_output_error(int error) {
  throw io::DeviceError({"standard output"},
                        fmt::format("cannot be written ({})", std::generic_category().message(error)),
                        "check its destination");
}

// The line of the heartbeat. A thread draws it, so that no action has to.
class StatusLine {
 public:
  void begin(std::string action) {
    if (::isatty(STDERR_FILENO) != 1) return;
    action_ = std::move(action);
    runs_ = true;
    // Signals are for the thread that runs the action.
    sigset_t all;
    sigset_t before;
    sigfillset(&all);
    ::pthread_sigmask(SIG_BLOCK, &all, &before);
    thread_ = std::thread([this] { draw(); });
    ::pthread_sigmask(SIG_SETMASK, &before, nullptr);
  }
  void end() {
    if (!thread_.joinable()) return;
    {
      const std::lock_guard lock(mutex_);
      runs_ = false;
    }
    ended_.notify_one();
    thread_.join();
    clear();
  }
  void show(std::string_view phase, std::optional<double> done) {
    const std::lock_guard lock(mutex_);
    phase_ = phase;
    done_ = done;
  }
  void clear() {
    const std::lock_guard lock(mutex_);
    if (std::exchange(is_drawn_, false)) fmt::print(stderr, "\r\033[K");
  }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr std::chrono::milliseconds kFirst{2000};
  static constexpr std::chrono::milliseconds kNext{250};

  void draw() {
    const Clock::time_point begin = Clock::now();
    std::unique_lock lock(mutex_);
    for (auto wait = kFirst; !ended_.wait_for(lock, wait, [this] { return !runs_; }); wait = kNext) {
      const double elapsed_s = std::chrono::duration<double>(Clock::now() - begin).count();
      fmt::print(stderr, "\r\033[K{}{}, {:.0f} s", action_, progress(), std::floor(elapsed_s));
      std::fflush(stderr);
      is_drawn_ = true;
    }
  }
  [[nodiscard]] std::string progress() const {
    constexpr int kWidth = 30;
    std::string text = phase_.empty() ? "" : ": " + phase_;
    if (!done_) return text;
    const int filled = static_cast<int>(std::lround(std::clamp(*done_, 0.0, 1.0) * kWidth));
    return text + fmt::format(" [{:<{}}] {:3.0f} %", std::string(static_cast<std::size_t>(filled), '#'),
                              kWidth, 100.0 * *done_);
  }

  std::mutex mutex_;
  std::condition_variable ended_;
  std::thread thread_;
  std::string action_;
  std::string phase_;
  std::optional<double> done_;
  bool runs_ = false;
  bool is_drawn_ = false;
};

StatusLine& status_line() {
  static StatusLine line;
  return line;
}

}  // namespace

Heartbeat::Heartbeat(std::string action) {
  status_line().begin(std::move(action));
}

Heartbeat::~Heartbeat() {
  status_line().end();
}

void show_progress(std::string_view phase, std::optional<double> done) {
  status_line().show(phase, done);
}

void stop_heartbeat() {
  status_line().end();
}

void say(std::string_view text) {
  status_line().clear();
  if (std::fwrite(text.data(), 1, text.size(), stdout) != text.size()) throw_output_error(errno);
}

void flush_output() {
  if (std::fflush(stdout) != 0) throw_output_error(errno);
}

void complain(std::string_view text) {
  status_line().clear();
  fmt::print(stderr, "groma: {}\n", text);
}

std::string Table::format(bool text_last) const {
  std::vector<std::size_t> widths(rows_.front().size(), 0);
  for (const auto& row : rows_) {
    for (std::size_t i = 0; i < row.size(); ++i) widths[i] = std::max(widths[i], row[i].size());
  }
  std::string text;
  for (const auto& row : rows_) {
    std::string line;
    for (std::size_t i = 0; i < row.size(); ++i) {
      const bool left = i == 0 || (text_last && i + 1 == row.size());
      if (i > 0) line += "  ";
      line += left ? fmt::format("{:<{}}", row[i], widths[i]) : fmt::format("{:>{}}", row[i], widths[i]);
    }
    line.erase(line.find_last_not_of(' ') + 1);
    text += line + '\n';
  }
  return text;
}

}  // namespace groma::cli
