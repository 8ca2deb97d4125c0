// Frames as values, and their MICs in one call.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/frame_authenticator.hpp"

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

inline void sign(FrameAuthenticator& authenticator, FrameBytes& bytes, const Body& body, Place place,
                 const MergeTarget& merge_target = {}) {
  authenticator.begin_signing(bytes, body, place, merge_target);
  authenticator.finish_signing(bytes);
}

}  // namespace groma::mac
