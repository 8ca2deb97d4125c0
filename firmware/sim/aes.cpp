#include "firmware/sim/aes.hpp"

#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>

namespace groma::sim {

namespace {

using security::Block;

constexpr int kRounds = 10;

// Times x in GF(2^8), modulo x^8 + x^4 + x^3 + x + 1 (FIPS 197, 4.2.1).
constexpr std::uint8_t twice(std::uint8_t a) {
  return static_cast<std::uint8_t>(a << 1 ^ (a >= 0x80 ? 0x1B : 0));
}

// The S-box (FIPS 197, 5.1.1): the multiplicative inverse, then an affine map. 3 generates the multiplicative
// group; 1/3 is 0xF6.
constexpr std::array<std::uint8_t, 256> substitutions() {
  std::array<std::uint8_t, 256> box{};
  std::uint8_t a = 1;
  std::uint8_t inverse = 1;
  do {
    a = static_cast<std::uint8_t>(a ^ twice(a));
    inverse ^= static_cast<std::uint8_t>(inverse << 1);
    inverse ^= static_cast<std::uint8_t>(inverse << 2);
    inverse ^= static_cast<std::uint8_t>(inverse << 4);
    if (inverse >= 0x80) inverse ^= 0x09;
    box[a] = static_cast<std::uint8_t>(inverse ^ std::rotl(inverse, 1) ^ std::rotl(inverse, 2) ^
                                       std::rotl(inverse, 3) ^ std::rotl(inverse, 4) ^ 0x63);
  } while (a != 1);
  box[0] = 0x63;
  return box;
}

constexpr std::array<std::uint8_t, 256> kBox = substitutions();

void add(Block& state, const Block& key) {
  for (std::size_t i = 0; i < state.size(); ++i) state[i] ^= key[i];
}

// 5.2, in place: the next round key from the previous one.
void expand(Block& key, std::uint8_t constant) {
  for (std::size_t i = 0; i < 4; ++i) key[i] ^= kBox[key[12 + (i + 1) % 4]];
  key[0] ^= constant;
  for (std::size_t i = 4; i < key.size(); ++i) key[i] ^= key[i - 4];
}

// 5.1.1 and 5.1.2: row r of column c comes from column c + r.
Block substitute_and_shift(const Block& state) {
  Block out;
  for (std::size_t c = 0; c < 4; ++c)
    for (std::size_t r = 0; r < 4; ++r) out[4 * c + r] = kBox[state[4 * ((c + r) % 4) + r]];
  return out;
}

// 5.1.3
void mix_columns(Block& state) {
  for (std::size_t c = 0; c < state.size(); c += 4) {
    const std::array<std::uint8_t, 4> in = {state[c], state[c + 1], state[c + 2], state[c + 3]};
    const auto all = static_cast<std::uint8_t>(in[0] ^ in[1] ^ in[2] ^ in[3]);
    for (std::size_t r = 0; r < 4; ++r)
      state[c + r] =
          static_cast<std::uint8_t>(in[r] ^ all ^ twice(static_cast<std::uint8_t>(in[r] ^ in[(r + 1) % 4])));
  }
}

}  // namespace

bool Aes::encrypt(const security::Key& key, Block& block) noexcept {
  Block round_key = key;
  add(block, round_key);
  std::uint8_t constant = 1;
  for (int round = 1; round <= kRounds; ++round) {
    block = substitute_and_shift(block);
    if (round < kRounds) mix_columns(block);
    expand(round_key, constant);
    constant = twice(constant);
    add(block, round_key);
  }
  return true;
}

}  // namespace groma::sim
