#include "host/io/input_file.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <openssl/evp.h>
#include <sys/stat.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <stdexcept>
#include <system_error>
#include <utility>

#include "host/io/descriptor.hpp"
#include "host/io/error.hpp"

namespace groma::io {

namespace {

[[noreturn]] void throw_unreadable(const std::filesystem::path& path, int error) {
  const std::string reason = std::generic_category().message(error);
  if (error == EACCES || error == EPERM) {
    throw PermissionError({path}, fmt::format("cannot be read ({})", reason), "allow this user to read it");
  }
  if (error == ENOENT || error == ENOTDIR) {
    throw DataError({path}, "does not exist", "check the path, or add the file");
  }
  throw DataError({path}, fmt::format("cannot be read ({})", reason), "give a readable file");
}

// Limit for non-regular files, which may never end: pipes, /dev/zero.
constexpr std::size_t kMaxStreamBytes = std::size_t{64} << 20U;

}  // namespace

std::string read_file(const std::filesystem::path& path) {
  // O_NONBLOCK: otherwise opening a FIFO would wait for a writer.
  const Descriptor file(::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK));
  if (file.get() < 0) throw_unreadable(path, errno);
  struct stat status {};
  if (::fstat(file.get(), &status) != 0) throw_unreadable(path, errno);
  if (S_ISDIR(status.st_mode)) throw_unreadable(path, EISDIR);
  if (::fcntl(file.get(), F_SETFL, 0) != 0) throw_unreadable(path, errno);
  const bool regular = S_ISREG(status.st_mode);

  // The size is only a hint: pipes have none, and a file may grow.
  std::string text(static_cast<std::size_t>(status.st_size) + 1, '\0');
  std::size_t size = 0;
  for (;;) {
    if (size == text.size()) text.resize(2 * text.size());
    const ssize_t count = ::read(file.get(), text.data() + size, text.size() - size);
    if (count < 0 && errno == EINTR) continue;
    if (count < 0) throw_unreadable(path, errno);
    if (count == 0) break;
    size += static_cast<std::size_t>(count);
    if (!regular && size > kMaxStreamBytes) {
      throw DataError({path},
                      fmt::format("is not a regular file, and is longer than {} MiB", kMaxStreamBytes >> 20U),
                      "give a regular file");
    }
  }
  if (S_ISFIFO(status.st_mode) && size == 0) {
    throw DataError({path}, "is a pipe without a writer", "give a regular file, or start its writer first");
  }
  text.resize(size);
  return text;
}

std::string read_configuration(const std::filesystem::path& path) {
  if (!std::filesystem::exists(path))
    throw ConfigError({path}, "does not exist", "check the path, or add the file");
  return read_file(path);
}

std::string sha256(std::string_view bytes) {
  std::array<unsigned char, EVP_MAX_MD_SIZE> digest{};
  unsigned int size = 0;
  if (EVP_Digest(bytes.data(), bytes.size(), digest.data(), &size, EVP_sha256(), nullptr) != 1) {
    throw std::runtime_error("OpenSSL cannot compute SHA-256");
  }
  std::string text;
  for (unsigned int i = 0; i < size; ++i) text += fmt::format("{:02x}", digest[i]);
  return text;
}

std::string InputFiles::read(const std::filesystem::path& path) {
  const auto provided = provided_.find(path);
  std::string text = provided != provided_.end() ? provided->second : read_file(path);
  digest_by_name_[path.filename().string()] = sha256(text);
  if (keeps_texts_) provided_.emplace(path, text);
  return text;
}

void InputFiles::provide(const std::filesystem::path& path, std::string text) {
  provided_[path] = std::move(text);
}

std::string InputFiles::digest() const {
  std::string list;
  for (const auto& [name, digest] : digest_by_name_) list += fmt::format("{}  {}\n", digest, name);
  return sha256(list);
}

}  // namespace groma::io
