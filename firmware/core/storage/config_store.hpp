#pragma once

#include "firmware/core/storage/record_store.hpp"

namespace groma::storage {

// A node's configuration in flash, for a platform's load_config() and store_config() (see node/platform.hpp).
template <Flash F>
class ConfigStore {
 public:
  explicit constexpr ConfigStore(F& flash) noexcept : records_(flash) {}

  // As RecordStore::load() and store().
  [[nodiscard]] std::size_t load(std::span<std::uint8_t> out) const noexcept {
    return records_.load(Key::kConfig, out);
  }
  [[nodiscard]] bool store(std::span<const std::uint8_t> blob) noexcept {
    return records_.store(Key::kConfig, blob);
  }

 private:
  RecordStore<F> records_;
};

}  // namespace groma::storage
