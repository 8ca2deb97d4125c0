#include "firmware/core/mac/superframe.hpp"

#include <algorithm>
#include <array>
#include <span>

namespace groma::mac {
namespace {

using radio::Phy;
using ranging::round_up_to_grid;

constexpr std::uint16_t kLargestId = 65534;
// Processing times that the network grants each node, whatever its processor: they are part of the protocol.
//
// A node feeds a beacon to its clock filter before it makes a relayed beacon or a POLL, so it needs more time
// than to answer a POLL. This includes verifying and making one MIC.
constexpr Ticks kBeaconProcessing = round_up_to_grid(Ticks::from_us(100));
// For verifying and making another MIC: 250 us at 3.5 cycles an instruction.
constexpr Ticks kForMic = round_up_to_grid(Ticks::from_us(300));

constexpr bool outside(std::uint32_t value, std::uint32_t low, std::uint32_t high) noexcept {
  return value < low || value > high;
}

// FNV-1a over 32-bit words, byte by byte.
class Hash {
 public:
  void add(std::uint32_t word) noexcept {
    constexpr std::uint32_t kPrime = 16'777'619;
    for (int i = 0; i < 4; ++i) value_ = (value_ ^ ((word >> (8 * i)) & 0xFF)) * kPrime;
  }
  void add(std::span<const std::uint16_t> ids) noexcept {
    add(static_cast<std::uint32_t>(ids.size()));
    for (const std::uint16_t id : ids) add(id);
  }
  [[nodiscard]] std::uint32_t value() const noexcept { return value_; }

