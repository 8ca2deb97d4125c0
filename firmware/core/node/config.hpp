// A node's configuration: what makes it valid, and its form in storage.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/mac/station.hpp"
#include "groma.pb.h"

namespace groma::node {

// Bytes that a stored configuration takes at most.
inline constexpr std::size_t kMaxConfigBytes = groma_Config_size;

// What keeps a node from working by this configuration, and what would be right: at most 63 characters, empty
// where nothing does.
[[nodiscard]] const char* fault_of(const groma_Config& config) noexcept;

// The bytes written to the start of `out`; 0 where they do not fit.
[[nodiscard]] std::size_t encode_config(const groma_Config& config, std::span<std::uint8_t> out) noexcept;
// Nothing where the bytes are no configuration.
[[nodiscard]] std::optional<groma_Config> decode_config(std::span<const std::uint8_t> bytes) noexcept;

// A delay or a power of 0 means the chip's own: see groma.proto.
[[nodiscard]] dw1000::RadioSettings radio_settings(const groma_Config& config) noexcept;

// Of a configuration without fault.
[[nodiscard]] mac::Site site_of(const groma_Config& config, ranging::Ticks transmit_antenna_delay) noexcept;
[[nodiscard]] std::uint32_t schedule_hash_of(const groma_Config& config) noexcept;
// Over all of it: CRC-32 of its encoded form.
[[nodiscard]] std::uint32_t config_hash_of(const groma_Config& config) noexcept;

}  // namespace groma::node
