// Who may poll in which slot: the master's table, the copies of it that all others keep, and the rule by
// which a tag goes.
//
// The table travels in each beacon. A node may have an old one: it missed beacons, or what it heard was
// relayed. Two rules keep two tags out of one slot all the same. A tag goes by the newest table that it heard
// and polls only while that is at most kTableGoodFor superframes old. And a slot that was somebody's is
// nobody's for longer than that before it is given to another one. (Only a tag that says itself that it
// leaves is succeeded at once: it has fallen silent before.)
//
// A new master goes on with its copy. What is nobody's in it may have been given away by the one before in a
// beacon that the copy missed: so it, too, waits.
//
// A slot is called back where its tag was heard and then not for kLease superframes, or, when someone asks
// and nothing is free, where it was not heard for so long by this master (it may be out of its reach). Called
// back it is nobody's; a tag that is still there joins anew and has it again, as long as it was not given
// away.
//
// What remains: a tag that left and is back within kTableGoodFor, while a new master has missed both its
// leaving and its successor. So a tag that left stays away for longer.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/superframe.hpp"
#include "groma.pb.h"

namespace groma::mac {

// All in superframes.
inline constexpr std::uint32_t kTableGoodFor = 32;
inline constexpr std::uint32_t kLease = 64;
// The same, where somebody else asks, for one that has never polled since it was given its slot.
inline constexpr std::uint32_t kFirstLease = 16;
// A master that hears no tag at all for so long is itself out of reach: it calls back no slot, and counts
// anew when it hears one.
inline constexpr std::uint32_t kDeaf = 8;

// Superframe of the master's own beacon that a beacon, relayed or not, tells of.
[[nodiscard]] constexpr std::uint32_t told_at(const Beacon& beacon) noexcept {
  return beacon.superframe - beacon.age;
}

// An anchor's.
class SlotTable {
 public:
  // As the schedule says, and what it does not give away is free. The schedule outlives it.
  explicit SlotTable(const groma_Schedule& schedule) noexcept;

  // Superframe `number` begins. Any step is taken; a step back only moves the count.
  void advance(std::uint32_t number) noexcept;

  // Not the master: the table that a beacon tells, unless a newer one of the same session is known.
  void copy(const Beacon& beacon) noexcept;
  // This node is the master of that session now: it goes on with its copy, or begins anew. Nothing where it
  // was before.
  void lead(std::uint64_t session) noexcept;

  // As the table says.
  [[nodiscard]] bool may_poll(std::uint16_t tag, std::size_t slot) const noexcept;
  [[nodiscard]] std::optional<std::size_t> slot_of(std::uint16_t tag) const noexcept;
  // lead() came last, not copy().
  [[nodiscard]] bool leads() const noexcept { return leads_; }
  // A POLL of this tag in this slot.
  void hear(std::uint16_t tag, std::size_t slot) noexcept;

  enum class Claim : std::uint8_t {
    kHeld,     // it has a slot, now or again
    kGranted,  // it has one from the next beacon on
    kWait,     // perhaps later: it has to ask again
  };
  // The master: this tag asks for a slot, or says that it is there.
  Claim claim(std::uint16_t tag) noexcept;
  // The master, once a superframe: calls back the slots of tags that it heard and then lost, and where one
  // waits for a slot those of tags that asked and then never came.
  void reclaim() noexcept;
  // The master: this tag has gone silent and gives back what it held. Nothing where others of the schedule
  // share its slot.
  void leave(std::uint16_t tag) noexcept;

  void fill(Beacon& beacon) const noexcept;
  [[nodiscard]] std::span<const std::uint16_t> holders() const noexcept {
    return std::span(holders_).first(count_);
  }

 private:
  struct Use {
    std::uint16_t before = kNobody;  // whom it was called back from; it may have it again
    std::uint16_t unheard = 0;       // superframes since its tag was heard, or since it was given; saturates
    std::uint16_t vacant = 0;        // superframes since it is nobody's; saturates
    bool heard = false;              // its tag, by this node
    bool awaited = false;            // given to who asked; has not polled yet that this node knows of
  };

  void begin() noexcept;
  void set(std::size_t slot, std::uint16_t holder) noexcept;
  void call_back(std::size_t slot) noexcept;
  [[nodiscard]] bool belongs_to(std::uint16_t holder, std::size_t slot, std::uint16_t tag) const noexcept;
  [[nodiscard]] std::uint16_t by_schedule(std::size_t slot) const noexcept;

  const groma_Schedule* schedule_;
  std::size_t count_;
  std::array<std::uint16_t, kMaxTags> holders_{};
  std::array<Use, kMaxTags> uses_{};
  std::uint32_t now_ = 0;
  std::uint16_t quiet_ = 0;    // superframes since any tag was heard; saturates
  std::uint16_t unasked_ = 0;  // since one asked that there was no slot for; saturates
  std::uint64_t session_ = 0;
  std::uint32_t told_ = 0;  // the superframe that the copy is of
  bool copied_ = false;
  bool leads_ = false;
};

// A tag's: the slot that it may use.
class Tenure {
 public:
  // `configured`: the slot that the schedule gives it.
  Tenure(std::uint16_t tag, std::optional<std::size_t> configured) noexcept
      : tag_(tag), configured_(configured) {}

  // Of the network that the tag is in step with.
  void take(const Beacon& beacon) noexcept;

  // Nothing where it has none, or where its table is too old for superframe `number`.
  [[nodiscard]] std::optional<std::size_t> slot(std::uint32_t number) const noexcept;
  // It has a table, too old for superframe `number`.
  [[nodiscard]] bool outdated(std::uint32_t number) const noexcept {
    return known_ && number - told_ > kTableGoodFor;
  }
  // It has a table, and no slot by it.
  [[nodiscard]] bool homeless() const noexcept { return known_ && !slot_; }

 private:
  std::uint16_t tag_;
  std::optional<std::size_t> configured_;
  std::optional<std::size_t> slot_;
  bool known_ = false;
  std::uint32_t told_ = 0;
  std::uint64_t session_ = 0;
};

}  // namespace groma::mac
