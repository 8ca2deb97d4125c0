// The codes of a keyed network's frames: signs what goes out and tells what somebody else made, or sent
// before.
//
// A frame's code is CCM*'s over all its bytes, under the session's own key,
//
//   session key = AES(network key, session (8) | "groma" | 0 0 0)
//   nonce       = source (2)  superframe (4)  place (1)  type byte (1)  0 0 0 0 0       little-endian
//
// A receiver takes superframe and place from its own count, not from the frame: in any other superframe, slot
// or session the code is another one. A beacon alone tells its own session and superframe; that those lie
// ahead of what has been is for its receiver to see (freshness.hpp). No node sends two frames of one type in
// one place, so no nonce comes twice.
//
// A call is the beacon that tells the nodes of another session of this one, in a shared slot of theirs. Who
// has just heard them made it, and for that slot alone: its key is
//
//   call key    = AES(caller's session key, callees' session (8) | "call" | callees' superframe (4))
//
// Where time is short a code is made in three steps, the second of which goes on by itself: expect_...() as
// soon as it is known which frame comes next, glance() or begin_signing() with its bytes, fits() or
// finish_signing(). A frame that was not expected costs time alone.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/security/ccm.hpp"

namespace groma::mac {

// Where in the network's time a frame is sent: a superframe's slot, counted from 0, or one of these.
struct Place {
  static constexpr std::uint8_t kBeacon = 0xFE;
  static constexpr std::uint8_t kShared = 0xFF;
  std::uint32_t superframe = 0;
  std::uint8_t slot = 0;
};

[[nodiscard]] constexpr Place place_of(const Beacon& beacon) noexcept {
  return {beacon.superframe, beacon.shared ? Place::kShared : Place::kBeacon};
}

// Those to whom a call goes: a session, and which of its superframes it is sent in.
struct Callees {
  std::uint64_t session = 0;
  std::uint32_t superframe = 0;
};

class Seal {
 public:
  // Of an open network: frames carry no code.
  Seal() noexcept = default;
  // Both outlive it; a key of no bytes: an open network.
  Seal(security::BlockCipher* cipher, std::span<const std::uint8_t> network_key) noexcept
      : cipher_(network_key.size() == security::kBlockBytes ? cipher : nullptr), network_key_(network_key) {}

  // The network has a key.
  [[nodiscard]] bool on() const noexcept { return cipher_ != nullptr; }

  // Frames are of this session from now on.
  void enter(std::uint64_t session) noexcept;

  // In idle time: which frame is received, and which one is sent, next but for others that are not expected.
  // Secured ones.
  void expect_received(std::uint16_t source, FrameType type, Place place) noexcept;
  void expect_sent(std::uint16_t source, FrameType type, Place place) noexcept;

  // For each frame received, before fits(): begins what fits(frame, place) will ask for if that frame was
  // expected, and forgets what was begun for another. The frame's bytes stay as they are until then: what has
  // changed meanwhile would not be seen.
  void glance(std::span<const std::uint8_t> frame, Place place) noexcept;
  // Whether the code of a secured frame fits, in the session entered.
  [[nodiscard]] bool fits(std::span<const std::uint8_t> frame, Place place) noexcept;
  // The same by what the beacon says of itself, whatever its session.
  [[nodiscard]] bool fits(std::span<const std::uint8_t> frame, const Beacon& beacon) noexcept;

  // The same of a call, which holds for those callees alone.
  [[nodiscard]] bool fits(std::span<const std::uint8_t> frame, const Beacon& beacon,
                          const Callees& callees) noexcept;

  // Puts the code into a secured frame's end. Where the cipher fails it stays as it is: nobody will take it.
  // The frame stays as it is in between.
  void begin_signing(const FrameBytes& frame, Place place) noexcept;
  void begin_signing(const FrameBytes& frame, Place place, const Callees& callees) noexcept;
  void finish_signing(FrameBytes& frame) noexcept;
  void sign(FrameBytes& frame, Place place) noexcept {
    begin_signing(frame, place);
    finish_signing(frame);
  }

 private:
  struct Expected {
    std::uint64_t nonce = 0;  // its first eight bytes; the others are zero
    security::Prepared prepared{};
  };

  // What was begun is not asked for any more: the cipher is wanted for something else.
  void abandon() noexcept {
    checking_.reset();
    signing_mask_.reset();
  }
  [[nodiscard]] const std::optional<security::Key>& key_of(std::uint64_t session) noexcept;
  [[nodiscard]] std::optional<security::Key> call_key(std::uint64_t caller, const Callees& callees) noexcept;
  [[nodiscard]] bool fits(std::span<const std::uint8_t> frame, Place place,
                          const std::optional<security::Key>& key) noexcept;
  void expect(std::optional<Expected>& out, std::uint64_t nonce) noexcept;
  void begin_check(std::span<const std::uint8_t> frame, std::uint64_t nonce) noexcept;
  // Begins a code, in the session entered or under another key, and returns what masks it.
  [[nodiscard]] std::optional<security::Block> begin(std::uint64_t nonce,
                                                     std::span<const std::uint8_t> bytes) noexcept;
  [[nodiscard]] std::optional<security::Block> begin(const security::Key& key, std::uint64_t nonce,
                                                     std::span<const std::uint8_t> bytes) noexcept;

  security::BlockCipher* cipher_ = nullptr;
  std::span<const std::uint8_t> network_key_{};
  std::uint64_t session_ = 0;
  std::optional<security::Key> session_key_{};
  // Of another session, whose beacon was heard last.
  std::uint64_t other_session_ = 0;
  std::optional<security::Key> other_key_{};
  std::optional<Expected> received_{};
  std::optional<Expected> sent_{};
  // Under way.
  struct Check {
    std::span<const std::uint8_t> frame{};
    std::uint64_t nonce = 0;
    security::Block mask{};
  };
  std::optional<Check> checking_{};
  std::optional<security::Block> signing_mask_{};
};

}  // namespace groma::mac
