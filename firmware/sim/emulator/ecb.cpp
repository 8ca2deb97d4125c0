#include "firmware/sim/emulator/ecb.hpp"

#include <algorithm>
#include <span>
#include <utility>

#include "firmware/sim/simulation_error.hpp"

namespace groma::sim {

namespace {

enum : std::uint32_t {
  kTasksStartecb = 0x000,
  kTasksStopecb = 0x004,
  kEcbdataptr = 0x504,
};

}  // namespace

void Ecb::reset() {
  events_ = EventRegisters{0x3};
  pointer_ = 0;
  end_at_ = kNever;
  spoiled_ = 0;
}

void Ecb::spoil_start(SimTime t, std::uint8_t bits) noexcept {
  if (busy() && t - (end_at_ - kBlockTime) < kDmaStart) spoiled_ = bits;
}

void Ecb::advance(SimTime t) {
  if (end_at_ > t) return;
  end_at_ = kNever;
  const std::span<std::uint8_t> data = dma_.at(pointer_, kDataBytes, "ECBDATAPTR");
  if (!std::equal(taken_.begin(), taken_.end(), data.begin())) {
    throw SimulationError("ECB: key or clear block changed while it was encrypted");
  }
  security::Key key{};
  security::Block block{};
  std::copy_n(taken_.begin(), key.size(), key.begin());
  std::copy_n(taken_.begin() + key.size(), block.size(), block.begin());
  if (spoiled_ != 0) ++spoiled_blocks_;
  block[0] ^= std::exchange(spoiled_, std::uint8_t{0});
  if (aes_.encrypt(key, block)) std::copy(block.begin(), block.end(), data.last(block.size()).begin());
  ++blocks_;
  events_.raise(kEnd);
}

std::optional<std::uint32_t> Ecb::read(SimTime, std::uint32_t offset) {
  if (offset == kEcbdataptr) return pointer_;
  return events_.read(offset);
}

bool Ecb::write(SimTime t, std::uint32_t offset, std::uint32_t value) {
  switch (offset) {
    case kTasksStartecb: {
      if (value == 0) return true;
      if (busy()) throw SimulationError("ECB: STARTECB while a block is being encrypted");
      const std::span<std::uint8_t> data = dma_.at(pointer_, kDataBytes, "ECBDATAPTR");
      std::copy_n(data.begin(), taken_.size(), taken_.begin());
      end_at_ = t + kBlockTime;
      return true;
    }
    case kTasksStopecb:
      if (value == 0 || !busy()) return true;
      end_at_ = kNever;
      spoiled_ = 0;
      events_.raise(kError);
      return true;
    case kEcbdataptr:
      if (busy()) throw SimulationError("ECB: ECBDATAPTR written while a block is being encrypted");
      pointer_ = value;
      return true;
    default:
      return events_.write(offset, value);
  }
}

}  // namespace groma::sim
