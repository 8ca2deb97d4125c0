// Selects the anchors that a tag polls: a few of all known ones, those that answer well, and the others in
// turn, so that it finds an anchor that comes into range or starts again.
//
// docs/explanation/joining.md has the rules, and how soon an anchor is found.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/core/radio/link_quality.hpp"

namespace groma::mac {

// Quality of a received RESPONSE: 0 to 255. Up to 127 for its power, plus 128 if the first path is within 6
// dB of the total power (LOS likely), or plus 64 if it is within 10 dB (LOS possible). Computed without a
// logarithm.
[[nodiscard]] inline std::uint8_t link_quality(const radio::LinkQuality& q) noexcept {
  if (q.receive_power <= 0.0F) return 0;
  // 3 dB per bit: 8 bits are -100 dBm, 14 are -80 dBm.
  constexpr float kStrongest = 1U << 20U;
  const auto bits = std::bit_width(static_cast<std::uint32_t>(std::min(q.receive_power, kStrongest)));
  const int strength = std::clamp(16 * (static_cast<int>(bits) - 6), 0, 127);
  const bool likely = q.receive_power <= 4.0F * q.first_path_power;
  const int los = likely ? 128 : q.receive_power <= 10.0F * q.first_path_power ? 64 : 0;
  return static_cast<std::uint8_t>(strength + los);
}

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
  explicit AnchorSet(std::span<const std::uint16_t> configured) noexcept {
    for (const std::uint16_t id : configured.first(std::min(configured.size(), kCapacity))) {
      candidates_[size_++] = Candidate{.id = id, .untried = kLongest, .configured = true};
    }
  }

  // An anchor announced that it has started: it is tried next. If the table is full, a new anchor replaces a
  // silent one that had announced itself, the one that answered least; returns false if there is none. An
  // announced anchor that answers none of its first eight trials is removed, unless the host has given it a
  // weight.
  bool announce(std::uint16_t id) noexcept {
    Candidate* candidate = find(id);
    if (candidate == nullptr) {
      candidate = room();
      if (candidate == nullptr) return false;
      *candidate = Candidate{.id = id, .untried = kLongest, .missed = kSilentAfter};
    }
    candidate->eager = kEagerTrials;
    return true;
  }
  // A frame of this anchor was received: it gets a trial. Does nothing if it is not a candidate.
  void hear(std::uint16_t id) noexcept {
    constexpr std::uint16_t kNotTooOften = 16;
    Candidate* candidate = find(id);
    if (candidate != nullptr && candidate->silent() && candidate->untried >= kNotTooOften) {
      candidate->eager = 1;
    }
  }

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
  std::size_t choose(std::span<std::uint16_t> out) noexcept {
    const std::size_t places = std::min<std::size_t>(out.size(), size_);
    if (places == 0) return 0;
    std::array<std::uint32_t, kCapacity> keys{};  // 0: excluded
    std::uint64_t in = 0;
    std::size_t taken = 0;
    const auto take_best = [&](std::size_t up_to) {
      while (taken < up_to) {
        const auto best = std::max_element(keys.begin(), keys.begin() + size_);
        if (*best == 0) return;
        *best = 0;
        in |= std::uint64_t{1} << (best - keys.begin());
        ++taken;
      }
    };

    std::uint64_t useful = ~std::uint64_t{0};
    if (places < size_) {
      const std::size_t kept = out.size() - trials(out.size());
      for (std::size_t i = 0; i < size_; ++i) {
        keys[i] = candidates_[i].useful() && candidates_[i].eager == 0 ? candidates_[i].worth() : 0;
      }
      take_best(kept);
      useful = in;
      for (std::size_t i = 0; i < size_; ++i) {
        keys[i] = (in >> i & 1U) != 0 ? 0 : candidates_[i].urgency();
      }
      take_best(places);
    } else {
      in = ~std::uint64_t{0};
    }

    std::size_t count = 0;
    for (std::size_t i = 0; i < size_; ++i) {
      Candidate& c = candidates_[i];
      c.chosen = (useful >> i & 1U) != 0;
      if ((in >> i & 1U) == 0) {
        c.untried = std::min<std::uint16_t>(static_cast<std::uint16_t>(c.untried + 1), kLongest);
        continue;
      }
      c.untried = 0;
      if (c.eager != 0) --c.eager;
      out[count++] = c.id;
    }
    return count;
  }

