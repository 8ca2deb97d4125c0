// Computes and verifies the MICs of a keyed network's frames.
//
// docs/reference/air.md has the keys and nonces, docs/explanation/security.md why no nonce is used twice. A
// receiver takes superframe and place from its own count, except a beacon's: whether those are current is
// decided elsewhere (replay_guard.hpp).
//
// If time is short, a MIC is computed in three steps, of which the second runs in the background:
// expect_...() when the next frame is known, begin_verify() or begin_signing() with its bytes, then fits() or
// finish_signing(). A frame that was not expected only takes longer.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <variant>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/security/ccm.hpp"

namespace groma::mac {

// A frame's place in network time: a superframe and a slot in it, counted from 0, or one of these constants.
struct Place {
  static constexpr std::uint8_t kBeacon = 0xFE;
  static constexpr std::uint8_t kShared = 0xFF;
  std::uint32_t superframe = 0;
  std::uint8_t slot = 0;
};

[[nodiscard]] constexpr Place place_of(const Beacon& beacon) noexcept {
  return {beacon.superframe, beacon.shared ? Place::kShared : Place::kBeacon};
}

// Receivers of a merge request: their session, and the superframe of theirs in which it is sent.
struct MergeTarget {
  std::uint64_t session = 0;
  std::uint32_t superframe = 0;
};

// The last place in which a node signed a frame of each type in its session, and that of its challenge: a
// frame there or earlier could repeat a nonce. Belongs to the node's boot, not to its state machine, which a
// radio recovery replaces.
class SignedPlaces {
 public:
  // The kind of merge requests, beacons with keys of their own; other frames': the index in Body.
  static constexpr std::size_t kMergeRequests = std::variant_size_v<Body>;
  // For a session in which a replay has been excluded.
  [[nodiscard]] bool take(std::uint64_t session, std::size_t kind, Place place) noexcept;
  // For a challenge, in any session. Also refuses a nonce that is less than the last one: nonces of a boot
  // count up.
  [[nodiscard]] bool take_challenge(std::uint64_t nonce, Place place) noexcept;

 private:
  std::uint64_t session_ = 0;
  std::array<std::uint64_t, kMergeRequests + 1> next_{};
  std::uint64_t challenge_ = 0;
  std::uint64_t next_of_challenge_ = 0;
};

class FrameAuthenticator {
 public:
  // For an open network: frames carry no MIC.
  FrameAuthenticator() noexcept = default;
  // All arguments outlive this object. An empty key: an open network. Without `signed_places` it only
  // verifies.
  FrameAuthenticator(security::BlockCipher* cipher, std::span<const std::uint8_t> network_key,
                     SignedPlaces* signed_places = nullptr) noexcept
      : cipher_(network_key.size() == security::kBlockBytes ? cipher : nullptr),
        network_key_(network_key),
        signed_places_(signed_places) {}

  // The network has a key.
  [[nodiscard]] bool on() const noexcept { return cipher_ != nullptr; }

  // Makes this the session of all frames from now on.
  void enter(std::uint64_t session) noexcept;

  // Precomputes cipher blocks for the secured frame that will most likely be received, or sent, next. Call in
  // idle time.
  void expect_received(std::uint16_t source, FrameType type, Place place) noexcept {
    expect(received_, source, type, place);
  }
  void expect_sent(std::uint16_t source, FrameType type, Place place) noexcept {
    expect(sent_, source, type, place);
  }

  // Call for each frame received, before fits(). Starts the computation that fits() needs if the frame was
  // expected, and discards any other that is in progress. The frame's bytes must not change until fits(): a
  // change would not be detected.
  void begin_verify(std::span<const std::uint8_t> frame, Place place) noexcept;
  // Whether the MIC of a secured frame with this body is valid in this place: for a beacon in the session
  // that it states, otherwise in the present one. `merge_target`: the receivers, if it is a merge request.
  [[nodiscard]] bool fits(std::span<const std::uint8_t> frame, const Body& body, Place place,
                          const MergeTarget& merge_target = {}) noexcept;

  // Writes the MIC to the end of a secured frame with this body. If the cipher fails, or the nonce may have
  // been used, the frame is left without a valid MIC and all receivers reject it. The frame must not change
  // between begin and finish.
  void begin_signing(const FrameBytes& frame, const Body& body, Place place,
                     const MergeTarget& merge_target = {}) noexcept;
  void finish_signing(FrameBytes& frame) noexcept;
  // Discards the computations in progress; the next finish_signing() does nothing.
  void abandon() noexcept {
    checking_.reset();
    signing_mask_.reset();
  }

 private:
  struct Expected {
    std::uint64_t nonce = 0;  // its first eight bytes; the others are zero
    security::Prepared prepared{};
  };

  [[nodiscard]] const std::optional<security::Key>& key_of(std::uint64_t session) noexcept;
  [[nodiscard]] std::optional<security::Key> key_for(const Body& body,
                                                     const MergeTarget& merge_target) noexcept;
  // AES(key, number (8) | text (up to 8, or 4 before `last`) | last (4)).
  [[nodiscard]] std::optional<security::Key> derive(const security::Key& key, std::uint64_t number,
                                                    std::string_view text, std::uint32_t last = 0) noexcept;
  void expect(std::optional<Expected>& out, std::uint16_t source, FrameType type, Place place) noexcept;
  // Starts the frame's MIC with this key, and returns its mask. `expected` was precomputed for the session.
  [[nodiscard]] std::optional<security::Block> begin(const std::optional<security::Key>& key,
                                                     const std::optional<Expected>& expected,
                                                     std::span<const std::uint8_t> frame,
                                                     Place place) noexcept;
  // The computation that begin() started gives the frame's MIC.
  [[nodiscard]] bool ends_as(std::span<const std::uint8_t> frame,
                             const std::optional<security::Block>& mask) noexcept;

  security::BlockCipher* cipher_ = nullptr;
  std::span<const std::uint8_t> network_key_{};
  SignedPlaces* signed_places_ = nullptr;
  std::uint64_t session_ = 0;
  std::optional<security::Key> session_key_{};
  // Of the other session whose beacon was heard last.
  std::uint64_t other_session_ = 0;
  std::optional<security::Key> other_key_{};
  std::optional<Expected> received_{};
  std::optional<Expected> sent_{};
  // In progress.
  struct Check {
    std::span<const std::uint8_t> frame{};
    std::uint64_t nonce = 0;
    security::Block mask{};
  };
  std::optional<Check> checking_{};
  std::optional<security::Block> signing_mask_{};
};

}  // namespace groma::mac
