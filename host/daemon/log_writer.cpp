#include "host/daemon/log_writer.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/file.h>
#include <unistd.h>

#include <algorithm>
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

}  // namespace

io::Descriptor open_log(const std::filesystem::path& path) {
  io::expect_writable(path);
  io::Descriptor file(::open(path.c_str(), O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0644));
  if (!file.valid()) {
    const int error = errno;
    if (is_full(error)) throw DiskFull{error};
    if (error == EACCES || error == EPERM || error == EROFS) {
      throw io::PermissionError({path}, fmt::format("cannot be written ({})", reason(error)),
                                "choose a file that this user may write to");
    }
    throw io::DeviceError({path}, fmt::format("cannot be written ({})", reason(error)),
                          "choose another file for `log`");
  }
  if (::flock(file.get(), LOCK_EX | LOCK_NB) != 0) {
    throw io::DeviceError({path}, "another program records into it",
                          "stop it, or choose another file for `log`");
  }
  return file;
}

std::string LogWriter::make_buffer() {
  std::string buffer(kBuffer, '\0');
  buffer.clear();
  return buffer;
}

LogWriter::LogWriter(std::filesystem::path name, Open open, std::string_view begin)
    : name_(std::move(name)), open_(std::move(open)) {
  int error = 0;
  try {
    file_ = open_();
    error = append(file_.get(), begin);
  } catch (const DiskFull& full) {
    error = full.error;
  }
  if (error != 0 && !is_full(error)) {
    throw io::DeviceError({name_}, fmt::format("cannot be written ({})", reason(error)),
                          "check the device, or choose another file for `log`");
  }
  if (error != 0) end_with(fmt::format("cannot be written ({}); nothing is recorded", reason(error)));
  waiting_ = make_buffer();
  writer_ = std::thread([this] { write_loop(); });
}

LogWriter::~LogWriter() {
  {
    const std::lock_guard lock(mutex_);
    ending_ = true;
  }
  changed_.notify_one();
  writer_.join();
}

void LogWriter::write(std::string& bytes, bool in_next_file) {
  {
    const std::lock_guard lock(mutex_);
    if (!failed_ && waiting_.size() + bytes.size() > kMaxWaiting)
      end_with("the disk is too slow; the recording has ended");
    if (!failed_) {
      if (in_next_file) cuts_.push_back(waiting_.size());
      if (waiting_.empty()) {
        waiting_.swap(bytes);
      } else {
        waiting_ += bytes;
      }
    }
  }
  bytes.clear();
  changed_.notify_one();
}

std::optional<std::string> LogWriter::take_failure() {
  const std::lock_guard lock(mutex_);
  return std::exchange(failure_, std::nullopt);
}

void LogWriter::end_with(std::string failure) {
  failed_ = true;
  failure_ = fmt::format("{}: {}", name_.string(), failure);
}

void LogWriter::write_loop() {
  using Clock = std::chrono::steady_clock;
  Clock::time_point next_sync = Clock::now();
  std::string bytes = make_buffer();
  std::vector<std::size_t> cuts;
  std::unique_lock lock(mutex_);
  while (true) {
    changed_.wait(lock, [this] { return ending_ || !waiting_.empty(); });
    if (waiting_.empty()) return;
    bytes.clear();
    bytes.swap(waiting_);
    cuts.clear();
    cuts.swap(cuts_);
    lock.unlock();
    const std::string error = write_out(bytes, cuts);
    if (error.empty() && Clock::now() >= next_sync) {
      ::fdatasync(file_.get());
      next_sync = Clock::now() +
                  std::chrono::duration_cast<Clock::duration>(std::chrono::duration<double>(kSyncEvery_s));
    }
    lock.lock();
    if (!error.empty() && !failed_) end_with(error);
  }
}

std::string LogWriter::write_out(std::string_view bytes, const std::vector<std::size_t>& cuts) {
  std::size_t begin = 0;
  for (std::size_t i = 0; i <= cuts.size(); ++i) {
    const std::size_t end = i < cuts.size() ? cuts[i] : bytes.size();
    if (const int error = append(file_.get(), bytes.substr(begin, end - begin)); error != 0)
      return fmt::format("cannot be written ({}); the recording has ended", reason(error));
    if (i == cuts.size()) break;
    begin = end;
    try {
      file_ = open_();
    } catch (const io::Error& error) {
      return fmt::format("{}; the recording has ended", error.what());
    } catch (const DiskFull& full) {
      return fmt::format("cannot be written ({}); the recording has ended", reason(full.error));
    }
  }
  return {};
}

}  // namespace groma::daemon
