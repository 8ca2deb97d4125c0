#include "host/provision/image.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <span>
#include <system_error>
#include <vector>

#include "firmware/core/node/image_identity.hpp"
#include "firmware/sim/emulator/firmware_image.hpp"
#include "firmware/sim/emulator/hex_file.hpp"
#include "firmware/sim/simulation_error.hpp"
#include "host/io/error.hpp"
#include "host/io/input_file.hpp"

namespace groma::provision {

namespace {

using node::ImageIdentity;

constexpr const char* kRemedy = "build it: cmake --preset dwm1001 && cmake --build --preset dwm1001";
constexpr std::uint32_t kConfigurationAddress = sim::kFlashBytes - 2 * sim::kFlashPageBytes;

// A text of at most `size` - 1 characters that ends with a zero.
std::string text_at(std::span<const std::uint8_t> bytes, std::size_t offset, std::size_t size) {
  const auto text = bytes.subspan(offset, size - 1);
  return {text.begin(), std::find(text.begin(), text.end(), std::uint8_t{0})};
}

std::uint32_t word_at(std::span<const std::uint8_t> bytes, std::size_t offset) {
  std::uint32_t word = 0;
  std::memcpy(&word, bytes.data() + offset, sizeof word);
  return word;
}

[[noreturn]] void fail(const std::filesystem::path& path, const std::string& problem) {
  throw io::DataError({path}, problem, kRemedy);
}

// Checks the stack pointer and entry that the core loads at reset.
void check_vectors(const std::filesystem::path& path, std::span<const std::uint8_t> image) {
  constexpr std::size_t kVectorBytes = 8;
  if (image.size() < kVectorBytes) fail(path, "has no vector table");
  const std::uint32_t stack = word_at(image, 0);
  const std::uint32_t entry = word_at(image, 4);
  const bool stack_in_ram = stack > sim::kRamAddress && stack <= sim::kRamAddress + sim::kRamBytes;
  const bool entry_in_image = (entry & 1U) != 0 && entry < image.size();
  if (!stack_in_ram || !entry_in_image) {
    fail(path, fmt::format("does not begin with a vector table (stack {:08x}, entry {:08x})", stack, entry));
  }
}

}  // namespace

NodeImage read_node_image(const std::filesystem::path& path) {
  if (!std::filesystem::exists(path)) fail(path, "no such image");
  const std::string text = io::read_file(path);
  std::vector<sim::HexSegment> segments;
  try {
    segments = sim::parse_hex(text);
  } catch (const sim::SimulationError& error) {
    fail(path, error.what());
  }
  std::vector<std::uint8_t> flash;
  for (const sim::HexSegment& segment : segments) {
    const std::uint64_t end = std::uint64_t{segment.address} + segment.bytes.size();
    if (segment.address >= sim::kUicrAddress && end <= sim::kUicrAddress + sim::kUicrBytes) continue;
    if (end > sim::kFlashBytes) {
      fail(path, fmt::format("{} bytes at 0x{:08x} lie in neither flash nor UICR", segment.bytes.size(),
                             segment.address));
    }
    if (end > kConfigurationAddress) {
      fail(path, fmt::format("would overwrite the node's configuration at 0x{:x}", kConfigurationAddress));
    }
    flash.resize(std::max(flash.size(), static_cast<std::size_t>(end)), 0xFF);
    std::copy(segment.bytes.begin(), segment.bytes.end(),
              flash.begin() + static_cast<std::ptrdiff_t>(segment.address));
  }
  check_vectors(path, flash);

  const auto searched = std::span(flash).first(std::min(flash.size(), ImageIdentity::kSearched_bytes));
  const auto mark =
      std::search(searched.begin(), searched.end(), ImageIdentity::kMark.begin(), ImageIdentity::kMark.end());
  const auto at = static_cast<std::size_t>(mark - searched.begin());
  if (mark == searched.end() || flash.size() - at < offsetof(ImageIdentity, board_mark))
    fail(path, "is not an image of a Groma node");
  NodeImage image;
  image.path = path;
  image.bytes = flash.size();
  image.version = text_at(flash, at + offsetof(ImageIdentity, version), sizeof(ImageIdentity::version));
  image.git_hash = word_at(flash, at + offsetof(ImageIdentity, git_hash));
  const bool names_board =
      flash.size() - at >= sizeof(ImageIdentity) &&
      std::equal(ImageIdentity::kBoardMark.begin(), ImageIdentity::kBoardMark.end(),
                 flash.begin() + static_cast<std::ptrdiff_t>(at + offsetof(ImageIdentity, board_mark)));
  if (names_board)
    image.board = text_at(flash, at + offsetof(ImageIdentity, board), sizeof(ImageIdentity::board));
  return image;
}

void require_board(const NodeImage& image, const std::string& board) {
  if (image.board.empty() || image.board == board) return;
  throw io::DataError(
      {image.path},
      fmt::format("is an image of the board {}, whose pins are not those of {}", image.board, board),
      fmt::format("give the image of {}, or '--board {}' if the nodes are such boards", board, image.board));
}

std::filesystem::path default_image_path() {
  std::error_code error;
  const std::filesystem::path program = std::filesystem::read_symlink("/proc/self/exe", error);
  // build/release/bin/groma
  const std::filesystem::path build = program.parent_path().parent_path().parent_path();
  return build / "dwm1001" / "groma-node.hex";
}

}  // namespace groma::provision
