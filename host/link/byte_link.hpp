// Where bytes come from: a serial port, a pseudo-terminal, a node on a CAN bus, a Unix socket or a recording,
// all read alike.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <span>
#include <string>

namespace groma::link {

enum class LinkFault {
  kNone,
  kNoDevice,    // nothing at that path, or nobody listening
  kPermission,  // it is there, but not for this user
  kBusy,        // another program has it
  kUnsuitable,  // not a device of that kind, or a bit rate it cannot do
  kGone,        // was open, and was unplugged, hung up or read to its end
};

// The message names the device, the cause and what to do, on one line.
struct LinkError {
  LinkFault fault = LinkFault::kNone;
  std::string message;
};

struct ReadResult {
  std::size_t bytes = 0;
  bool gone = false;  // nothing more will come: close the link and, if wanted, open it anew
};

// An open link. Reading and writing never block; destruction closes it. Not for use by two threads at once.
class ByteLink {
 public:
  ByteLink(const ByteLink&) = delete;
  ByteLink& operator=(const ByteLink&) = delete;
  virtual ~ByteLink() = default;

  // For poll(2); owned by the link.
  [[nodiscard]] virtual int poll_fd() const noexcept = 0;

  // Reads what is there, at most out.size() bytes (more than 0).
  [[nodiscard]] virtual ReadResult read(std::span<std::uint8_t> out) = 0;

  // Bytes taken, from the front; fewer than given where the link is full or gone.
  [[nodiscard]] virtual std::size_t write(std::span<const std::uint8_t> bytes) = 0;

  // What befell the link since the last call that a person has to know of, on one line; mostly nothing.
  [[nodiscard]] virtual std::string take_news() { return {}; }

 protected:
  ByteLink() = default;
};

// An open link, or the reason why there is none.
struct OpenedLink {
  std::unique_ptr<ByteLink> link;
  LinkError error;
};

// Opens whatever `path` is: a pseudo-terminal by termios (libserialport 0.1.1 refuses those), another
// character device by libserialport, a socket, or a file, which is then replayed; a node on a CAN bus, or in
// the log of one, by a path of can_path.hpp. Terminals are set raw, 8N1, without flow control, to `baud` bits
// per second, and locked against a second reader.
[[nodiscard]] OpenedLink open_link(const std::string& path, unsigned baud);

[[nodiscard]] OpenedLink open_serial_port(const std::string& path, unsigned baud);
[[nodiscard]] OpenedLink open_pty(const std::string& path, unsigned baud);
[[nodiscard]] OpenedLink open_unix_socket(const std::string& path);
[[nodiscard]] OpenedLink open_recording(const std::string& path);
// The bytes that a node of a candump log sent to its host, as can_path.hpp names them.
[[nodiscard]] OpenedLink open_can_log(const std::string& path);

}  // namespace groma::link