  // The result of polling an anchor.
  void on_answer(std::uint16_t id, std::uint8_t quality) noexcept {
    // A newly found anchor starts with a good rate and its first quality.
    constexpr std::uint8_t kFirstRate = 192;
    Candidate* c = find(id);
    if (c == nullptr) return;
    const bool found = c->silent();
    c->eager = c->missed > 0 && !c->chosen ? 1 : 0;  // a range needs two POLLs in a row
    c->rate = approach(c->rate, 255, 4);
    if (found) c->rate = std::max(c->rate, kFirstRate);
    c->quality = found ? quality : approach(c->quality, quality, 3);
    c->missed = 0;
  }
  void on_silence(std::uint16_t id) noexcept {
    Candidate* c = find(id);
    if (c == nullptr) return;
    c->rate = approach(c->rate, 0, 4);
    if (c->missed < kMostMissed) ++c->missed;
    // Remove an announced anchor that does not answer. If it is there, it announces itself again.
    const bool nobody = c->rate == 0 && c->missed == kMostMissed;
    if (nobody && !c->configured && c->weight == kNeutralWeight) *c = candidates_[--size_];
  }

  [[nodiscard]] std::size_t size() const noexcept { return size_; }
  // Number of candidates that are not silent.
  [[nodiscard]] std::size_t answering() const noexcept {
    const auto all = candidates();
    return static_cast<std::size_t>(
        std::count_if(all.begin(), all.end(), [](const Candidate& c) { return !c.silent(); }));
  }

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
    // A polled candidate keeps its place against others that are up to a quarter better, because each change
    // costs a range.
    [[nodiscard]] std::uint32_t worth() const noexcept {
      const std::uint32_t value = (rate + 1U) * (128U + quality / 2U) * weight;
      return chosen ? value + value / 4 : value;
    }
    [[nodiscard]] std::uint32_t urgency() const noexcept {
      // A candidate that used to answer is more likely to return than one that never did; one that answers
      // needs no trial.
      const std::uint32_t chance = missed > 0 ? 8U + rate / 32U : 1U;
      return (untried + 1U) * (weight + 1U) * chance + (eager != 0 ? std::uint32_t{1} << 31 : 0U);
    }
  };
  [[nodiscard]] std::span<const Candidate> candidates() const noexcept {
    return std::span(candidates_).first(size_);
  }

 private:
  static constexpr std::uint16_t kLongest = 1023;
  static constexpr std::uint8_t kEagerTrials = 3;

  // Moves by 1/2^shift of the difference, at least by 1.
  [[nodiscard]] static std::uint8_t approach(std::uint8_t value, std::uint8_t target, int shift) noexcept {
    const int way = int{target} - int{value};
    const int round_up = (1 << shift) - 1;
    const int step = way >= 0 ? (way + round_up) >> shift : -((-way + round_up) >> shift);
    return static_cast<std::uint8_t>(value + step);
  }
  [[nodiscard]] Candidate* find(std::uint16_t id) noexcept {
    for (std::size_t i = 0; i < size_; ++i) {
      if (candidates_[i].id == id) return &candidates_[i];
    }
    return nullptr;
  }
  [[nodiscard]] Candidate* room() noexcept {
    if (size_ < kCapacity) return &candidates_[size_++];
    Candidate* oldest = nullptr;
    for (Candidate& c : candidates_) {
      if (c.configured || !c.silent() || c.eager != 0) continue;
      if (oldest == nullptr || c.rate < oldest->rate) oldest = &c;
    }
    return oldest;
  }
  // The number of places in this POLL that the candidates not chosen have earned.
  [[nodiscard]] std::size_t trials(std::size_t places) noexcept {
    std::size_t eager = 0;
    std::size_t earned = credit_;
    for (std::size_t i = 0; i < size_; ++i) {
      const Candidate& c = candidates_[i];
      if (!c.chosen) earned += shares(c.missed == 0);
      eager += c.eager != 0 ? 1U : 0U;
    }
    const std::uint16_t cost = price(places);
    const std::size_t most = most_trials(places);
    const std::size_t paid = std::min(earned / cost, most);
    credit_ = static_cast<std::uint16_t>(std::min<std::size_t>(earned - paid * cost, cost - 1U));
    return std::max(paid, std::min(eager, most));
  }

  std::array<Candidate, kCapacity> candidates_{};
  std::uint8_t size_ = 0;
  std::uint16_t credit_ = 0;  // shares of the candidates not chosen, for trials
};

}  // namespace groma::mac
