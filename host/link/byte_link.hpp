// Byte links with one interface: a serial port, a pseudo-terminal, a node on a CAN bus, a serial server, a
// Unix socket or a recording.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <memory>
#include <span>
#include <string>

#include "host/link/can_counters.hpp"

namespace groma::link {

enum class LinkFault {
  kNone,
  kNoDevice,    // nothing at that path, or no listener
  kPermission,  // it exists, but this user may not open it
  kBusy,        // in use by another program
  kUnsuitable,  // not a device of that kind, or an unsupported bit rate
  kGone,        // was open, then unplugged, hung up or read to its end
};

// The message names the device, the cause and what to do, on one line.
struct LinkError {
  LinkFault fault = LinkFault::kNone;
  std::string message;
};

struct ReadResult {
  std::size_t bytes = 0;
  bool gone = false;  // the link has ended: close it and reopen it if needed
};

// An open link. Reading and writing never block; destruction closes it. Not thread-safe.
class ByteLink {
 public:
  ByteLink(const ByteLink&) = delete;
  ByteLink& operator=(const ByteLink&) = delete;
  virtual ~ByteLink() = default;

  // For poll(2); owned by the link.
  [[nodiscard]] virtual int poll_fd() const noexcept = 0;

  // Reads the available bytes, at most out.size(), which is more than 0.
  [[nodiscard]] virtual ReadResult read(std::span<std::uint8_t> out) = 0;

  // Returns how many bytes it took, from the front; fewer than given if the link is full or gone.
  [[nodiscard]] virtual std::size_t write(std::span<const std::uint8_t> bytes) = 0;

  // Events of the link since the last call that a user should know of, on one line; usually empty.
  [[nodiscard]] virtual std::string take_news() { return {}; }
  // Of a link over CAN; null for others.
  [[nodiscard]] virtual const CanCounters* can_counters() const noexcept { return nullptr; }

 protected:
  ByteLink() = default;
};

// An open link, or null and the error.
struct OpenedLink {
  std::unique_ptr<ByteLink> link;
  LinkError error;
  bool pending = false;  // a connection is under way: try again soon
};

// Opens `path` by its kind: a pseudo-terminal by termios (libserialport 0.1.1 refuses those), another
// character device by libserialport, a Unix socket, a file (a recording, which is replayed), a node on a CAN
// bus or in a CAN log (see can_path.hpp), a serial server (network_link.hpp) or the port of a USB device by
// its serial number (usb_port.hpp). Terminals are set raw, 8N1, without flow control, to `baud` bit/s, and
// locked against a second reader. Blocks while it connects to a serial server.
[[nodiscard]] OpenedLink open_link(const std::string& path, unsigned baud);
// The same for repeated use, without blocking: each call of the result tries once, or continues.
[[nodiscard]] std::function<OpenedLink()> link_opener(const std::string& path, unsigned baud);

[[nodiscard]] OpenedLink open_serial_port(const std::string& path, unsigned baud);
[[nodiscard]] OpenedLink open_pty(const std::string& path, unsigned baud);
[[nodiscard]] OpenedLink open_unix_socket(const std::string& path);
[[nodiscard]] OpenedLink open_recording(const std::string& path);
// The bytes that a node of a candump log sent to its host; for the path see can_path.hpp.
[[nodiscard]] OpenedLink open_can_log(const std::string& path);

}  // namespace groma::link
