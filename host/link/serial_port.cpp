// Hardware ports, by libserialport.
#include <fmt/format.h>
#include <libserialport.h>
#include <unistd.h>

#include <cerrno>
#include <memory>

#include "host/link/byte_link.hpp"
#include "host/link/descriptor.hpp"

namespace groma::link {
namespace {

struct PortCloser {
  void operator()(sp_port* port) const noexcept {
    sp_close(port);
    sp_free_port(port);
  }
};
using Port = std::unique_ptr<sp_port, PortCloser>;

class SerialPort : public ByteLink {
 public:
  SerialPort(Port port, int fd) noexcept : port_(std::move(port)), fd_(fd) {}

  [[nodiscard]] int poll_fd() const noexcept override { return fd_; }

  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out) override {
    const int n = sp_nonblocking_read(port_.get(), out.data(), out.size());
    if (n > 0) return {static_cast<std::size_t>(n), false};
    // libserialport reports an unplugged port as nothing to read.
    return {0, n < 0 || hung_up(fd_)};
  }

  [[nodiscard]] std::size_t write(std::span<const std::uint8_t> bytes) override {
    const int n = sp_nonblocking_write(port_.get(), bytes.data(), bytes.size());
    return n > 0 ? static_cast<std::size_t>(n) : 0;
  }

 private:
  Port port_;
  int fd_;
};

bool configure(sp_port* port, unsigned baud) noexcept {
  return sp_set_baudrate(port, static_cast<int>(baud)) == SP_OK && sp_set_bits(port, 8) == SP_OK &&
         sp_set_parity(port, SP_PARITY_NONE) == SP_OK && sp_set_stopbits(port, 1) == SP_OK &&
         sp_set_flowcontrol(port, SP_FLOWCONTROL_NONE) == SP_OK;
}

}  // namespace

OpenedLink open_serial_port(const std::string& path, unsigned baud) {
  if (::access(path.c_str(), F_OK) != 0) return {nullptr, explain_open_error(path, errno)};
  // libserialport looks the port up in sysfs; it does not find a path that exists but is not a port.
  sp_port* found = nullptr;
  if (sp_get_port_by_name(path.c_str(), &found) != SP_OK) return {nullptr, explain_open_error(path, ENOTTY)};
  errno = 0;
  if (sp_open(found, SP_MODE_READ_WRITE) != SP_OK) {
    const int cause = errno;
    sp_free_port(found);
    return {nullptr, explain_open_error(path, cause != 0 ? cause : ENOTTY)};
  }
  Port port(found);
  int fd = -1;
  if (sp_get_port_handle(port.get(), &fd) != SP_OK) return {nullptr, explain_open_error(path, ENOTTY)};
  if (!lock_device(fd)) return {nullptr, explain_open_error(path, EBUSY)};
  if (!configure(port.get(), baud)) {
    return {nullptr,
            {LinkFault::kUnsuitable,
             fmt::format("{}: the port refuses {} bits per second, 8N1; set the rate its node was built with",
                         path, baud)}};
  }
  return {std::make_unique<SerialPort>(std::move(port), fd), {}};
}

}  // namespace groma::link
