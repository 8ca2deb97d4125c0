// FICR (0x10000000) and UICR (0x10001000): what the factory and the flashing tool wrote.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

namespace groma::sim {

// What the factory wrote of this one chip.
struct ChipIdentity {
  std::uint64_t device_id = 0;
};

// Offsets from FICR's base; nothing: no such register is modelled.
[[nodiscard]] std::optional<std::uint32_t> read_factory_information(const ChipIdentity& identity,
                                                                    std::uint32_t offset) noexcept;
// Offsets from UICR's base, of CUSTOMER, PSELRESET, APPROTECT and NFCPINS.
[[nodiscard]] std::optional<std::uint32_t> read_user_information(std::span<const std::uint8_t> uicr,
                                                                 std::uint32_t offset) noexcept;

}  // namespace groma::sim
