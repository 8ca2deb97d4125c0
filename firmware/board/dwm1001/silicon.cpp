#include "firmware/board/dwm1001/silicon.hpp"

#include "firmware/board/dwm1001/nrf52832.hpp"
#include "firmware/board/dwm1001/nvmc.hpp"

namespace groma::dwm1001 {
namespace {

namespace ficr = nrf52832::ficr;
namespace power = nrf52832::power;
namespace uicr = nrf52832::uicr;

// Erratum 108: without this the RAM may lose its content in sleep.
void apply_erratum_108() noexcept {
  power::kBlock[power::kErratum108] = ficr::kBlock[ficr::kErratum108] & 0x4F;
}

// From revision 3 the debug port is closed at each reset unless both UICR.APPROTECT and the firmware open it
// (configuration 249). The firmware opens it: otherwise reflashing a module would also erase its
// configuration. An UICR.APPROTECT that was closed deliberately is not changed.
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
  apply_erratum_108();
  open_debug_port();
}

}  // namespace groma::dwm1001
