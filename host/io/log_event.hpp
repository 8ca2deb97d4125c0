// The events of gromad's loop in a log: all that its poses depend on, in the order in which the pipeline took
// them (proto/log.proto). Times are those of the host.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <span>
#include <string>
#include <string_view>
#include <variant>

namespace groma::io {

// Bytes that were read at once. link: 0 is the robot's first link, i the i-th node of the configuration; the
// robot's further links follow.
struct LinkBytes {
  std::size_t link = 0;
  std::span<const std::uint8_t> bytes;
  double now_s = 0.0;
};
struct LinkReopened {
  std::size_t link = 0;
};
// What has waited for long enough is passed on.
struct LoopTick {
  double now_s = 0.0;
};
// All that waits is passed on.
struct LoopFlush {};
// Bytes that only the same build understands.
struct LoopState {
  enum class Kind : std::uint8_t { kSnapshot, kAdoption };
  Kind kind = Kind::kSnapshot;
  std::string_view content;
};
// Of the POSE lines since the last digest or snapshot.
struct PoseDigest {
  double now_s = 0.0;
  std::uint32_t poses = 0;
  std::uint64_t fnv1a = 0;
};
struct SectionStart {
  std::string_view program_version;
  std::uint64_t unix_time_ns = 0;
  bool continues = false;
};

// Spans and views are valid during the call that they are given to.
using LogEvent =
    std::variant<SectionStart, LinkBytes, LinkReopened, LoopTick, LoopFlush, LoopState, PoseDigest>;

// Appends the frames of an event, without the heap beyond `out`. A SectionStart begins no description: see
// LogEncoder::begin_section().
void append_event(const LogEvent& event, std::string& out);

// Calls take(event) for each event in the order of the log; other records are skipped. An event whose
// fragments are not complete is left out. Returns the number of bytes that are damaged or not understood.
std::size_t read_log_events(std::string_view bytes, const std::function<void(const LogEvent&)>& take);

// FNV-1a, 64 bits, continued from `hash`.
inline constexpr std::uint64_t kFnv1aBegin = 0xcbf29ce484222325;
[[nodiscard]] constexpr std::uint64_t fnv1a(std::string_view bytes,
                                            std::uint64_t hash = kFnv1aBegin) noexcept {
  for (const char byte : bytes) hash = (hash ^ static_cast<std::uint8_t>(byte)) * 0x100000001b3;
  return hash;
}

}  // namespace groma::io
