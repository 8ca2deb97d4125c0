// The workarounds and settings that the chip's revisions require early in start-up.
#include "firmware/arch/cortex_m4/startup.hpp"
#include "firmware/soc/nrf52832/nvmc.hpp"
#include "firmware/soc/nrf52832/registers.hpp"

namespace groma::nrf52832 {
namespace {

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

}  // namespace groma::nrf52832

void groma::cortex_m4::prepare_chip() noexcept {
  using namespace groma::nrf52832;
  nvmc::kBlock[nvmc::kCacheConfig] = nvmc::kCacheEnabled;
  apply_erratum_108();
  open_debug_port();
}
