#include "firmware/soc/nrf52832/nvmc.hpp"

#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {
namespace {

constexpr std::uint32_t kFirstPage = 0x7'E000;

void await_ready() noexcept {
  while (nvmc::kBlock[nvmc::kReady] == 0) {
  }
}

// Enables one kind of flash operation (`mode`) during its lifetime.
class Unlocked {
 public:
  explicit Unlocked(std::uint32_t mode) noexcept { nvmc::kBlock[nvmc::kConfig] = mode; }
  ~Unlocked() noexcept {
    await_ready();
    nvmc::kBlock[nvmc::kConfig] = nvmc::kReadOnly;
  }
  Unlocked(const Unlocked&) = delete;
  Unlocked& operator=(const Unlocked&) = delete;
};

}  // namespace

bool Nvmc::erase(std::size_t page) noexcept {
  if (page >= kPages) return false;
  const std::uint32_t begin = static_cast<std::uint32_t>(page) * kPageBytes;
  {
    const Unlocked unlocked(nvmc::kErase);
    nvmc::kBlock[nvmc::kErasePage] = kFirstPage + begin;
  }
  for (std::uint32_t offset = begin; offset < begin + kPageBytes; offset += 4) {
    if (read(offset) != 0xFFFF'FFFF) return false;
  }
  return true;
}

bool Nvmc::write(std::uint32_t offset, std::uint32_t word) noexcept {
  if (offset % 4 != 0 || offset >= kPages * kPageBytes) return false;
  write_flash_word(at(kFirstPage + offset), word);
  return read(offset) == word;
}

void write_flash_word(Register& word, std::uint32_t value) noexcept {
  const Unlocked unlocked(nvmc::kWrite);
  word = value;
}

std::uint32_t Nvmc::read(std::uint32_t offset) const noexcept {
  return at(kFirstPage + offset);
}

}  // namespace groma::nrf52832
