// The simulated cipher and the core's CCM* against OpenSSL's.
#include "firmware/sim/aes.hpp"

#include <gtest/gtest.h>
#include <openssl/evp.h>

#include <memory>
#include <random>
#include <vector>

#include "firmware/core/security/ccm.hpp"

namespace groma::sim {
namespace {

using Context = std::unique_ptr<EVP_CIPHER_CTX, decltype(&EVP_CIPHER_CTX_free)>;

security::Block openssl_block(const security::Key& key, const security::Block& clear) {
  const Context context(EVP_CIPHER_CTX_new(), &EVP_CIPHER_CTX_free);
  security::Block out{};
  int size = 0;
  EXPECT_EQ(EVP_EncryptInit_ex(context.get(), EVP_aes_128_ecb(), nullptr, key.data(), nullptr), 1);
  EVP_CIPHER_CTX_set_padding(context.get(), 0);
  EXPECT_EQ(EVP_EncryptUpdate(context.get(), out.data(), &size, clear.data(), static_cast<int>(clear.size())),
            1);
  return out;
}

security::Code openssl_mic(const security::Key& key, const security::Nonce& nonce,
                           const std::vector<std::uint8_t>& bytes) {
  const Context context(EVP_CIPHER_CTX_new(), &EVP_CIPHER_CTX_free);
  EVP_CIPHER_CTX* const c = context.get();
  security::Code mic{};
  int size = 0;
  std::uint8_t nothing = 0;
  EXPECT_EQ(EVP_EncryptInit_ex(c, EVP_aes_128_ccm(), nullptr, nullptr, nullptr), 1);
  EXPECT_EQ(EVP_CIPHER_CTX_ctrl(c, EVP_CTRL_AEAD_SET_IVLEN, static_cast<int>(nonce.size()), nullptr), 1);
  EXPECT_EQ(EVP_CIPHER_CTX_ctrl(c, EVP_CTRL_AEAD_SET_TAG, static_cast<int>(mic.size()), nullptr), 1);
  EXPECT_EQ(EVP_EncryptInit_ex(c, nullptr, nullptr, key.data(), nonce.data()), 1);
  EXPECT_EQ(EVP_EncryptUpdate(c, nullptr, &size, nullptr, 0), 1);
  EXPECT_EQ(EVP_EncryptUpdate(c, nullptr, &size, bytes.data(), static_cast<int>(bytes.size())), 1);
  EXPECT_EQ(EVP_EncryptUpdate(c, &nothing, &size, &nothing, 0), 1);
  EXPECT_EQ(EVP_CIPHER_CTX_ctrl(c, EVP_CTRL_AEAD_GET_TAG, static_cast<int>(mic.size()), mic.data()), 1);
  return mic;
}

template <class A>
void fill(A& bytes, std::mt19937_64& random) {
  for (auto& byte : bytes) byte = static_cast<std::uint8_t>(random());
}

TEST(SimulatedAes, MatchesOpenSsl) {
  std::mt19937_64 random(1);
  Aes aes;
  for (int i = 0; i < 2'000; ++i) {
    security::Key key{};
    security::Block block{};
    fill(key, random);
    fill(block, random);
    const auto expected = openssl_block(key, block);
    ASSERT_TRUE(aes.encrypt(key, block));
    ASSERT_EQ(block, expected) << i;
  }
}

TEST(Ccm, MatchesOpenSslForAllLengths) {
  std::mt19937_64 random(2);
  Aes aes;
  for (std::size_t length = 1; length <= 300; ++length) {
    security::Key key{};
    security::Nonce nonce{};
    std::vector<std::uint8_t> bytes(length);
    fill(key, random);
    fill(nonce, random);
    fill(bytes, random);
    ASSERT_EQ(security::code_of(aes, key, nonce, bytes), openssl_mic(key, nonce, bytes)) << length;
  }
}

}  // namespace
}  // namespace groma::sim
