// What links over a file descriptor share.
#pragma once

#include <string>
#include <utility>

#include "host/io/descriptor.hpp"
#include "host/link/byte_link.hpp"

namespace groma::link {

using io::Descriptor;

// What open(2), connect(2) or flock(2) on `path` meant by `error_number`, with its remedy.
[[nodiscard]] LinkError explain_open_error(const std::string& path, int error_number);

// Takes the lock by which links keep each other off a device; false where another holds it.
[[nodiscard]] bool lock_device(int fd) noexcept;

// True once the device behind the terminal `fd` has gone. It then also says that it could be read, and has
// nothing.
[[nodiscard]] bool hung_up(int fd) noexcept;

// A link that is nothing but a descriptor that does not block.
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
