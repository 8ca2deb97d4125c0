// Common parts of links over a file descriptor.
#pragma once

#include <string>
#include <utility>

#include "host/io/descriptor.hpp"
#include "host/link/byte_link.hpp"

namespace groma::link {

using io::Descriptor;

// Explains `error_number` of open(2), connect(2) or flock(2) on `path`, with a remedy.
[[nodiscard]] LinkError explain_open_error(const std::string& path, int error_number);

// Locks the device against other links; false if another program holds the lock.
[[nodiscard]] bool lock_device(int fd) noexcept;

// True once the device behind the terminal `fd` is gone. It then reports that it is readable, without data.
[[nodiscard]] bool hung_up(int fd) noexcept;

// A link over a non-blocking descriptor.
class DescriptorLink : public ByteLink {
 public:
  explicit DescriptorLink(Descriptor fd) noexcept : fd_(std::move(fd)) {}

  [[nodiscard]] int poll_fd() const noexcept override { return fd_.get(); }
  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out) override;
  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override;

 private:
  Descriptor fd_;
};

}  // namespace groma::link
