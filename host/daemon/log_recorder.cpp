#include "host/daemon/log_recorder.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <system_error>
#include <utility>

#include "host/io/error.hpp"
#include "host/io/output_file.hpp"

namespace groma::daemon {
namespace {

std::string reason(int error) {
  return std::generic_category().message(error);
}

// Of the disk, a quota or the file.
bool is_full(int error) {
  return error == ENOSPC || error == EDQUOT || error == EFBIG;
}

// 0, or the error.
int append(int fd, std::string_view bytes) {
  while (!bytes.empty()) {
    const ssize_t n = ::write(fd, bytes.data(), bytes.size());
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) return errno;
    bytes.remove_prefix(static_cast<std::size_t>(n));
  }
  return 0;
}

std::uint64_t unix_time_ns() {
  const auto now = std::chrono::system_clock::now().time_since_epoch();
  return static_cast<std::uint64_t>(std::chrono::duration_cast<std::chrono::nanoseconds>(now).count());
}

}  // namespace

LogRecorder::LogRecorder(const std::filesystem::path& path, std::vector<io::DescriptionFile> description)
    : path_(path), description_(std::move(description)) {
  if (const int error = begin(); error != 0) {
    failed_ = true;
    failure_ = fmt::format("{}: cannot be written ({}); nothing is recorded", path_.string(), reason(error));
    return;
  }
  writer_ = std::thread([this] { write_loop(); });
}

int LogRecorder::begin() {
  io::expect_writable(path_);
  file_ = io::Descriptor(::open(path_.c_str(), O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644));
  if (!file_.valid()) {
    const int error = errno;
    if (is_full(error)) return error;
    if (error == EACCES || error == EPERM || error == EROFS) {
      throw io::PermissionError({path_}, fmt::format("cannot be written ({})", reason(error)),
                                "choose a file that this user may write to");
    }
    throw io::DeviceError({path_}, fmt::format("cannot be written ({})", reason(error)),
                          "choose another file for `log`");
  }
  if (::flock(file_.get(), LOCK_EX | LOCK_NB) != 0) {
    throw io::DeviceError({path_}, "another program records into it",
                          "stop it, or choose another file for `log`");
  }
  encoder_.begin_section(description_, unix_time_ns());
  const int error = append(file_.get(), encoder_.take());
  if (error != 0 && !is_full(error)) {
    throw io::DeviceError({path_}, fmt::format("cannot be written ({})", reason(error)),
                          "check the device, or choose another file for `log`");
  }
  return error;
}

LogRecorder::~LogRecorder() {
  encoder_.flush();
  hand_over();
  {
    const std::lock_guard lock(mutex_);
    ending_ = true;
  }
  changed_.notify_one();
  if (writer_.joinable()) writer_.join();
}

void LogRecorder::on_clock_set() {
  encoder_.begin_section(description_, unix_time_ns());
}

void LogRecorder::advance(double now_s) {
  if (now_s < next_write_s_) return;
  next_write_s_ = now_s + kWriteEvery_s;
  encoder_.flush();
  hand_over();
}

std::optional<std::string> LogRecorder::take_failure() {
  const std::lock_guard lock(mutex_);
  return std::exchange(failure_, std::nullopt);
}

void LogRecorder::hand_over() {
  const std::string bytes = encoder_.take();
  {
    const std::lock_guard lock(mutex_);
    if (failed_) return;
    if (waiting_.size() + bytes.size() > kMaxWaiting) {
      failed_ = true;
      failure_ = fmt::format("{}: the disk is too slow; the recording has ended", path_.string());
      return;
    }
    waiting_ += bytes;
  }
  changed_.notify_one();
}

void LogRecorder::write_loop() {
  using Clock = std::chrono::steady_clock;
  Clock::time_point next_sync = Clock::now();
  std::unique_lock lock(mutex_);
  while (true) {
    changed_.wait(lock, [this] { return ending_ || !waiting_.empty(); });
    const std::string bytes = std::exchange(waiting_, {});
    if (bytes.empty() && ending_) return;
    lock.unlock();
    const int error = append(file_.get(), bytes);
    if (error == 0 && Clock::now() >= next_sync) {
      ::fdatasync(file_.get());
      next_sync = Clock::now() +
                  std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(kSyncEvery_s));
    }
    lock.lock();
    if (error != 0 && !failed_) {
      failed_ = true;
      failure_ =
          fmt::format("{}: cannot be written ({}); the recording has ended", path_.string(), reason(error));
    }
  }
}

}  // namespace groma::daemon
