#include "host/io/output_file.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>

#include <atomic>
#include <cerrno>
#include <charconv>
#include <chrono>
#include <csignal>
#include <cstdio>
#include <optional>
#include <string>
#include <string_view>
#include <system_error>

#include "host/io/descriptor.hpp"
#include "host/io/error.hpp"

namespace groma::io {

namespace {

[[noreturn]] void throw_unwritable(const std::filesystem::path& path, int error) {
  const std::string problem = fmt::format("cannot be written ({})", std::generic_category().message(error));
  switch (error) {
    case EACCES:
    case EPERM:
    case EROFS:
      throw PermissionError({path}, problem, "allow this user to write there, or choose another place");
    case ENOENT:
      throw PathError({path}, problem, "make the folder first, or choose another");
    case EISDIR:
    case ENOTDIR:
      throw PathError({path}, problem, "give the path of a file in a folder");
    case ENOSPC:
    case EDQUOT:
    case EFBIG:
      throw DeviceError({path}, problem, "make room, or choose another place; nothing was written");
    default:
      throw DeviceError({path}, problem, "check the device; nothing was written");
  }
}

void write_all(const Descriptor& file, std::string_view content, const std::filesystem::path& path) {
  while (!content.empty()) {
    const ssize_t count = ::write(file.get(), content.data(), content.size());
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) throw_unwritable(path, errno);
    content.remove_prefix(static_cast<std::size_t>(count));
  }
}

std::filesystem::path folder_of(const std::filesystem::path& path) {
  const std::filesystem::path folder = path.parent_path();
  return folder.empty() ? "." : folder;
}

// The target of a symbolic link: renaming would replace the link itself.
std::filesystem::path target_of(const std::filesystem::path& path) {
  std::error_code error;
  if (!std::filesystem::is_symlink(path, error)) return path;
  const std::filesystem::path target = std::filesystem::weakly_canonical(path, error);
  return error ? path : target;
}

bool is_special(const std::filesystem::path& path) {
  std::error_code error;
  const std::filesystem::file_status status = std::filesystem::status(path, error);
  return std::filesystem::exists(status) && !std::filesystem::is_regular_file(status) &&
         !std::filesystem::is_directory(status);
}

constexpr std::string_view kTemporaryPrefix = ".groma-";
constexpr std::string_view kTemporarySuffix = ".tmp";

// The process that has written a temporary file of that name; none: it is another file.
std::optional<pid_t> writer_of(std::string_view name) {
  if (name.substr(0, kTemporaryPrefix.size()) != kTemporaryPrefix) return std::nullopt;
  name.remove_prefix(kTemporaryPrefix.size());
  pid_t pid = 0;
  const auto [end, error] = std::from_chars(name.data(), name.data() + name.size(), pid);
  const bool good = error == std::errc() && pid > 0 && name.ends_with(kTemporarySuffix);
  return good ? std::optional(pid) : std::nullopt;
}

// A file beside the target; the destructor removes it unless it has replaced the target.
class TemporaryFile {
 public:
  explicit TemporaryFile(const std::filesystem::path& target) : target_(target) {
    static std::atomic<unsigned> serial{0};
    for (;;) {
      path_ = folder_of(target) /
              fmt::format("{}{}-{}{}", kTemporaryPrefix, ::getpid(), serial++, kTemporarySuffix);
      const int fd = ::open(path_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
      if (fd >= 0) {
        ::close(fd);
        return;
      }
      if (errno != EEXIST) throw_unwritable(target_, errno);
    }
  }
  ~TemporaryFile() {
    if (!kept_) ::unlink(path_.c_str());
  }
  TemporaryFile(const TemporaryFile&) = delete;
  TemporaryFile& operator=(const TemporaryFile&) = delete;

  void write(std::string_view content) const {
    Descriptor file(::open(path_.c_str(), O_WRONLY | O_CLOEXEC));
    if (file.get() < 0) throw_unwritable(target_, errno);
    write_all(file, content, target_);
    if (::fsync(file.get()) != 0) throw_unwritable(target_, errno);
    if (file.close() != 0) throw_unwritable(target_, errno);
  }

  void replace_target() {
    if (std::rename(path_.c_str(), target_.c_str()) != 0) throw_unwritable(target_, errno);
    kept_ = true;
    // The rename is durable once the folder is flushed; if the folder cannot be opened, the file is still
    // complete.
    const Descriptor folder(::open(folder_of(target_).c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
    if (folder.get() >= 0) ::fsync(folder.get());
  }

 private:
  std::filesystem::path target_;
  std::filesystem::path path_;
  bool kept_ = false;
};

}  // namespace

void expect_writable(const std::filesystem::path& path) {
  const std::filesystem::path target = target_of(path);
  struct stat status {};
  if (path.empty()) throw_unwritable(path, ENOENT);
  if (::stat(target.c_str(), &status) == 0 && S_ISDIR(status.st_mode)) throw_unwritable(path, EISDIR);
  if (is_special(target)) {
    if (::access(target.c_str(), W_OK) != 0) throw_unwritable(path, errno);
    return;
  }
  const std::filesystem::path folder = folder_of(target);
  if (::stat(folder.c_str(), &status) != 0) throw_unwritable(path, errno);
  if (!S_ISDIR(status.st_mode)) throw_unwritable(path, ENOTDIR);
  if (::access(folder.c_str(), W_OK | X_OK) != 0) throw_unwritable(path, errno);
}

void write_file(const std::filesystem::path& path, std::string_view content) {
  expect_writable(path);
  const std::filesystem::path target = target_of(path);
  if (is_special(target)) {
    const Descriptor file(::open(target.c_str(), O_WRONLY | O_CLOEXEC));
    if (file.get() < 0) throw_unwritable(path, errno);
    write_all(file, content, path);
    return;
  }
  TemporaryFile temporary(target);
  temporary.write(content);
  temporary.replace_target();
}

void remove_remains(const std::filesystem::path& path) {
  // Of a process in another container, which cannot be seen from here, only old files are certain remains.
  constexpr auto kOld = std::chrono::minutes(1);
  std::error_code error;
  for (std::filesystem::directory_iterator entry(folder_of(target_of(path)), error), end;
       !error && entry != end; entry.increment(error)) {
    const std::optional<pid_t> writer = writer_of(entry->path().filename().string());
    if (!writer) continue;
    const bool ended = ::kill(*writer, 0) != 0 && errno == ESRCH;
    const auto written = entry->last_write_time(error);
    if (ended && !error && std::filesystem::file_time_type::clock::now() - written > kOld) {
      ::unlink(entry->path().c_str());
    }
    error.clear();
  }
}

void make_folder(const std::filesystem::path& path) {
  std::error_code error;
  std::filesystem::create_directories(path, error);
  if (error) throw_unwritable(path, error.value());
  if (!std::filesystem::is_directory(path)) throw_unwritable(path, ENOTDIR);
}

}  // namespace groma::io
