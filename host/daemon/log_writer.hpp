// Writes a log in a thread of its own, so that a slow or full disk blocks nothing else.
#pragma once

#include <condition_variable>
#include <cstddef>
#include <filesystem>
#include <functional>
#include <mutex>
#include <optional>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#include "host/io/descriptor.hpp"

namespace groma::daemon {

class LogWriter {
 public:
  // Opens the first file and, called in the thread, each next one. Throws io::Error or DiskFull.
  using Open = std::function<io::Descriptor()>;

  // Minimum period of fdatasync(2), which protects against a power cut.
  static constexpr double kSyncEvery_s = 5.0;
  // More than the bytes of a second at full rate and a snapshot: buffers of this size do not grow.
  static constexpr std::size_t kBuffer = 1'048'576;
  // Its memory is touched at once, so that it does not grow with the first snapshots.
  [[nodiscard]] static std::string make_buffer();
  // Bytes that may wait for the disk; beyond that the recording ends.
  static constexpr std::size_t kMaxWaiting = 16'777'216;

  // Writes `begin` before it returns. name: of the log, in messages. Throws what `open` throws, and
  // io::DeviceError if `begin` cannot be written. On a full disk it does not throw and writes nothing: see
  // take_failure().
  LogWriter(std::filesystem::path name, Open open, std::string_view begin);
  ~LogWriter();  // writes what waits
  LogWriter(const LogWriter&) = delete;
  LogWriter& operator=(const LogWriter&) = delete;

  // Takes the bytes, and leaves an empty string. in_next_file: they begin the next file.
  void write(std::string& bytes, bool in_next_file = false);

  // Why the recording ended, once; nothing while it works.
  [[nodiscard]] std::optional<std::string> take_failure();

 private:
  void write_loop();
  // The error; empty if there was none.
  [[nodiscard]] std::string write_out(std::string_view bytes, const std::vector<std::size_t>& cuts);
  void end_with(std::string failure);

  std::filesystem::path name_;
  Open open_;
  io::Descriptor file_;

  std::mutex mutex_;
  std::condition_variable changed_;
  std::string waiting_;
  std::vector<std::size_t> cuts_;  // where a next file begins in waiting_
  bool ending_ = false;
  bool failed_ = false;
  std::optional<std::string> failure_;
  std::thread writer_;
};

// The disk, a quota or the file size limit is used up.
struct DiskFull {
  int error = 0;  // of errno(3)
};

// Opens or creates the file for appending, for this program alone. Throws io::PathError, io::PermissionError,
// io::DeviceError (another gromad records into it) or DiskFull.
[[nodiscard]] io::Descriptor open_log(const std::filesystem::path& path);

}  // namespace groma::daemon
