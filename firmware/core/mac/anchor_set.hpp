// Which anchors a tag polls: a few of all that it knows, those that answer well, and in turn the others, so
// that one that comes into reach or back to life is found.
//
// A place in a POLL is worth most where the anchor answers often, its frames are strong and come straight,
// and the host's hint speaks for it. Where there are more candidates than places, one or two places go to the
// others, the longer untried the sooner; where few anchors answer, all places that are left over do. An
// anchor that never answers is thus tried now and then and takes nobody's place for good.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <span>
#include <utility>

#include "firmware/core/dw1000/receive_quality.hpp"

namespace groma::mac {

// How good a RESPONSE came in: 0 to 255. Up to 127 for its power, 128 more where the first path holds most of
// it (sight is likely: within 6 dB), 64 more where that may be (within 10 dB). Without a logarithm.
[[nodiscard]] std::uint8_t link_quality(const dw1000::ReceiveQuality& quality) noexcept;

class AnchorSet {
 public:
  static constexpr std::size_t kCapacity = 64;
  static constexpr std::uint8_t kNeutralWeight = 100;
  // An anchor that missed so many POLLs in a row counts as silent.
  static constexpr std::uint8_t kSilentAfter = 7;

  // Places of each POLL that may go to trials while enough anchors answer to fill it. Each choice that leaves
  // a candidate out earns it a share of such a place, by whether it answered its last trial; a place costs so
  // many shares. Until the bound is reached: 5/32 of a place, or 1/32.
  [[nodiscard]] static constexpr std::size_t most_trials(std::size_t places) noexcept {
    return places >= 3 ? 2 : 1;
  }
  [[nodiscard]] static constexpr std::uint16_t shares(bool answered) noexcept { return answered ? 1 : 5; }
  [[nodiscard]] static constexpr std::uint16_t price(std::size_t places) noexcept {
    return places >= 3 ? 32 : 128;
  }

  AnchorSet() = default;
  // The schedule's, tried in this order at first, and never forgotten. What is beyond kCapacity is left out.
  explicit AnchorSet(std::span<const std::uint16_t> configured) noexcept;

  // An anchor says that it has come up: it is tried next. Where all room is taken, a new one replaces a
  // silent one that had announced itself too, the one that answered least; false where there is none such.
  // One that answers none of its first eight trials is forgotten, unless the host has given it a weight.
  bool announce(std::uint16_t id) noexcept;
  // A frame of this anchor came in, so it is worth a trial. Nothing where it is no candidate.
  void hear(std::uint16_t id) noexcept;

  [[nodiscard]] bool knows(std::uint16_t id) const noexcept { return find(id) != nullptr; }

  // Host's hint: what a place for this anchor is worth, against kNeutralWeight; at 0 it gets only places that
  // nobody else wants. Nothing where it is no candidate.
  void prefer(std::uint16_t id, std::uint8_t weight) noexcept;
  // All at kNeutralWeight.
  void prefer_none() noexcept;

  // The anchors of the next POLL, as many as fit into `out` or there are. Returns how many.
  std::size_t choose(std::span<std::uint16_t> out) noexcept;

  // What became of it.
  void on_answer(std::uint16_t id, std::uint8_t quality) noexcept;
  void on_silence(std::uint16_t id) noexcept;

  [[nodiscard]] std::size_t size() const noexcept { return size_; }
  // Candidates that are not silent.
  [[nodiscard]] std::size_t answering() const noexcept;

  struct View {
    std::uint16_t id = 0;
    std::uint8_t rate_256ths = 0;  // share of POLLs answered, over about 16
    std::uint8_t quality = 0;      // link_quality(), over about 8
    std::uint8_t weight = 0;
    bool silent = false;
  };
  [[nodiscard]] View at(std::size_t index) const noexcept;

 private:
  static constexpr std::uint8_t kMostMissed = 15;
  struct Candidate {
    std::uint16_t id = 0;
    std::uint16_t untried = 0;  // choices since its last trial, up to kLongest
    std::uint8_t rate = 0;
    std::uint8_t quality = 0;
    std::uint8_t weight = kNeutralWeight;
    std::uint8_t missed : 4 = kMostMissed;  // in a row, saturates
    std::uint8_t eager : 2 = 0;             // trials that come before all others'
    bool chosen : 1 = false;                // at the last choice for its usefulness
    bool configured : 1 = false;

    [[nodiscard]] bool silent() const noexcept { return missed >= kSilentAfter; }
    [[nodiscard]] bool useful() const noexcept { return !silent() && weight > 0; }
    [[nodiscard]] std::uint32_t worth() const noexcept;
    [[nodiscard]] std::uint32_t urgency() const noexcept;
  };
  static_assert(sizeof(Candidate) == 8);
  static constexpr std::uint16_t kLongest = 1023;
  static constexpr std::uint8_t kEagerTrials = 3;

  [[nodiscard]] Candidate* find(std::uint16_t id) noexcept {
    return const_cast<Candidate*>(std::as_const(*this).find(id));
  }
  [[nodiscard]] const Candidate* find(std::uint16_t id) const noexcept;
  [[nodiscard]] Candidate* room() noexcept;
  [[nodiscard]] std::size_t trials(std::size_t places) noexcept;

  std::array<Candidate, kCapacity> candidates_{};
  std::uint8_t size_ = 0;
  std::uint16_t credit_ = 0;  // of the others, for a trial
};

}  // namespace groma::mac
