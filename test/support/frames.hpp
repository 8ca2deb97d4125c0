// Frames as values.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"

namespace groma::mac {

struct ParseResult {
  std::optional<Frame> frame{};
  ParseError error = ParseError::kForeign;  // if there is no frame
};

[[nodiscard]] inline ParseResult parse(std::span<const std::uint8_t> bytes) {
  Frame frame;
  if (const auto error = parse(bytes, frame)) return {std::nullopt, *error};
  return {frame};
}

[[nodiscard]] inline FrameBytes serialize(const Frame& frame) {
  FrameBytes out;
  serialize(frame, out);
  return out;
}

}  // namespace groma::mac
