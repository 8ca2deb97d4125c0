// A node's configuration: validation, and its stored form.
#pragma once

#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/radio/radio.hpp"
#include "firmware/core/storage/record_store.hpp"
#include "groma.pb.h"

namespace groma::node {

// Largest size of an encoded configuration, and of a stored one, which may include the configuration before
// it.
inline constexpr std::size_t kMaxConfigBytes = groma_Config_size;
inline constexpr std::size_t kMaxStoredBytes = storage::kMaxRecordBytes;

// The first fault that prevents operation with this configuration, as field and valid values: at most 63
// characters, empty if there is none.
[[nodiscard]] const char* fault_of(const groma_Config& config) noexcept;

// Encodes to the start of `out` and returns the size; 0: it does not fit. `before`: for a configuration on
// trial, the one to revert to, which follows in a field that Config does not have.
[[nodiscard]] std::size_t encode_config(const groma_Config& config, std::span<std::uint8_t> out,
                                        const groma_Config* before = nullptr) noexcept;
// Returns nothing if the bytes are not a configuration. Skips the one before a trial.
[[nodiscard]] std::optional<groma_Config> decode_config(std::span<const std::uint8_t> bytes) noexcept;
// The configuration before the trial, encoded; empty if there is none.
[[nodiscard]] std::span<const std::uint8_t> before_trial(std::span<const std::uint8_t> stored) noexcept;
// Removes the network key, which no node reveals, and the configuration before the trial from a stored
// configuration, in place. The bytes that remain are at its start; the key's hash is among them.
[[nodiscard]] std::span<const std::uint8_t> shown(std::span<std::uint8_t> stored) noexcept;

// A delay or a power of 0 selects the chip's own: see groma.proto.
[[nodiscard]] radio::Settings radio_settings(const groma_Config& config) noexcept;

[[nodiscard]] std::uint32_t schedule_hash_of(const groma_Config& config) noexcept;
// CRC-32 of the encoded configuration without its key.
[[nodiscard]] std::uint32_t config_hash_of(const groma_Config& config) noexcept;

}  // namespace groma::node
