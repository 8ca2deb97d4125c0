// Selects the anchors that a tag polls: a few of all known ones, those that answer well, and the others in
// turn, so that it finds an anchor that comes into range or starts again.
//
// docs/explanation/joining.md has the rules, and how soon an anchor is found.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/core/radio/link_quality.hpp"

namespace groma::mac {

// Quality of a received RESPONSE: 0 to 255. Up to 127 for its power, plus 128 if the first path is within 6
// dB of the total power (LOS likely), or plus 64 if it is within 10 dB (LOS possible). Computed without a
// logarithm.
[[nodiscard]] std::uint8_t link_quality(const radio::LinkQuality& quality) noexcept;

class AnchorSet {
 public:
  static constexpr std::size_t kCapacity = 64;
  static constexpr std::uint8_t kNeutralWeight = 100;
  // An anchor that missed this many POLLs in a row counts as silent.
  static constexpr std::uint8_t kSilentAfter = 7;

  // Most places of a POLL for trials while enough anchors answer to fill it. Each choice that omits a
  // candidate earns it shares of a trial place, by whether it answered its last trial; a place costs price()
  // shares. With three or more places a candidate earns 5/32 or 1/32 of a place.
  [[nodiscard]] static constexpr std::size_t most_trials(std::size_t places) noexcept {
    return places >= 3 ? 2 : 1;
  }
  [[nodiscard]] static constexpr std::uint16_t shares(bool answered) noexcept { return answered ? 1 : 5; }
  [[nodiscard]] static constexpr std::uint16_t price(std::size_t places) noexcept {
    return places >= 3 ? 32 : 128;
  }

  // The schedule's anchors, tried in this order at first, and never removed. Those beyond kCapacity are
  // ignored.
  explicit AnchorSet(std::span<const std::uint16_t> configured) noexcept;

  // An anchor announced that it has started: it is tried next. If the table is full, a new anchor replaces a
  // silent one that had announced itself, the one that answered least; returns false if there is none. An
  // announced anchor that answers none of its first eight trials is removed, unless the host has given it a
  // weight.
  bool announce(std::uint16_t id) noexcept;
  // A frame of this anchor was received: it gets a trial. Does nothing if it is not a candidate.
  void hear(std::uint16_t id) noexcept;

  [[nodiscard]] bool knows(std::uint16_t id) noexcept { return find(id) != nullptr; }

  // The host's hint: the value of a place for this anchor, relative to kNeutralWeight; with 0 it gets only
  // places that are left over. Does nothing if it is not a candidate.
  void prefer(std::uint16_t id, std::uint8_t weight) noexcept {
    if (Candidate* candidate = find(id)) candidate->weight = weight;
  }
  // Sets all weights to kNeutralWeight.
  void prefer_none() noexcept {
    for (Candidate& c : candidates_) c.weight = kNeutralWeight;
  }

  // Writes the anchors of the next POLL to `out`, as many as fit or are known. Returns their number.
  std::size_t choose(std::span<std::uint16_t> out) noexcept;

  // The result of polling an anchor.
  void on_answer(std::uint16_t id, std::uint8_t quality) noexcept;
  void on_silence(std::uint16_t id) noexcept;

  [[nodiscard]] std::size_t size() const noexcept { return size_; }
  // Number of candidates that are not silent.
  [[nodiscard]] std::size_t answering() const noexcept;

  static constexpr std::uint8_t kMostMissed = 15;
  struct Candidate {
    std::uint16_t id = 0;
    std::uint16_t untried = 0;  // choices since its last trial, up to kLongest
    std::uint8_t rate = 0;      // share of POLLs answered, in 256ths, averaged over about 16
    std::uint8_t quality = 0;   // link_quality(), averaged over about 8
    std::uint8_t weight = kNeutralWeight;
    std::uint8_t missed = kMostMissed;  // POLLs missed in a row, saturates
    std::uint8_t eager = 0;             // trials with priority over all others
    bool chosen = false;                // in the last POLL, and not as a trial
    bool configured = false;

    [[nodiscard]] bool silent() const noexcept { return missed >= kSilentAfter; }
    [[nodiscard]] bool useful() const noexcept { return !silent() && weight > 0; }
    [[nodiscard]] std::uint32_t worth() const noexcept;
    [[nodiscard]] std::uint32_t urgency() const noexcept;
  };
  [[nodiscard]] std::span<const Candidate> candidates() const noexcept {
    return std::span(candidates_).first(size_);
  }

 private:
  static constexpr std::uint16_t kLongest = 1023;
  static constexpr std::uint8_t kEagerTrials = 3;

  [[nodiscard]] Candidate* find(std::uint16_t id) noexcept;
  [[nodiscard]] Candidate* room() noexcept;
  [[nodiscard]] std::size_t trials(std::size_t places) noexcept;

  std::array<Candidate, kCapacity> candidates_{};
  std::uint8_t size_ = 0;
  std::uint16_t credit_ = 0;  // shares of the candidates not chosen, for trials
};

}  // namespace groma::mac
