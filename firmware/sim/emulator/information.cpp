#include "firmware/sim/emulator/information.hpp"

namespace groma::sim {

std::optional<std::uint32_t> read_factory_information(const ChipIdentity& identity,
                                                      std::uint32_t offset) noexcept {
  const auto low = static_cast<std::uint32_t>(identity.device_id);
  const auto high = static_cast<std::uint32_t>(identity.device_id >> 32);
  switch (offset) {
    case 0x010:  // CODEPAGESIZE
      return 4096;
    case 0x014:  // CODESIZE
      return 128;
    case 0x060:  // DEVICEID
      return low;
    case 0x064:
      return high;
    case 0x0A0:  // DEVICEADDRTYPE: random
      return 0xFFFFFFFF;
    case 0x0A4:  // DEVICEADDR
      return low ^ 0xA5A5A5A5;
    case 0x0A8:
      return high & 0xFFFF;
    case 0x100:  // INFO.PART
      return 0x52832;
    case 0x104:  // INFO.VARIANT: AAE0, silicon revision 2
      return 0x41414530;
    case 0x108:  // INFO.PACKAGE
      return 0x2000;
    case 0x10C:  // INFO.RAM, KiB
      return 64;
    case 0x110:  // INFO.FLASH, KiB
      return 512;
    case 0x130:  // part and revision as Nordic's start-up code reads them: nRF52832, revision 2
      return 6;
    case 0x134:
      return 5;
    case 0x258:  // for POWER's register of erratum 108
      return 0x4F;
    default:
      return std::nullopt;
  }
}

std::optional<std::uint32_t> read_user_information(std::span<const std::uint8_t> uicr,
                                                   std::uint32_t offset) noexcept {
  const bool customer = offset >= 0x080 && offset < 0x100;
  const bool known = customer || (offset >= 0x200 && offset <= 0x20C);
  if (!known || offset + 4 > uicr.size()) return std::nullopt;
  std::uint32_t value = 0;
  for (unsigned i = 0; i < 4; ++i) value |= static_cast<std::uint32_t>(uicr[offset + i]) << (8 * i);
  return value;
}

}  // namespace groma::sim
