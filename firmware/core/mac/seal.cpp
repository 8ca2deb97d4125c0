#include "firmware/core/mac/seal.hpp"

#include <algorithm>

namespace groma::mac {
namespace {

using security::Code;
using security::Key;
using security::Nonce;

// In a frame's bytes.
constexpr std::size_t kSource = 7;
constexpr std::size_t kType = 9;
static_assert(kType + 1 == kHeaderBytes);

std::optional<Code> code_of(security::BlockCipher& cipher, const Key& key,
                            std::span<const std::uint8_t> frame, Place place) noexcept {
  if (frame.size() < kHeaderBytes) return std::nullopt;
  const Nonce nonce = {frame[kSource],
                       frame[kSource + 1],
                       static_cast<std::uint8_t>(place.superframe),
                       static_cast<std::uint8_t>(place.superframe >> 8),
                       static_cast<std::uint8_t>(place.superframe >> 16),
                       static_cast<std::uint8_t>(place.superframe >> 24),
                       place.slot,
                       frame[kType]};
  return security::code_of(cipher, key, nonce, frame);
}

bool fits(security::BlockCipher& cipher, const Key& key, std::span<const std::uint8_t> frame,
          Place place) noexcept {
  if (frame.size() < kHeaderBytes + kCodeBytes) return false;
  const auto code = code_of(cipher, key, frame.first(frame.size() - kCodeBytes), place);
  return code && security::equal(*code, frame.last(kCodeBytes));
}

}  // namespace

std::optional<Key> Seal::key_of(std::uint64_t session) noexcept {
  security::Block block = {0, 0, 0, 0, 0, 0, 0, 0, 'g', 'r', 'o', 'm', 'a'};
  for (std::size_t i = 0; i < 8; ++i) block[i] = static_cast<std::uint8_t>(session >> (8 * i));
  Key network_key;
  std::copy(network_key_.begin(), network_key_.end(), network_key.begin());
  if (!cipher_->encrypt(network_key, block)) return std::nullopt;
  return block;
}

void Seal::enter(std::uint64_t session) noexcept {
  if (!on()) return;
  session_ = session;
  session_key_ = key_of(session);
}

void Seal::sign(FrameBytes& frame, Place place) noexcept {
  if (!on() || !session_key_) return;
  const auto bytes = frame.bytes();
  if (const auto code = code_of(*cipher_, *session_key_, bytes.first(bytes.size() - kCodeBytes), place)) {
    std::copy(code->begin(), code->end(), frame.code().begin());
  }
}

bool Seal::fits(std::span<const std::uint8_t> frame, Place place) noexcept {
  return on() && session_key_ && mac::fits(*cipher_, *session_key_, frame, place);
}

bool Seal::fits(std::span<const std::uint8_t> frame, const Beacon& beacon) noexcept {
  if (!on()) return false;
  if (session_key_ && beacon.session == session_) return fits(frame, place_of(beacon));
  const auto key = key_of(beacon.session);
  return key && mac::fits(*cipher_, *key, frame, place_of(beacon));
}

}  // namespace groma::mac
