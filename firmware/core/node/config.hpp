// A node's configuration: what makes it valid, and its form in storage.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/mac/site.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/storage/record_store.hpp"
#include "groma.pb.h"

namespace groma::node {

// Bytes that a configuration takes at most, and in storage, where the one before may follow it.
inline constexpr std::size_t kMaxConfigBytes = groma_Config_size;
inline constexpr std::size_t kMaxStoredBytes = storage::kMaxRecordBytes;

// What keeps a node from working by this configuration, and what would be right: at most 63 characters, empty
// where nothing does.
[[nodiscard]] const char* fault_of(const groma_Config& config) noexcept;

// The bytes written to the start of `out`; 0 where they do not fit.
[[nodiscard]] std::size_t encode_config(const groma_Config& config, std::span<std::uint8_t> out) noexcept;
// False where the bytes are no configuration. What may follow it in storage is skipped.
[[nodiscard]] bool decode_config(std::span<const std::uint8_t> bytes, groma_Config& out) noexcept;
[[nodiscard]] inline std::optional<groma_Config> decode_config(std::span<const std::uint8_t> bytes) noexcept {
  std::optional<groma_Config> config(std::in_place);
  if (!decode_config(bytes, *config)) config.reset();
  return config;
}

// The stored form of a configuration on trial: followed by the one that comes back if it does not prove
// itself, as a field that a Config does not have. 0 where they do not fit.
[[nodiscard]] std::size_t encode_on_trial(const groma_Config& config, const groma_Config& before,
                                          std::span<std::uint8_t> out) noexcept;
// The one before; empty where there is none.
[[nodiscard]] std::span<const std::uint8_t> before_trial(std::span<const std::uint8_t> stored) noexcept;
// Cuts out of a stored configuration, in place, what is nobody's business: the network's key, and the one
// before. The bytes that remain, at its start, are the encoded form of without_key().
[[nodiscard]] std::span<const std::uint8_t> shown(std::span<std::uint8_t> stored) noexcept;

// A delay or a power of 0 means the chip's own: see groma.proto.
[[nodiscard]] dw1000::RadioSettings radio_settings(const groma_Config& config) noexcept;

// Of a configuration without fault, which outlives it.
[[nodiscard]] mac::Site site_of(const groma_Config& config, ranging::Ticks transmit_antenna_delay) noexcept;
[[nodiscard]] std::uint32_t schedule_hash_of(const groma_Config& config) noexcept;
// Without the network's key, which no node tells: its hash stands for it.
[[nodiscard]] groma_Config without_key(const groma_Config& config) noexcept;
// Over all of it but the key: CRC-32 of its encoded form.
[[nodiscard]] std::uint32_t config_hash_of(const groma_Config& config) noexcept;

}  // namespace groma::node
