#include "firmware/sim/nor_flash.hpp"

#include <algorithm>

#include "firmware/sim/keyed_random.hpp"

namespace groma::sim {
namespace {

constexpr std::uint32_t kWordsPerPage = NorFlash::kPageBytes / 4;
constexpr std::uint32_t kErased = 0xFFFFFFFF;

}  // namespace

bool NorFlash::begin(SimTime duration) noexcept {
  busy_time_ += duration;
  if (operations_++ != cut_at_) return false;
  powered_ = false;
  return true;
}

bool NorFlash::erase(std::size_t page) noexcept {
  if (!powered_ || page >= wear_.size()) return false;
  const bool cut = begin(kEraseTime);
  const KeyedRandom random = KeyedRandom(seed_).of(operations_);
  const Tear tear = cut ? tear_ : Tear::kEverything;
  if (tear != Tear::kNothing) {
    ++wear_[page].erases;
    std::fill_n(wear_[page].writes, kBlocks, 0U);
  }
  for (std::uint32_t i = 0; i < kWordsPerPage; ++i) {
    std::uint32_t& word = words_[page * kWordsPerPage + i];
    const auto bits = static_cast<std::uint32_t>(random.of(i).bits());
    switch (tear) {
      case Tear::kNothing:
        break;
      case Tear::kEverything:
        word = kErased;
        break;
      case Tear::kHalf:
        if (i < kWordsPerPage / 2) word = kErased;
        break;
      case Tear::kSomeBits:
        word |= bits;
        break;
      case Tear::kAnyBits:
        word = bits;
        break;
    }
  }
  return !cut;
}

bool NorFlash::write(std::uint32_t offset, std::uint32_t word) noexcept {
  const std::size_t index = offset / 4;
  if (!powered_ || offset % 4 != 0 || index >= words_.size()) return false;
  const bool cut = begin(kWriteTime);
  const auto bits = static_cast<std::uint32_t>(KeyedRandom(seed_).of(operations_).bits());
  switch (cut ? tear_ : Tear::kEverything) {
    case Tear::kNothing:
      return false;
    case Tear::kEverything:
      break;
    case Tear::kHalf:
      word |= 0xFFFF0000;
      break;
    case Tear::kSomeBits:
    case Tear::kAnyBits:
      word |= bits;
      break;
  }
  if (words_[index] != kErased) ++overwrites_;
  words_[index] &= word;
  std::uint32_t& writes = wear_[offset / kPageBytes].writes[offset % kPageBytes / kBlockBytes];
  most_writes_ = std::max(most_writes_, ++writes);
  return !cut;
}

std::uint32_t NorFlash::read(std::uint32_t offset) const noexcept {
  return offset / 4 < words_.size() ? words_[offset / 4] : kErased;
}

void NorFlash::cut_power_at(std::uint64_t operation, Tear tear, std::uint64_t seed) noexcept {
  cut_at_ = operations_ + operation;
  tear_ = tear;
  seed_ = seed;
}

void NorFlash::power_on() noexcept {
  powered_ = true;
  cut_at_ = ~std::uint64_t{0};
}

}  // namespace groma::sim
