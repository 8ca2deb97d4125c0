// The identity of an image, readable without running it. It is in flash after the vector table and is found
// by its mark. A flashing tool reads from it whether a file is an image of this project, which build, and of
// which board. docs/explanation/image.md has the bytes.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

namespace groma::node {

struct ImageIdentity {
  static constexpr std::array<char, 8> kMark{'G', 'R', 'O', 'M', 'A', 'I', 'M', 'G'};
  // Older images end with the hash: other bytes follow there.
  static constexpr std::array<char, 8> kBoardMark{'G', 'R', 'O', 'M', 'A', 'B', 'R', 'D'};
  // The mark is within this many bytes of the start of flash.
  static constexpr std::size_t kSearched_bytes = 1024;

  // A longer version or name is truncated.
  constexpr ImageIdentity(const char* version_text, std::uint32_t hash, const char* board_name) noexcept
      : git_hash(hash) {
    copy(version_text, version);
    copy(board_name, board);
  }

  std::array<char, 8> mark = kMark;
  std::array<char, 24> version{};  // ends with a zero
  std::uint32_t git_hash;          // little-endian
  std::array<char, 8> board_mark = kBoardMark;
  std::array<char, 24> board{};  // its folder's name in firmware/board; ends with a zero

 private:
  template <std::size_t N>
  static constexpr void copy(const char* text, std::array<char, N>& out) noexcept {
    for (std::size_t i = 0; i + 1 < N && text[i] != '\0'; ++i) out[i] = text[i];
  }
};
static_assert(sizeof(ImageIdentity) == 68);

}  // namespace groma::node
