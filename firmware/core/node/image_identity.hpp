// The identity of an image, readable without running it. It is in flash after the vector table and is found
// by its mark. A flashing tool reads from it whether a file is an image of this project, which build, and of
// which board. docs/explanation/image.md has the bytes.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace groma::node {

// An array with the text and zeros behind it; a longer text is truncated.
template <std::size_t N>
constexpr std::array<char, N> zero_terminated(const char* text) noexcept {
  std::array<char, N> out{};
  for (std::size_t i = 0; i + 1 < N && text[i] != '\0'; ++i) out[i] = text[i];
  return out;
}

struct ImageIdentity {
  static constexpr std::array<char, 8> kMark{'G', 'R', 'O', 'M', 'A', 'I', 'M', 'G'};
  // Older images end with the hash: other bytes follow there.
  static constexpr std::array<char, 8> kBoardMark{'G', 'R', 'O', 'M', 'A', 'B', 'R', 'D'};
  // The mark is within this many bytes of the start of flash.
  static constexpr std::size_t kSearched_bytes = 1024;

  constexpr ImageIdentity(const char* version_text, std::uint32_t hash, const char* board_name) noexcept
      : version(zero_terminated<24>(version_text)), git_hash(hash), board(zero_terminated<24>(board_name)) {}

  std::array<char, 8> mark = kMark;
  std::array<char, 24> version;  // ends with a zero
  std::uint32_t git_hash;        // little-endian
  std::array<char, 8> board_mark = kBoardMark;
  std::array<char, 24> board;  // its folder's name in firmware/board; ends with a zero
};
static_assert(sizeof(ImageIdentity) == 68);

}  // namespace groma::node
