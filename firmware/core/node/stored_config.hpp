// The configuration that a node keeps in flash, and how it is read back.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/node/config.hpp"
#include "firmware/core/node/platform.hpp"
#include "groma.pb.h"
#include "proto/crc32.hpp"

namespace groma::node {

template <Platform P>
class StoredConfig {
 public:
  explicit StoredConfig(P& platform) noexcept : platform_(platform) {}

  struct Stored {
    std::optional<groma_Config> config;
    bool on_trial = false;
  };
  // The stored configuration, or with `before` the one to revert to; nothing if it is not valid.
  [[nodiscard]] Stored load(bool before = false) noexcept {
    Stored stored;
    size_ = platform_.load_config(blob_);
    if (size_ > blob_.size()) size_ = 0;
    if (size_ == 0) return stored;
    const auto bytes = std::span<const std::uint8_t>(blob_).first(size_);
    const auto older = before_trial(bytes);
    stored.on_trial = !older.empty();
    const bool good = decode_config(before ? older : bytes, stored.config.emplace());
    if (!good || fault_of(*stored.config)[0] != '\0') stored.config.reset();
    return stored;
  }
  // The encoded configuration of the last load(), without secrets; call once after each load().
  [[nodiscard]] std::span<const std::uint8_t> shown() noexcept {
    return node::shown(std::span(blob_).first(size_));
  }

  // Stores `config`, and if it is on trial the one `before` it. Returns false if it was not stored or reads
  // back differently. Stalls the processor for at most 0.1 s, with an erase 0.2 s, so the node must be off
  // the air.
  [[nodiscard]] bool keep(const groma_Config& config, const groma_Config* before) noexcept {
    const std::size_t size =
        before == nullptr ? encode_config(config, blob_) : encode_on_trial(config, *before, blob_);
    const std::uint32_t check = wire::crc32(std::span(blob_).first(size));
    if (size == 0 || !platform_.store_config(std::span(blob_).first(size))) return false;
    return platform_.load_config(blob_) == size && wire::crc32(std::span(blob_).first(size)) == check;
  }
  // Returns false if the flash was not erased. Off the air, as keep().
  [[nodiscard]] bool erase() noexcept {
    return platform_.store_config({}) && platform_.load_config(blob_) == 0;
  }

 private:
  P& platform_;
  std::array<std::uint8_t, kMaxStoredBytes> blob_{};  // buffer for reading and writing storage
  std::size_t size_ = 0;                              // of the last read
};

}  // namespace groma::node
