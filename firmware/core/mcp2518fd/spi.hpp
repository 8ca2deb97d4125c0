#pragma once

#include <concepts>
#include <cstdint>
#include <span>

namespace groma::mcp2518fd {

// The bus to one MCP2518FD: mode 0, most significant bit first, at most kMaxSpi_hz. A call is one chip-select
// window. It sends each byte of `inout` and replaces it by the one received. Returns when the transfer is
// over.
template <class S>
concept Spi = requires(S& spi, std::span<std::uint8_t> inout) {
  { spi.transfer(inout) }
  noexcept->std::same_as<void>;
};

// 0.85 of half the controller's clock of 40 MHz; faster, writes to its RAM can fail (errata DS80000789).
inline constexpr std::uint32_t kMaxSpi_hz = 17'000'000;

}  // namespace groma::mcp2518fd
