// The one thing that authentication asks of the hardware: AES-128, a block at a time, or a chain of blocks
// beside what the processor is at.
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

// What is still to be added in a CBC-MAC (NIST SP 800-38C, 6.1 step 3): to each block of it, which the one
// before has become, the next bytes.
struct Chain {
  std::size_t filled = 0;                // bytes of the next block that have theirs already
  std::span<const std::uint8_t> rest{};  // zeros after its end, up to a whole block

  // Adds to `state` what the next block takes of the rest. Word by word, for it is an interrupt's work; the
  // built-in, for a freestanding compiler calls the function.
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
  // The block encrypted in place, bytes in FIPS 197's order. False: it was not, and the block holds anything.
  [[nodiscard]] virtual bool encrypt(const Key& key, Block& block) noexcept = 0;

  // Begins a chain of at least one block, from `state` on. Its bytes stay as they are until finish(), or
  // until something else is asked of the cipher, which then waits for it.
  virtual void begin(const Key& key, const Block& state, Chain chain) noexcept {
    Block block = state;
    bool good = true;
    do {
      chain.absorb(block);
      good = encrypt(key, block);
    } while (good && !chain.rest.empty());
    result_ = good ? std::optional<Block>(block) : std::nullopt;
  }
  // What the last block of the chain begun last has become; nothing where the cipher failed.
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
