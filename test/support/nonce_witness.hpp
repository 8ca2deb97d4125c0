// The cipher of all nodes of a simulated keyed site. Finds each nonce that two of their frames share under
// one key: the MICs of the two would help to forge a third one. Knows nothing of how nodes choose keys and
// nonces.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <map>
#include <span>
#include <utility>
#include <vector>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/security/ccm.hpp"
#include "firmware/sim/aes.hpp"

namespace groma::testing {

class NonceWitness final : public security::BlockCipher {
 public:
  NonceWitness() = default;
  NonceWitness(const NonceWitness&) = delete;
  NonceWitness& operator=(const NonceWitness&) = delete;
  ~NonceWitness() {
    EXPECT_EQ(repeats(), 0U) << "nonces used twice";
    EXPECT_EQ(unexplained_, 0U) << "MICs of an unknown key or nonce";
  }

  [[nodiscard]] bool encrypt(const security::Key& key, security::Block& block) noexcept override {
    // B0 of CCM* without the length (ccm.cpp): flags, nonce, zeros.
    constexpr std::uint8_t kFirstFlags = 0x59;
    if (block[0] == kFirstFlags && block[14] == 0 && block[15] == 0) take(key, block);
    return aes_.encrypt(key, block);
  }

  // A frame that a node has sent.
  void see(std::span<const std::uint8_t> frame) {
    constexpr std::size_t kSource = 7;
    constexpr std::size_t kType = 9;
    if (frame.size() < mac::kHeaderBytes + mac::kCodeBytes || (frame[kType] & mac::kSecuredFlag) == 0) return;
    const auto code = frame.last(mac::kCodeBytes);
    if (std::all_of(code.begin(), code.end(), [](std::uint8_t byte) { return byte == 0; })) {
      ++unsigned_;
      return;
    }
    const auto& begun = begun_[{frame[kSource], frame[kSource + 1], frame[kType]}];
    const auto found = std::find_if(begun.rbegin(), begun.rend(), [&](const Begun& one) {
      const auto fitting =
          security::code_of(aes_, one.key, one.nonce, frame.first(frame.size() - code.size()));
      return fitting && security::equal(*fitting, code);
    });
    if (found == begun.rend()) {
      ++unexplained_;
    } else {
      used_.push_back(fingerprint_of(*found));
    }
  }

  [[nodiscard]] std::size_t signed_frames() const { return used_.size(); }
  // Frames that were sent with zeros in place of a MIC.
  [[nodiscard]] std::size_t unsigned_frames() const { return unsigned_; }
  [[nodiscard]] std::size_t repeats() const {
    auto sorted = used_;
    std::sort(sorted.begin(), sorted.end());
    return static_cast<std::size_t>(sorted.end() - std::unique(sorted.begin(), sorted.end()));
  }

 private:
  struct Begun {
    security::Key key{};
    security::Nonce nonce{};
    friend bool operator==(const Begun&, const Begun&) = default;
  };

  // Keeps the last ones of each sender and type: a frame is sent soon after its MIC was begun.
  void take(const security::Key& key, const security::Block& block) {
    constexpr std::size_t kKept = 64;
    constexpr std::size_t kSource = 0;
    constexpr std::size_t kType = 7;
    Begun one{.key = key};
    std::copy_n(block.begin() + 1, one.nonce.size(), one.nonce.begin());
    auto& begun = begun_[{one.nonce[kSource], one.nonce[kSource + 1], one.nonce[kType]}];
    if (std::find(begun.rbegin(), begun.rend(), one) != begun.rend()) return;
    if (begun.size() == kKept) begun.erase(begun.begin());
    begun.push_back(one);
  }
  // FNV-1a.
  static std::uint64_t fingerprint_of(const Begun& one) {
    std::uint64_t hash = 0xCBF2'9CE4'8422'2325U;
    const auto add = [&](std::uint8_t byte) { hash = (hash ^ byte) * 0x100'0000'01B3U; };
    std::for_each(one.key.begin(), one.key.end(), add);
    std::for_each(one.nonce.begin(), one.nonce.end(), add);
    return hash;
  }

  sim::Aes aes_;
  std::map<std::array<std::uint8_t, 3>, std::vector<Begun>> begun_;  // by the sender's id and the type byte
  std::vector<std::uint64_t> used_;                                  // each node's frames, of all time
  std::size_t unsigned_ = 0;
  std::size_t unexplained_ = 0;
};

}  // namespace groma::testing
