#include "firmware/core/mac/frame_authenticator.hpp"

#include <algorithm>
#include <utility>

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

constexpr bool is_whole(std::span<const std::uint8_t> frame) noexcept {
  return frame.size() >= kHeaderBytes + kCodeBytes;
}

// Returns false for a place before `next`, which counts the places of a session.
bool advance(std::uint64_t& next, Place place) noexcept {
  const std::uint64_t at = std::uint64_t{place.superframe} << 8 | place.slot;
  if (at < next) return false;
  next = at + 1;
  return true;
}

}  // namespace

bool SignedPlaces::take(std::uint64_t session, std::size_t kind, Place place) noexcept {
  if (session != session_) next_.fill(0);
  session_ = session;
  return advance(next_[kind], place);
}

bool SignedPlaces::take_challenge(std::uint64_t nonce, Place place) noexcept {
  if (nonce < challenge_) return false;
  if (nonce > challenge_) next_of_challenge_ = 0;
  challenge_ = nonce;
  return advance(next_of_challenge_, place);
}

// ---- keys

std::optional<Key> FrameAuthenticator::derive(const Key& key, std::uint64_t number, std::string_view text,
                                              std::uint32_t last) noexcept {
  abandon();
  security::Block block{};
  for (std::size_t i = 0; i < 8; ++i) block[i] = static_cast<std::uint8_t>(number >> (8 * i));
  for (std::size_t i = 0; i < 4; ++i) block[12 + i] = static_cast<std::uint8_t>(last >> (8 * i));
  std::copy(text.begin(), text.end(), block.begin() + 8);
  return cipher_->encrypt(key, block) ? std::optional(block) : std::nullopt;
}

const std::optional<Key>& FrameAuthenticator::key_of(std::uint64_t session) noexcept {
  if (session_key_ && session_ == session) return session_key_;
  if (other_key_ && other_session_ == session) return other_key_;
  Key network_key;
  std::copy(network_key_.begin(), network_key_.end(), network_key.begin());
  other_session_ = session;
  other_key_ = derive(network_key, session, "groma");
  return other_key_;
}

std::optional<Key> FrameAuthenticator::key_for(const Body& body, const MergeTarget& merge_target) noexcept {
  if (const auto* beacon = std::get_if<Beacon>(&body)) {
    const auto& key = key_of(beacon->session);
    if (!key || !beacon->merge_request) return key;
    return derive(*key, merge_target.session, "call", merge_target.superframe);
  }
  const Join* challenge = challenge_of(body);
  if (challenge == nullptr) return session_key_;
  return session_key_ ? derive(*session_key_, challenge->nonce, "join") : std::nullopt;
}

void FrameAuthenticator::enter(std::uint64_t session) noexcept {
  if (!on()) return;
  session_key_ = key_of(session);
  session_ = session;
  received_.reset();
  sent_.reset();
}

// ---- MICs

void FrameAuthenticator::expect(std::optional<Expected>& out, std::uint16_t source, FrameType type,
                                Place place) noexcept {
  const std::uint64_t nonce = nonce_of(source, static_cast<std::uint8_t>(type) | kSecuredFlag, place);
  if (!session_key_ || (out && out->nonce == nonce)) return;
  abandon();
  out.reset();
  if (const auto prepared = prepare(*cipher_, *session_key_, nonce)) out = {nonce, *prepared};
}

std::optional<security::Block> FrameAuthenticator::begin(const std::optional<Key>& key,
                                                         const std::optional<Expected>& expected,
                                                         std::span<const std::uint8_t> frame,
                                                         Place place) noexcept {
  abandon();
  if (!key || !is_whole(frame)) return std::nullopt;
  const std::uint64_t nonce = nonce_of(frame, place);
  const bool prepared = expected && expected->nonce == nonce && key == session_key_;
  const auto parts = prepared ? std::optional(expected->prepared) : prepare(*cipher_, *key, nonce);
  if (!parts) return std::nullopt;
  security::begin_code(*cipher_, *key, parts->first, frame.first(frame.size() - kCodeBytes));
  return parts->mask;
}

bool FrameAuthenticator::ends_as(std::span<const std::uint8_t> frame,
                                 const std::optional<security::Block>& mask) noexcept {
  if (!mask) return false;
  const auto code = security::end_code(*cipher_, *mask);
  return code && security::equal(*code, frame.last(kCodeBytes));
}

void FrameAuthenticator::begin_verify(std::span<const std::uint8_t> frame, Place place) noexcept {
  abandon();
  if (!received_ || !is_whole(frame) || nonce_of(frame, place) != received_->nonce) return;
  if (const auto mask = begin(session_key_, received_, frame, place))
    checking_ = {frame, received_->nonce, *mask};
}

bool FrameAuthenticator::fits(std::span<const std::uint8_t> frame, const Body& body, Place place,
                              const MergeTarget& merge_target) noexcept {
  if (!on()) return false;
  const auto begun = std::exchange(checking_, std::nullopt);
  const auto key = key_for(body, merge_target);
  if (begun && key == session_key_ && begun->frame.data() == frame.data() &&
      begun->frame.size() == frame.size() && begun->nonce == nonce_of(frame, place)) {
    return ends_as(frame, begun->mask);
  }
  return ends_as(frame, begin(key, received_, frame, place));
}

void FrameAuthenticator::begin_signing(const FrameBytes& frame, const Body& body, Place place,
                                       const MergeTarget& merge_target) noexcept {
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

void FrameAuthenticator::finish_signing(FrameBytes& frame) noexcept {
  if (!signing_mask_) return;
  const auto code = security::end_code(*cipher_, *signing_mask_);
  signing_mask_.reset();
  if (code) std::copy(code->begin(), code->end(), frame.code().begin());
}

}  // namespace groma::mac
