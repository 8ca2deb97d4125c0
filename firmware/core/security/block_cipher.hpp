// The one thing that authentication asks of the hardware: AES-128, one block at a time.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace groma::security {

inline constexpr std::size_t kBlockBytes = 16;
using Block = std::array<std::uint8_t, kBlockBytes>;
using Key = std::array<std::uint8_t, kBlockBytes>;

class BlockCipher {
 public:
  // The block encrypted in place, bytes in FIPS 197's order. False: it was not, and the block holds anything.
  [[nodiscard]] virtual bool encrypt(const Key& key, Block& block) noexcept = 0;

 protected:
  constexpr BlockCipher() = default;
  BlockCipher(const BlockCipher&) = default;
  BlockCipher& operator=(const BlockCipher&) = default;
  ~BlockCipher() = default;
};

}  // namespace groma::security
