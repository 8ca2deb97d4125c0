// Encodes one message of ROS 2: CDR (XCDR1), little-endian, without a type's name. Fields are written in the
// order of the .msg file.
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <type_traits>

#include "host/mcap/bytes.hpp"

namespace groma::ros2 {

class CdrWriter {
 public:
  CdrWriter() : bytes_(kEncapsulation) {}

  template <typename Number>
  requires std::is_arithmetic_v<Number> CdrWriter& put(Number value) {
    align(sizeof value);
    mcap::append(bytes_, value);
    return *this;
  }
  CdrWriter& put(bool value) { return put(static_cast<std::uint8_t>(value)); }
  CdrWriter& put(std::string_view text) {
    length(text.size() + 1);
    bytes_ += text;
    bytes_ += '\0';
    return *this;
  }
  CdrWriter& put(const char* text) { return put(std::string_view(text)); }
  // Of a sequence whose elements follow.
  CdrWriter& length(std::size_t count) { return put(static_cast<std::uint32_t>(count)); }

  [[nodiscard]] const std::string& message() const noexcept { return bytes_; }

 private:
  static constexpr std::string_view kEncapsulation{"\0\1\0\0", 4};

  // Numbers are aligned to their size, counted from the end of the encapsulation header.
  void align(std::size_t size) {
    while ((bytes_.size() - kEncapsulation.size()) % size != 0) bytes_ += '\0';
  }

  std::string bytes_;
};

}  // namespace groma::ros2
