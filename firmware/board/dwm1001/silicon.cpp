#include "firmware/board/dwm1001/silicon.hpp"

#include "firmware/board/dwm1001/nrf52832.hpp"
#include "firmware/board/dwm1001/nvmc.hpp"

namespace groma::dwm1001 {
namespace {

namespace ficr = nrf52832::ficr;
namespace power = nrf52832::power;
namespace uicr = nrf52832::uicr;

// Erratum 108: without this the RAM is not to be trusted after a sleep.
void trust_ram() noexcept {
  power::kBlock[power::kErratum108] = ficr::kBlock[ficr::kErratum108] & 0x4F;
}

// From revision 3 on the debug port closes at each reset, unless UICR.APPROTECT and the firmware both say
// that it is to be open (configuration 249). It is: else a module could be flashed anew only by erasing its
// configuration, too. An UICR that somebody has closed on purpose stays as it is.
void open_debug_port() noexcept {
  const bool closes =
      ficr::kBlock[ficr::kPart] == ficr::kNrf52832 && ficr::kBlock[ficr::kRevision] >= ficr::kRevision3;
  if (!closes) return;
  if (uicr::kBlock[uicr::kApprotect] == uicr::kErased) {
    write_flash_word(uicr::kBlock[uicr::kApprotect], uicr::kApprotectOpen);
  }
  power::kBlock[power::kApprotectDisable] = uicr::kBlock[uicr::kApprotect];
}

}  // namespace

void prepare_silicon() noexcept {
  trust_ram();
  open_debug_port();
}

}  // namespace groma::dwm1001
