#include "firmware/core/mac/frame_authenticator.hpp"

#include <algorithm>

namespace groma::mac {
namespace {

using security::Key;

// Offsets in a frame's bytes.
constexpr std::size_t kSource = 7;
constexpr std::size_t kType = 9;
static_assert(kType + 1 == kHeaderBytes);

constexpr std::uint64_t nonce_of(std::uint16_t source, std::uint8_t type, Place place) noexcept {
  return source | std::uint64_t{place.superframe} << 16 | std::uint64_t{place.slot} << 48 |
         std::uint64_t{type} << 56;
}

// The frame must have a whole header.
std::uint64_t nonce_of(std::span<const std::uint8_t> frame, Place place) noexcept {
  return nonce_of(static_cast<std::uint16_t>(frame[kSource] | frame[kSource + 1] << 8), frame[kType], place);
}

std::optional<security::Prepared> prepare(security::BlockCipher& cipher, const Key& key,
                                          std::uint64_t nonce) noexcept {
  security::Nonce bytes{};
  for (std::size_t i = 0; i < 8; ++i) bytes[i] = static_cast<std::uint8_t>(nonce >> (8 * i));
  return security::prepare(cipher, key, bytes);
}

constexpr std::uint8_t secured(FrameType type) noexcept {
  return static_cast<std::uint8_t>(static_cast<std::uint8_t>(type) | kSecuredFlag);
}

constexpr bool is_whole(std::span<const std::uint8_t> frame) noexcept {
  return frame.size() >= kHeaderBytes + kCodeBytes;
}

std::span<const std::uint8_t> without_code(std::span<const std::uint8_t> frame) noexcept {
  return frame.first(frame.size() - kCodeBytes);
}

bool fits(std::optional<security::Code> code, std::span<const std::uint8_t> frame) noexcept {
  return code && security::equal(*code, frame.last(kCodeBytes));
}

// The kinds of SignedPlaces: the frame's type; merge requests are beacons with keys of their own.
constexpr std::size_t kMergeRequests = 0;
std::size_t kind_of(std::span<const std::uint8_t> frame) noexcept {
  return frame[kType] & 7U;
}

// Counts the places of a session.
constexpr std::uint64_t index_of(Place place) noexcept {
  return std::uint64_t{place.superframe} << 8 | place.slot;
}

}  // namespace

bool SignedPlaces::take(std::uint64_t session, std::size_t kind, Place place) noexcept {
  if (session != session_) {
    session_ = session;
    next_.fill(0);
  }
  const std::uint64_t at = index_of(place);
  if (at < next_[kind]) return false;
  next_[kind] = at + 1;
  return true;
}

bool SignedPlaces::take_challenge(std::uint64_t nonce, Place place) noexcept {
  if (nonce < challenge_) return false;
  if (nonce > challenge_) {
    challenge_ = nonce;
    next_of_challenge_ = 0;
  }
  const std::uint64_t at = index_of(place);
  if (at < next_of_challenge_) return false;
  next_of_challenge_ = at + 1;
  return true;
}

const std::optional<Key>& FrameAuthenticator::key_of(std::uint64_t session) noexcept {
  if (session_key_ && session_ == session) return session_key_;
  if (other_key_ && other_session_ == session) return other_key_;
  abandon();
  security::Block block = {0, 0, 0, 0, 0, 0, 0, 0, 'g', 'r', 'o', 'm', 'a'};
  for (std::size_t i = 0; i < 8; ++i) block[i] = static_cast<std::uint8_t>(session >> (8 * i));
  Key network_key;
  std::copy(network_key_.begin(), network_key_.end(), network_key.begin());
  other_session_ = session;
  other_key_ = cipher_->encrypt(network_key, block) ? std::optional(block) : std::nullopt;
  return other_key_;
}

std::optional<Key> FrameAuthenticator::call_key(std::uint64_t caller,
                                                const MergeTarget& merge_target) noexcept {
  const auto& key = key_of(caller);
  if (!key) return std::nullopt;
  abandon();
  security::Block block = {0, 0, 0, 0, 0, 0, 0, 0, 'c', 'a', 'l', 'l'};
  for (std::size_t i = 0; i < 8; ++i) block[i] = static_cast<std::uint8_t>(merge_target.session >> (8 * i));
  for (std::size_t i = 0; i < 4; ++i)
    block[12 + i] = static_cast<std::uint8_t>(merge_target.superframe >> (8 * i));
  return cipher_->encrypt(*key, block) ? std::optional(block) : std::nullopt;
}

std::optional<Key> FrameAuthenticator::challenge_key(std::uint64_t nonce) noexcept {
  if (!session_key_) return std::nullopt;
  abandon();
  security::Block block = {0, 0, 0, 0, 0, 0, 0, 0, 'j', 'o', 'i', 'n'};
  for (std::size_t i = 0; i < 8; ++i) block[i] = static_cast<std::uint8_t>(nonce >> (8 * i));
  return cipher_->encrypt(*session_key_, block) ? std::optional(block) : std::nullopt;
}

void FrameAuthenticator::enter(std::uint64_t session) noexcept {
  if (!on()) return;
  session_key_ = key_of(session);
  session_ = session;
  received_.reset();
  sent_.reset();
}

void FrameAuthenticator::expect(std::optional<Expected>& out, std::uint64_t nonce) noexcept {
  if (!on() || !session_key_ || (out && out->nonce == nonce)) return;
  abandon();
  out.reset();
  if (const auto prepared = prepare(*cipher_, *session_key_, nonce)) out = {nonce, *prepared};
}

void FrameAuthenticator::expect_received(std::uint16_t source, FrameType type, Place place) noexcept {
  expect(received_, nonce_of(source, secured(type), place));
}

void FrameAuthenticator::expect_sent(std::uint16_t source, FrameType type, Place place) noexcept {
  expect(sent_, nonce_of(source, secured(type), place));
}

std::optional<security::Block> FrameAuthenticator::begin(std::uint64_t nonce,
                                                         std::span<const std::uint8_t> bytes) noexcept {
  for (const auto* expected : {&received_, &sent_}) {
    if (!*expected || (*expected)->nonce != nonce) continue;
    security::begin_code(*cipher_, *session_key_, (*expected)->prepared.first, bytes);
    return (*expected)->prepared.mask;
  }
  return begin(*session_key_, nonce, bytes);
}

std::optional<security::Block> FrameAuthenticator::begin(const Key& key, std::uint64_t nonce,
                                                         std::span<const std::uint8_t> bytes) noexcept {
  const auto prepared = prepare(*cipher_, key, nonce);
  if (!prepared) return std::nullopt;
  security::begin_code(*cipher_, key, prepared->first, bytes);
  return prepared->mask;
}

void FrameAuthenticator::begin_check(std::span<const std::uint8_t> frame, std::uint64_t nonce) noexcept {
  abandon();
  if (!on() || !session_key_) return;
  if (const auto mask = begin(nonce, without_code(frame))) checking_ = {frame, nonce, *mask};
}

void FrameAuthenticator::begin_verify(std::span<const std::uint8_t> frame, Place place) noexcept {
  abandon();
  if (!received_ || !is_whole(frame)) return;
  if (const std::uint64_t nonce = nonce_of(frame, place); nonce == received_->nonce)
    begin_check(frame, nonce);
}

bool FrameAuthenticator::fits(std::span<const std::uint8_t> frame, Place place) noexcept {
  if (!is_whole(frame)) return false;
  const std::uint64_t nonce = nonce_of(frame, place);
  const bool begun = checking_ && checking_->nonce == nonce && checking_->frame.data() == frame.data() &&
                     checking_->frame.size() == frame.size();
  if (!begun) begin_check(frame, nonce);
  if (!checking_) return false;
  const auto code = security::end_code(*cipher_, checking_->mask);
  checking_.reset();
  return mac::fits(code, frame);
}

bool FrameAuthenticator::fits(std::span<const std::uint8_t> frame, const Beacon& beacon) noexcept {
  if (!on()) return false;
  if (session_key_ && beacon.session == session_) return fits(frame, place_of(beacon));
  return fits(frame, place_of(beacon), key_of(beacon.session));
}

bool FrameAuthenticator::fits(std::span<const std::uint8_t> frame, const Beacon& beacon,
                              const MergeTarget& merge_target) noexcept {
  return on() && fits(frame, place_of(beacon), call_key(beacon.session, merge_target));
}

bool FrameAuthenticator::fits_challenge(std::span<const std::uint8_t> frame, Place place,
                                        std::uint64_t nonce) noexcept {
  return on() && fits(frame, place, challenge_key(nonce));
}

bool FrameAuthenticator::fits(std::span<const std::uint8_t> frame, Place place,
                              const std::optional<Key>& key) noexcept {
  if (!key || !is_whole(frame)) return false;
  abandon();
  const auto mask = begin(*key, nonce_of(frame, place), without_code(frame));
  return mask && mac::fits(security::end_code(*cipher_, *mask), frame);
}

void FrameAuthenticator::begin_signing(const FrameBytes& frame, Place place) noexcept {
  abandon();
  const auto bytes = frame.bytes();
  if (!on() || !session_key_ || !may_sign(kind_of(bytes), place)) return;
  signing_mask_ = begin(nonce_of(bytes, place), without_code(bytes));
}

void FrameAuthenticator::begin_signing(const FrameBytes& frame, Place place,
                                       const MergeTarget& merge_target) noexcept {
  abandon();
  if (!on() || !may_sign(kMergeRequests, place)) return;
  begin_signing(frame, place, call_key(session_, merge_target));
}

void FrameAuthenticator::begin_signing_challenge(const FrameBytes& frame, Place place,
                                                 std::uint64_t nonce) noexcept {
  abandon();
  if (!on() || signed_places_ == nullptr || !signed_places_->take_challenge(nonce, place)) return;
  begin_signing(frame, place, challenge_key(nonce));
}

void FrameAuthenticator::begin_signing(const FrameBytes& frame, Place place,
                                       const std::optional<Key>& key) noexcept {
  if (!key) return;
  const auto bytes = frame.bytes();
  signing_mask_ = begin(*key, nonce_of(bytes, place), without_code(bytes));
}

void FrameAuthenticator::finish_signing(FrameBytes& frame) noexcept {
  if (!signing_mask_) return;
  const auto code = security::end_code(*cipher_, *signing_mask_);
  signing_mask_.reset();
  if (code) std::copy(code->begin(), code->end(), frame.code().begin());
}

}  // namespace groma::mac