 private:
  std::uint32_t value_ = 2'166'136'261;
};

bool is_one_of(std::span<const std::uint16_t> ids, std::uint32_t id) noexcept {
  return std::find(ids.begin(), ids.end(), id) != ids.end();
}

bool backups_fit(const groma_Schedule& schedule) noexcept {
  const auto backups = backups_of(schedule);
  const auto anchors = anchors_of(schedule);
  return std::all_of(backups.begin(), backups.end(), [&](std::uint16_t id) {
    return id != schedule.master_id && std::count(backups.begin(), backups.end(), id) == 1 &&
           is_one_of(anchors, id);
  });
}

bool slots_fit(const groma_Schedule& schedule) noexcept {
  const std::size_t count = slot_count_of(schedule);
  if (count > kMaxTags) return false;
  if (schedule.tag_slots_count == 0) return schedule.tag_ids_count <= count;
  const auto slots = std::span(schedule.tag_slots).first(schedule.tag_slots_count);
  return slots.size() == schedule.tag_ids_count &&
         std::all_of(slots.begin(), slots.end(), [&](std::size_t slot) { return slot < count; });
}

}  // namespace

std::size_t slot_count_of(const groma_Schedule& schedule) noexcept {
  return schedule.slots == 0 ? schedule.tag_ids_count : schedule.slots;
}

const char* fault_of(const groma_Schedule& schedule) noexcept {
  static_assert(kLeastTurnaround_us == 90 && kLeastGap_us == 35 && kLeastGuard_us == 2,
                "the texts name them");
  if (outside(schedule.tag_ids_count, 1, kMaxTags)) return "schedule.tag_ids: 1 to 16 tags";
  const auto tags = tags_of(schedule);
  const auto anchors = anchors_of(schedule);
  if (anchors.empty()) return "schedule.anchor_ids: 1 to 64 anchors";
  std::array<std::uint16_t, kMaxTags + std::extent_v<decltype(schedule.anchor_ids)>> room;
  const auto begin = room.begin();
  const auto end = std::copy(anchors.begin(), anchors.end(), std::copy(tags.begin(), tags.end(), begin));
  std::sort(begin, end);
  if (outside(*begin, 1, kLargestId) || outside(*(end - 1), 1, kLargestId))
    return "schedule: ids are 1 to 65534";
  if (std::adjacent_find(begin, end) != end) return "schedule: each id once, over tags and anchors together";
  if (!is_one_of(anchors, schedule.master_id)) return "schedule.master_id: one of anchor_ids";
  if (number_of(schedule.method) > _groma_RangingMethod_MAX) return "schedule.method: not known to this node";
  if (outside(schedule.turn_round_us, kLeastTurnaround_us, kMostTurnaround_us))
    return "schedule.turn_round_us: 90 to 5000";
  if (outside(schedule.response_gap_us, kLeastGap_us, kMostGap_us))
    return "schedule.response_gap_us: 35 to 2000";
  if (outside(schedule.guard_us, kLeastGuard_us, kMostGuard_us)) return "schedule.guard_us: 2 to 1000";
  if (!backups_fit(schedule)) return "schedule.backup_ids: anchors, each once, not the master";
  if (!slots_fit(schedule)) return "schedule.slots: 1 to 16, and above each of tag_slots";
  if (schedule.responses > kMaxAnchors) return "schedule.responses: 1 to 16";
  return "";
}

std::optional<std::size_t> configured_slot(const groma_Schedule& schedule, std::uint16_t tag) noexcept {
  const auto tags = tags_of(schedule);
  const auto found = std::find(tags.begin(), tags.end(), tag);
  if (found == tags.end()) return std::nullopt;
  const auto index = static_cast<std::size_t>(found - tags.begin());
  return index < schedule.tag_slots_count ? schedule.tag_slots[index] : index;
}

std::optional<std::size_t> rank_of(const groma_Schedule& schedule, std::uint16_t anchor) noexcept {
  if (anchor == schedule.master_id) return 0;
  const auto backups = backups_of(schedule);
  const auto found = std::find(backups.begin(), backups.end(), anchor);
  if (found == backups.end()) return std::nullopt;
  return static_cast<std::size_t>(found - backups.begin()) + 1;
}

std::uint32_t schedule_hash(const groma_Schedule& schedule, std::uint32_t network_id,
                            radio::Preamble preamble) noexcept {
  Hash hash;
  hash.add(network_id);
  hash.add(static_cast<std::uint32_t>(preamble));
  hash.add(schedule.epoch);
  hash.add(schedule.master_id);
  hash.add(tags_of(schedule));
  hash.add(anchors_of(schedule));
  hash.add(static_cast<std::uint32_t>(schedule.method));
  hash.add(schedule.turn_round_us);
  hash.add(schedule.response_gap_us);
  hash.add(schedule.guard_us);
  hash.add(backups_of(schedule));
  hash.add(schedule.slots);
  for (const std::uint8_t slot : std::span(schedule.tag_slots).first(schedule.tag_slots_count))
    hash.add(slot);
  hash.add(schedule.responses);
  // Without arm-ahead the hash is that of nodes that do not know it.
  if (schedule.arm_ahead) hash.add(1);
  return hash.value();
}

Superframe::Superframe(const groma_Schedule& schedule, const Phy& phy, bool secured) noexcept
    : phy_(phy),
      has_final_(schedule.method == groma_RangingMethod_METHOD_DS_FINAL),
      mic_bytes_(secured ? kCodeBytes : 0),
      slot_count_(slot_count_of(schedule)),
      responses_(schedule.responses != 0 ? schedule.responses
                                         : std::min<std::size_t>(schedule.anchor_ids_count, kMaxAnchors)),
      control_bytes_(on_air(std::max(beacon_bytes(slot_count_, true), data_bytes(kMaxDataBytes)))),
      guard_(Ticks::from_us(schedule.guard_us)),
      turnaround_(Ticks::from_us(schedule.turn_round_us)),
      gap_(Ticks::from_us(schedule.response_gap_us)),
      first_frame_(round_up_to_grid(guard_ + phy.before_rmarker())),
      response_spacing_(round_up_to_grid(phy.air_time(on_air(kResponseBytes)) + gap_)),
      end_time_(secured ? kForMic : Ticks(0)) {
  const auto control_slot = [this](Ticks pause) {
    // A message instead of a relayed beacon takes a second MIC.
    return round_up_to_grid(first_frame_ + phy_.after_rmarker(control_bytes_) + pause) + kBeaconProcessing +
           end_time_;
  };
  control_slot_ = control_slot(std::max(gap_, turnaround_));
  slots_start_ = control_slot_ + control_slot(turnaround_);
  const Ticks last_frame =
      has_final_ ? final(responses_) + phy_.after_rmarker(on_air(kFinalBytes)) + std::max(gap_, turnaround_)
                 : response(responses_ - 1, responses_) + phy_.after_rmarker(on_air(kResponseBytes)) + gap_;
  tag_slot_ = round_up_to_grid(first_frame_ + last_frame);
}

Ticks Superframe::response(std::size_t index, std::size_t count) const noexcept {
  const Ticks first =
      round_up_to_grid(phy_.after_rmarker(on_air(poll_bytes(count))) + turnaround_ + phy_.before_rmarker());
  return first + static_cast<std::int64_t>(index) * response_spacing_;
}

Ticks Superframe::final(std::size_t count) const noexcept {
  const std::size_t last = count == 0 ? 0 : count - 1;
  return response(last, count) +
         round_up_to_grid(phy_.after_rmarker(on_air(kResponseBytes)) + turnaround_ + phy_.before_rmarker());
}

}  // namespace groma::mac
