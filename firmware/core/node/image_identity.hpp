// The identity of an image, readable without running it. It is in flash after the vector table and is found
// by its mark. A flashing tool reads from it whether a file is an image of this project, and which build.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace groma::node {

struct ImageIdentity {
  static constexpr std::array<char, 8> kMark{'G', 'R', 'O', 'M', 'A', 'I', 'M', 'G'};
  // The mark is within this many bytes of the start of flash.
  static constexpr std::size_t kSearched_bytes = 1024;

  // A longer version is truncated.
  constexpr ImageIdentity(const char* text, std::uint32_t hash) noexcept : git_hash(hash) {
    for (std::size_t i = 0; i + 1 < version.size() && text[i] != '\0'; ++i) version[i] = text[i];
  }

  std::array<char, 8> mark = kMark;
  std::array<char, 24> version{};  // ends with a zero
  std::uint32_t git_hash;          // little-endian
};

}  // namespace groma::node
