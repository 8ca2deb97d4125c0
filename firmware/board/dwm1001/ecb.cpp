#include "firmware/board/dwm1001/ecb.hpp"

#include "firmware/board/dwm1001/memory.hpp"
#include "firmware/board/dwm1001/nrf52832.hpp"

namespace groma::dwm1001 {

namespace ecb = nrf52832::ecb;

bool Ecb::encrypt(const security::Key& key, security::Block& block) noexcept {
  // A block takes some forty looks; far more of them mean that it will not come.
  constexpr int kLooks = 2'000;
  data_.key = key;
  data_.clear = block;
  ecb::kBlock[ecb::kDataPointer] = address_of(&data_);
  ecb::kBlock[ecb::kEventEnd] = 0;
  ecb::kBlock[ecb::kEventError] = 0;
  asm volatile("" ::: "memory");
  ecb::kBlock[ecb::kStart] = 1;
  int looks = 0;
  while (ecb::kBlock[ecb::kEventEnd] == 0) {
    if (++looks > kLooks || ecb::kBlock[ecb::kEventError] != 0) {
      ecb::kBlock[ecb::kStop] = 1;
      return false;
    }
  }
  asm volatile("" ::: "memory");
  block = data_.encrypted;
  return true;
}

}  // namespace groma::dwm1001
