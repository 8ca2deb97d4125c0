// FICR (0x10000000) and UICR (0x10001000): the data from the factory and from the flashing tool.
#pragma once

#include <cstdint>
#include <optional>
#include <span>

namespace groma::sim {

// The chip's individual data in FICR.
struct ChipIdentity {
  std::uint64_t device_id = 0;
};

// `offset`: from FICR's base. nullopt: no such register is modelled.
[[nodiscard]] std::optional<std::uint32_t> read_factory_information(const ChipIdentity& identity,
                                                                    std::uint32_t offset) noexcept;
// `offset`: from UICR's base. Modelled: CUSTOMER, PSELRESET, APPROTECT and NFCPINS.
[[nodiscard]] std::optional<std::uint32_t> read_user_information(std::span<const std::uint8_t> uicr,
                                                                 std::uint32_t offset) noexcept;

}  // namespace groma::sim
