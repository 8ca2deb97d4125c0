// A simulated serial port that other programs can open: the master side of a pseudo-terminal.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>

#include "host/io/descriptor.hpp"

namespace groma::simulation {

class PtyPort {
 public:
  // Throws io::DeviceError if the system cannot provide a pseudo-terminal.
  PtyPort();

  // The path that a reader opens: /dev/pts/N.
  [[nodiscard]] const std::string& path() const noexcept { return path_; }
  // Whether a program has it open.
  [[nodiscard]] bool listened() const noexcept;

  // write() and read() never block and return the number of bytes. Without a listener, write() drops the
  // bytes, as on a wire; it also drops what does not fit into the system's buffer, and then returns less than
  // given.
  std::size_t write(std::span<const std::uint8_t> bytes);
  [[nodiscard]] std::size_t read(std::span<std::uint8_t> out);

 private:
  io::Descriptor master_;
  std::string path_;
};

}  // namespace groma::simulation
