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

#include <algorithm>
#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <string_view>
#include <utility>
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
  [[nodiscard]] bool take(std::uint64_t session, std::size_t kind, Place place) noexcept {
    if (session != session_) next_.fill(0);
    session_ = session;
    return advance(next_[kind], place);
  }
  // For a challenge, in any session. Also refuses a nonce that is less than the last one: nonces of a boot
  // count up.
  [[nodiscard]] bool take_challenge(std::uint64_t nonce, Place place) noexcept {
    if (nonce < challenge_) return false;
    if (nonce > challenge_) next_of_challenge_ = 0;
    challenge_ = nonce;
    return advance(next_of_challenge_, place);
  }

 private:
  // Returns false for a place before `next`, which counts the places of a session.
  [[nodiscard]] static bool advance(std::uint64_t& next, Place place) noexcept {
    const std::uint64_t at = std::uint64_t{place.superframe} << 8 | place.slot;
    if (at < next) return false;
    next = at + 1;
    return true;
  }

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
  void enter(std::uint64_t session) noexcept {
    if (!on()) return;
    session_key_ = key_of(session);
    session_ = session;
    received_.reset();
    sent_.reset();
  }

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
  void begin_verify(std::span<const std::uint8_t> frame, Place place) noexcept {
    abandon();
    if (!received_ || !is_whole(frame) || nonce_of(frame, place) != received_->nonce) return;
    if (const auto mask = begin(session_key_, received_, frame, place))
      checking_ = {frame, received_->nonce, *mask};
  }
  // Whether the MIC of a secured frame with this body is valid in this place: for a beacon in the session
  // that it states, otherwise in the present one. `merge_target`: the receivers, if it is a merge request.
  [[nodiscard]] bool fits(std::span<const std::uint8_t> frame, const Body& body, Place place,
                          const MergeTarget& merge_target = {}) noexcept {
    if (!on()) return false;
    const auto begun = std::exchange(checking_, std::nullopt);
    const auto key = key_for(body, merge_target);
    if (begun && key == session_key_ && begun->frame.data() == frame.data() &&
        begun->frame.size() == frame.size() && begun->nonce == nonce_of(frame, place)) {
      return ends_as(frame, begun->mask);
    }
    return ends_as(frame, begin(key, received_, frame, place));
  }

  // Writes the MIC to the end of a secured frame with this body. If the cipher fails, or the nonce may have
  // been used, the frame is left without a valid MIC and all receivers reject it. The frame must not change
  // between begin and finish.
  void begin_signing(const FrameBytes& frame, const Body& body, Place place,
                     const MergeTarget& merge_target = {}) noexcept {
    abandon();
    if (!session_key_ || signed_places_ == nullptr) return;
    const Join* challenge = challenge_of(body);
    const auto* beacon = std::get_if<Beacon>(&body);
    const bool requests = beacon != nullptr && beacon->merge_request;
    const std::size_t kind = requests ? SignedPlaces::kMergeRequests : body.index();
    const bool first = challenge != nullptr ? signed_places_->take_challenge(challenge->nonce, place)
                                            : signed_places_->take(session_, kind, place);
    if (first) signing_mask_ = begin(key_for(body, merge_target), sent_, frame.bytes(), place);
  }
  void finish_signing(FrameBytes& frame) noexcept {
    if (!signing_mask_) return;
    const auto code = security::end_code(*cipher_, *signing_mask_);
    signing_mask_.reset();
    if (code) std::copy(code->begin(), code->end(), frame.code().begin());
  }
  // Discards the computations in progress; the next finish_signing() does nothing.
  void abandon() noexcept {
    checking_.reset();
    signing_mask_.reset();
  }

 private:
  using Key = security::Key;
  struct Expected {
    std::uint64_t nonce = 0;  // its first eight bytes; the others are zero
    security::Prepared prepared{};
  };
  // Offsets in a frame's bytes.
  static constexpr std::size_t kSource = 7;
  static constexpr std::size_t kType = 9;
  static_assert(kType + 1 == kHeaderBytes);

  [[nodiscard]] static std::uint64_t nonce_of(std::uint16_t source, std::uint8_t type, Place place) noexcept {
    return source | std::uint64_t{place.superframe} << 16 | std::uint64_t{place.slot} << 48 |
           std::uint64_t{type} << 56;
  }
  // The frame must have a whole header.
  [[nodiscard]] static std::uint64_t nonce_of(std::span<const std::uint8_t> frame, Place place) noexcept {
    return nonce_of(static_cast<std::uint16_t>(frame[kSource] | frame[kSource + 1] << 8), frame[kType],
                    place);
  }
  [[nodiscard]] std::optional<security::Prepared> prepare(const Key& key, std::uint64_t nonce) noexcept {
    security::Nonce bytes{};
    for (std::size_t i = 0; i < 8; ++i) bytes[i] = static_cast<std::uint8_t>(nonce >> (8 * i));
    return security::prepare(*cipher_, key, bytes);
  }
  [[nodiscard]] static bool is_whole(std::span<const std::uint8_t> frame) noexcept {
    return frame.size() >= kHeaderBytes + kCodeBytes;
  }
  [[nodiscard]] const std::optional<Key>& key_of(std::uint64_t session) noexcept {
    if (session_key_ && session_ == session) return session_key_;
    if (other_key_ && other_session_ == session) return other_key_;
    Key network_key;
    std::copy(network_key_.begin(), network_key_.end(), network_key.begin());
    other_session_ = session;
    other_key_ = derive(network_key, session, "groma");
    return other_key_;
  }
  [[nodiscard]] std::optional<Key> key_for(const Body& body, const MergeTarget& merge_target) noexcept {
    if (const auto* beacon = std::get_if<Beacon>(&body)) {
      const auto& key = key_of(beacon->session);
      if (!key || !beacon->merge_request) return key;
      return derive(*key, merge_target.session, "call", merge_target.superframe);
    }
    const Join* challenge = challenge_of(body);
    if (challenge == nullptr) return session_key_;
    return session_key_ ? derive(*session_key_, challenge->nonce, "join") : std::nullopt;
  }
  // AES(key, number (8) | text (up to 8, or 4 before `last`) | last (4)).
  [[nodiscard]] std::optional<Key> derive(const Key& key, std::uint64_t number, std::string_view text,
                                          std::uint32_t last = 0) noexcept {
    abandon();
    security::Block block{};
    for (std::size_t i = 0; i < 8; ++i) block[i] = static_cast<std::uint8_t>(number >> (8 * i));
    for (std::size_t i = 0; i < 4; ++i) block[12 + i] = static_cast<std::uint8_t>(last >> (8 * i));
    std::copy(text.begin(), text.end(), block.begin() + 8);
    return cipher_->encrypt(key, block) ? std::optional(block) : std::nullopt;
  }
  void expect(std::optional<Expected>& out, std::uint16_t source, FrameType type, Place place) noexcept {
    const std::uint64_t nonce = nonce_of(source, static_cast<std::uint8_t>(type) | kSecuredFlag, place);
    if (!session_key_ || (out && out->nonce == nonce)) return;
    abandon();
    out.reset();
    if (const auto prepared = prepare(*session_key_, nonce)) out = {nonce, *prepared};
  }
  // Starts the frame's MIC with this key, and returns its mask. `expected` was precomputed for the session.
  [[nodiscard]] std::optional<security::Block> begin(const std::optional<Key>& key,
                                                     const std::optional<Expected>& expected,
                                                     std::span<const std::uint8_t> frame,
                                                     Place place) noexcept {
    abandon();
    if (!key || !is_whole(frame)) return std::nullopt;
    const std::uint64_t nonce = nonce_of(frame, place);
    const bool prepared = expected && expected->nonce == nonce && key == session_key_;
    const auto parts = prepared ? std::optional(expected->prepared) : prepare(*key, nonce);
    if (!parts) return std::nullopt;
    security::begin_code(*cipher_, *key, parts->first, frame.first(frame.size() - kCodeBytes));
    return parts->mask;
  }
  // The computation that begin() started gives the frame's MIC.
  [[nodiscard]] bool ends_as(std::span<const std::uint8_t> frame,
                             const std::optional<security::Block>& mask) noexcept {
    if (!mask) return false;
    const auto code = security::end_code(*cipher_, *mask);
    return code && security::equal(*code, frame.last(kCodeBytes));
  }

  security::BlockCipher* cipher_ = nullptr;
  std::span<const std::uint8_t> network_key_{};
  SignedPlaces* signed_places_ = nullptr;
  std::uint64_t session_ = 0;
  std::optional<Key> session_key_{};
  // Of the other session whose beacon was heard last.
  std::uint64_t other_session_ = 0;
  std::optional<Key> other_key_{};
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
