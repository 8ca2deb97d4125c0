// The hardware interface for authentication: AES-128 for one block, or for a chain of blocks in the
// background.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

namespace groma::security {

inline constexpr std::size_t kBlockBytes = 16;
using Block = std::array<std::uint8_t, kBlockBytes>;
using Key = std::array<std::uint8_t, kBlockBytes>;

// The remaining input of a CBC-MAC (NIST SP 800-38C, 6.1 step 3): each output block is XORed with the next
// bytes and encrypted again.
struct Chain {
  std::size_t filled = 0;                // bytes of the next block that have been XORed already
  std::span<const std::uint8_t> rest{};  // padded with zeros to a whole block

  // XORs the next bytes into `state`. Works word by word because it runs in an interrupt, and with the
  // built-in because a freestanding compiler calls the memcpy function.
  void absorb(Block& state) noexcept {
    const std::size_t room = kBlockBytes - filled;
    const std::size_t taken = room < rest.size() ? room : rest.size();
    std::uint8_t* to = state.data() + filled;
    const std::uint8_t* from = rest.data();
    std::size_t left = taken;
    for (; left >= sizeof(std::uint32_t); left -= sizeof(std::uint32_t)) {
      std::uint32_t word = 0;
      std::uint32_t next = 0;
      __builtin_memcpy(&word, to, sizeof(word));
      __builtin_memcpy(&next, from, sizeof(next));
      word ^= next;
      __builtin_memcpy(to, &word, sizeof(word));
      to += sizeof(word);
      from += sizeof(word);
    }
    for (; left != 0; --left) *to++ ^= *from++;
    rest = rest.subspan(taken);
    filled = 0;
  }
};

class BlockCipher {
 public:
  // Encrypts the block in place, bytes in FIPS 197's order. Returns false on failure; the block is then
  // unspecified.
  [[nodiscard]] virtual bool encrypt(const Key& key, Block& block) noexcept = 0;

  // Starts a chain of at least one block, from `state`. The chain's bytes must not change until finish(), or
  // until another call to the cipher, which then waits for the chain.
  virtual void begin(const Key& key, const Block& state, Chain chain) noexcept {
    Block block = state;
    bool good = true;
    do {
      chain.absorb(block);
      good = encrypt(key, block);
    } while (good && !chain.rest.empty());
    result_ = good ? std::optional<Block>(block) : std::nullopt;
  }
  // The last output block of the chain started last; nothing if the cipher failed.
  [[nodiscard]] virtual std::optional<Block> finish() noexcept { return result_; }

 protected:
  constexpr BlockCipher() = default;
  BlockCipher(const BlockCipher&) = default;
  BlockCipher& operator=(const BlockCipher&) = default;
  ~BlockCipher() = default;

 private:
  std::optional<Block> result_{};
};

}  // namespace groma::security
