// The MIC against published vectors. test/sim/aes_test.cpp compares it and the cipher with OpenSSL.
#include "firmware/core/security/ccm.hpp"

#include <gtest/gtest.h>

#include <array>
#include <cstdint>
#include <optional>
#include <span>
#include <vector>

#include "firmware/sim/aes.hpp"

namespace groma::security {
namespace {

class BrokenCipher final : public BlockCipher {
 public:
  explicit BrokenCipher(int good) : good_(good) {}
  bool encrypt(const Key& key, Block& block) noexcept override {
    return good_-- > 0 && aes_.encrypt(key, block);
  }

 private:
  int good_;
  sim::Aes aes_;
};

// IEEE 802.15.4-2006, annex C.2.1: a beacon with security level 2, MIC-64.
constexpr Key kBeaconKey = {0xC0, 0xC1, 0xC2, 0xC3, 0xC4, 0xC5, 0xC6, 0xC7,
                            0xC8, 0xC9, 0xCA, 0xCB, 0xCC, 0xCD, 0xCE, 0xCF};
constexpr Nonce kBeaconNonce = {0xAC, 0xDE, 0x48, 0x00, 0x00, 0x00, 0x00, 0x01, 0x00, 0x00, 0x00, 0x05, 0x02};
constexpr std::array<std::uint8_t, 26> kBeacon = {0x08, 0xD0, 0x84, 0x21, 0x43, 0x01, 0x00, 0x00, 0x00,
                                                  0x00, 0x48, 0xDE, 0xAC, 0x02, 0x05, 0x00, 0x00, 0x00,
                                                  0x55, 0xCF, 0x00, 0x00, 0x51, 0x52, 0x53, 0x54};
constexpr Code kBeaconMic = {0x22, 0x3B, 0xC1, 0xEC, 0x84, 0x1A, 0xB5, 0x53};

// FIPS 197, appendix B and C.1.
TEST(Aes, MatchesTheStandardsVectors) {
  sim::Aes aes;
  Block block = {0x32, 0x43, 0xF6, 0xA8, 0x88, 0x5A, 0x30, 0x8D,
                 0x31, 0x31, 0x98, 0xA2, 0xE0, 0x37, 0x07, 0x34};
  ASSERT_TRUE(aes.encrypt(
      {0x2B, 0x7E, 0x15, 0x16, 0x28, 0xAE, 0xD2, 0xA6, 0xAB, 0xF7, 0x15, 0x88, 0x09, 0xCF, 0x4F, 0x3C},
      block));
  EXPECT_EQ(block, (Block{0x39, 0x25, 0x84, 0x1D, 0x02, 0xDC, 0x09, 0xFB, 0xDC, 0x11, 0x85, 0x97, 0x19, 0x6A,
                          0x0B, 0x32}));
  Key key{};
  for (std::size_t i = 0; i < key.size(); ++i) {
    key[i] = static_cast<std::uint8_t>(i);
    block[i] = static_cast<std::uint8_t>(0x11 * i);
  }
  ASSERT_TRUE(aes.encrypt(key, block));
  EXPECT_EQ(block, (Block{0x69, 0xC4, 0xE0, 0xD8, 0x6A, 0x7B, 0x04, 0x30, 0xD8, 0xCD, 0xB7, 0x80, 0x70, 0xB4,
                          0xC5, 0x5A}));
}

TEST(Ccm, ReproducesTheStandardsBeaconMic) {
  sim::Aes aes;
  EXPECT_EQ(code_of(aes, kBeaconKey, kBeaconNonce, kBeacon), kBeaconMic);
}

TEST(Ccm, ChangesWithEachBitOfKeyNonceAndBytes) {
  sim::Aes aes;
  const auto differs = [&](const Key& key, const Nonce& nonce, std::span<const std::uint8_t> bytes) {
    const auto mic = code_of(aes, key, nonce, bytes);
    return mic.has_value() && *mic != kBeaconMic;
  };
  for (std::size_t bit = 0; bit < 8 * kBeaconKey.size(); ++bit) {
    Key key = kBeaconKey;
    key[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    EXPECT_TRUE(differs(key, kBeaconNonce, kBeacon)) << bit;
  }
  for (std::size_t bit = 0; bit < 8 * kBeaconNonce.size(); ++bit) {
    Nonce nonce = kBeaconNonce;
    nonce[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    EXPECT_TRUE(differs(kBeaconKey, nonce, kBeacon)) << bit;
  }
  for (std::size_t bit = 0; bit < 8 * kBeacon.size(); ++bit) {
    auto bytes = kBeacon;
    bytes[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    EXPECT_TRUE(differs(kBeaconKey, kBeaconNonce, bytes)) << bit;
  }
  // The MIC covers the length: trailing zeros are not taken for padding.
  std::vector<std::uint8_t> longer(kBeacon.begin(), kBeacon.end());
  longer.push_back(0);
  EXPECT_TRUE(differs(kBeaconKey, kBeaconNonce, longer));
}

TEST(Ccm, UsesTheStatedNumberOfBlocks) {
  for (const std::size_t bytes : {1U, 13U, 14U, 15U, 26U, 30U, 31U, 117U}) {
    const int blocks = 2 + static_cast<int>((2 + bytes + 15) / 16);
    const std::vector<std::uint8_t> content(bytes, 0x5A);
    BrokenCipher enough(blocks);
    EXPECT_TRUE(code_of(enough, kBeaconKey, kBeaconNonce, content)) << bytes;
    for (int good = 0; good < blocks; ++good) {
      BrokenCipher broken(good);
      EXPECT_FALSE(code_of(broken, kBeaconKey, kBeaconNonce, content)) << bytes << ", " << good;
    }
  }
}

TEST(Equal, DetectsEachDifference) {
  const Code mic = kBeaconMic;
  EXPECT_TRUE(equal(mic, kBeaconMic));
  for (std::size_t bit = 0; bit < 64; ++bit) {
    Code other = mic;
    other[bit / 8] ^= static_cast<std::uint8_t>(1U << bit % 8);
    EXPECT_FALSE(equal(mic, other)) << bit;
  }
  EXPECT_FALSE(equal(mic, std::span(mic).first(7)));
  EXPECT_TRUE(equal({}, {}));
}

}  // namespace
}  // namespace groma::security
