// A serial port for others to open: the master's side of a pseudo-terminal.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

#include "host/io/descriptor.hpp"

namespace groma::simulation {

class PtyPort {
 public:
  // Throws io::DeviceError where the system gives none.
  PtyPort();

  // What a reader opens: /dev/pts/N.
  [[nodiscard]] const std::string& path() const noexcept { return path_; }
  // Somebody has it open.
  [[nodiscard]] bool listened() const noexcept;

  // Never block. What nobody listens to is lost, as on a wire; so is what a reader leaves unread for longer
  // than the system's buffer lasts: written then is less than given.
  std::size_t write(std::span<const std::uint8_t> bytes);
  [[nodiscard]] std::size_t read(std::span<std::uint8_t> out);

 private:
  io::Descriptor master_;
  std::string path_;
};

}  // namespace groma::simulation
