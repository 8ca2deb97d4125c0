// The node's configuration: as stored in flash, in force, and on trial.
//
// A configuration that came over the air is stored with the one before it, and is on trial
// (docs/reference/wire.md#over-the-air).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/node/config.hpp"
#include "firmware/core/node/participation.hpp"
#include "groma.pb.h"
#include "proto/crc32.hpp"

namespace groma::node {

template <Platform P>
class Configuration {
 public:
  static constexpr std::uint32_t kUsualTrial_s = 60;

  // Keeps the references.
  Configuration(Shared<P>& shared, Reporter<P>& reports, Participation<P>& network) noexcept
      : shared_(shared), reports_(reports), network_(network) {}

  // Brings the stored configuration into force. `trial_s`: duration of its trial if it came over the air; 0:
  // it needs none.
  [[gnu::noinline]] void apply(std::uint32_t trial_s) noexcept {
    const std::optional<groma_Config> stored = load();
    round_ = 0;
    round_us_ = std::uint64_t{trial_s} * 1'000'000;
    begin_round(has_previous() && trial_s != 0);
    put_in_force(stored);
    if (has_previous() && trial_s == 0) confirm();
  }
  // Makes the node unconfigured.
  void reset() noexcept { put_in_force(std::nullopt); }

  // The stored configuration, without its key; an empty one if it is not valid.
  [[nodiscard, gnu::noinline]] Outcome read() noexcept {
    const bool valid = load().has_value();
    return {.config = valid ? shown(std::span(blob_).first(size_)) : std::span<const std::uint8_t>()};
  }
  // Stores `config`, if it is valid.
  [[nodiscard, gnu::noinline]] Outcome write(groma_Config& config, bool by_air) noexcept {
    if (by_air && config.network_key.size != 0)
      return invalid("network_key: not over the air, where anyone can read it");
    complete_key(config);
    if (const char* fault = fault_of(config); fault[0] != '\0') return invalid(fault);
    // A configuration that came over the air may cut the node off, so the present one is stored with it.
    const groma_Config* const previous = by_air && shared_.config ? &*shared_.config : nullptr;
    if (!keep(config, previous)) return {groma_Result_RESULT_STORAGE, "not stored: write it again"};
    return read();
  }
  // Erases the stored configuration; after that the node is off the air until reset().
  [[nodiscard]] Outcome erase() noexcept {
    leave();
    if (shared_.platform.store_config({}) && shared_.platform.load_config(blob_) == 0) return {};
    network_.resume();
    return {groma_Result_RESULT_STORAGE, "not erased: try again"};
  }

  // An answer that was sent under the configuration in force has arrived.
  void on_delivered() noexcept {
    if (shared_.trial_end_us != kNever_us) confirm();
  }
  // Call about each second. In the first round only on_delivered() confirms the configuration; in later
  // rounds synchronization is enough.
  void on_second(std::uint64_t now_us) noexcept {
    if (now_us < shared_.trial_end_us) return;
    if (round_ != 0 && network_.in_step()) return confirm();
    const bool previous = ++round_ % 2 != 0;
    const std::optional<groma_Config> stored = load(previous);
    begin_round(has_previous());
    if (!stored || !has_previous()) return;
    reports_.log(groma_LogLevel_LOG_WARNING,
                 previous ? "on trial: back to the previous configuration" : "on trial: trying again");
    put_in_force(stored);
  }

 private:
  // The stored configuration, or with `previous` the one to revert to; nothing if it is not valid.
  [[nodiscard]] std::optional<groma_Config> load(bool previous = false) noexcept {
    size_ = shared_.platform.load_config(blob_);
    auto config = decode_config(previous ? before_trial(record()) : record());
    if (config && fault_of(*config)[0] != '\0') config.reset();
    return config;
  }
  // As load() has read it.
  [[nodiscard]] std::span<const std::uint8_t> record() const noexcept {
    return std::span(blob_).first(size_);
  }
  [[nodiscard]] bool has_previous() const noexcept { return !before_trial(record()).empty(); }

  // If the key is missing but its hash is there, inserts the node's present key if the hash matches.
  [[gnu::noinline]] void complete_key(groma_Config& config) noexcept {
    if (config.network_key.size != 0 || config.network_key_hash == 0) return;
    const auto stored = load();
    if (stored && stored->network_key_hash == config.network_key_hash)
      config.network_key = stored->network_key;
  }

  // Flash operations stall the processor for up to 0.2 s, so the node must be off the air.
  void leave() noexcept {
    reports_.log(groma_LogLevel_LOG_INFO, "off the air to write flash");
    network_.leave();
  }
  // Stores `config`, and if it is on trial the one before it. Returns false if it was not stored or reads
  // back differently.
  [[gnu::noinline]] bool keep(const groma_Config& config, const groma_Config* previous) noexcept {
    leave();
    const auto blob = std::span(blob_).first(encode_config(config, blob_, previous));
    const std::uint32_t check = wire::crc32(blob);
    const bool kept = !blob.empty() && shared_.platform.store_config(blob) &&
                      shared_.platform.load_config(blob_) == blob.size() && wire::crc32(blob) == check;
    if (kept) begin_round(false);
    network_.resume();
    return kept;
  }

  void put_in_force(const std::optional<groma_Config>& config) noexcept {
    network_.forget();
    shared_.config = config;
    reports_.choose_link();
    network_.bring_up();
    reports_.send_hello();
  }

  void begin_round(bool on_trial) noexcept {
    shared_.trial_end_us = on_trial ? shared_.platform.now_us() + round_us_ : kNever_us;
  }
  // Confirms the configuration in force, and discards the one before.
  void confirm() noexcept {
    if (shared_.config && !keep(*shared_.config, nullptr)) begin_round(true);
  }

  Shared<P>& shared_;
  Reporter<P>& reports_;
  Participation<P>& network_;
  std::array<std::uint8_t, kMaxStoredBytes> blob_{};  // buffer for reading and writing storage
  std::size_t size_ = 0;                              // of the last read
  std::uint8_t round_ = 0;                            // of the trial; in odd ones the previous configuration
  std::uint64_t round_us_ = 0;
};

}  // namespace groma::node
