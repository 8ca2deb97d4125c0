#include "firmware/core/security/ccm.hpp"

#include <algorithm>

namespace groma::security {
namespace {

constexpr std::uint8_t kLengthBytes = 2;  // L: size of the message's length field
constexpr std::uint8_t kCounterFlags = kLengthBytes - 1;
constexpr std::uint8_t kAuthenticated = 0x40;  // there is authenticated data besides the (empty) message
constexpr std::uint8_t kFirstFlags = kAuthenticated | (std::tuple_size_v<Code> - 2) / 2 << 3 | kCounterFlags;

// B0 and A0: flags, nonce, and the message's length or a counter, both 0.
Block block_of(std::uint8_t flags, const Nonce& nonce) noexcept {
  Block block{flags};
  std::copy(nonce.begin(), nonce.end(), block.begin() + 1);
  return block;
}

}  // namespace

std::optional<Prepared> prepare(BlockCipher& cipher, const Key& key, const Nonce& nonce) noexcept {
  Prepared prepared{.first = block_of(kFirstFlags, nonce), .mask = block_of(kCounterFlags, nonce)};
  if (!cipher.encrypt(key, prepared.first) || !cipher.encrypt(key, prepared.mask)) return std::nullopt;
  return prepared;
}

void begin_code(BlockCipher& cipher, const Key& key, const Block& first,
                std::span<const std::uint8_t> bytes) noexcept {
  Block mac = first;
  mac[0] ^= static_cast<std::uint8_t>(bytes.size() >> 8);
  mac[1] ^= static_cast<std::uint8_t>(bytes.size());
  cipher.begin(key, mac, {.filled = 2, .rest = bytes});
}

std::optional<Code> end_code(BlockCipher& cipher, const Block& mask) noexcept {
  const auto mac = cipher.finish();
  if (!mac) return std::nullopt;
  Code code;
  for (std::size_t i = 0; i < code.size(); ++i) code[i] = (*mac)[i] ^ mask[i];
  return code;
}

std::optional<Code> code_of(BlockCipher& cipher, const Key& key, const Nonce& nonce,
                            std::span<const std::uint8_t> bytes) noexcept {
  const auto prepared = prepare(cipher, key, nonce);
  if (!prepared) return std::nullopt;
  begin_code(cipher, key, prepared->first, bytes);
  return end_code(cipher, prepared->mask);
}

bool equal(std::span<const std::uint8_t> a, std::span<const std::uint8_t> b) noexcept {
  if (a.size() != b.size()) return false;
  // Always compares all bytes: with a volatile the compiler cannot leave the loop at a difference.
  volatile std::uint8_t difference = 0;
  for (std::size_t i = 0; i < a.size(); ++i) difference = difference | (a[i] ^ b[i]);
  return difference == 0;
}

}  // namespace groma::security
