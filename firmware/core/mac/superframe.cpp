#include "firmware/core/mac/superframe.hpp"

#include <algorithm>
#include <span>

#include "firmware/core/mac/wire_enum.hpp"

namespace groma::mac {
namespace {

using dw1000::Phy;
using ranging::round_up_to_grid;
using ranging::Ticks;

constexpr std::uint16_t kLargestId = 65534;

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

std::span<const std::uint16_t> tags_of(const groma_Schedule& schedule) noexcept {
  return std::span(schedule.tag_ids).first(std::min<std::size_t>(schedule.tag_ids_count, kMaxTags));
}

std::span<const std::uint16_t> anchors_of(const groma_Schedule& schedule) noexcept {
  return std::span(schedule.anchor_ids).first(std::min<std::size_t>(schedule.anchor_ids_count, kMaxAnchors));
}

ScheduleFault check_ids(const groma_Schedule& schedule) noexcept {
  const auto tags = tags_of(schedule);
  const auto anchors = anchors_of(schedule);
  const std::size_t total = tags.size() + anchors.size();
  const auto id_at = [&](std::size_t i) { return i < tags.size() ? tags[i] : anchors[i - tags.size()]; };
  for (std::size_t i = 0; i < total; ++i) {
    if (outside(id_at(i), 1, kLargestId)) return ScheduleFault::kBadId;
    for (std::size_t j = 0; j < i; ++j) {
      if (id_at(i) == id_at(j)) return ScheduleFault::kRepeatedId;
    }
  }
  return std::count(anchors.begin(), anchors.end(), schedule.master_id) == 1 ? ScheduleFault::kNone
                                                                             : ScheduleFault::kBadMaster;
}

}  // namespace

const char* describe(ScheduleFault fault) noexcept {
  switch (fault) {
    case ScheduleFault::kNone:
      return "";
    case ScheduleFault::kNoTags:
      return "schedule.tag_ids: 1 to 16 tags";
    case ScheduleFault::kNoAnchors:
      return "schedule.anchor_ids: 1 to 16 anchors";
    case ScheduleFault::kBadId:
      return "schedule: ids are 1 to 65534";
    case ScheduleFault::kRepeatedId:
      return "schedule: each id once, tags and anchors share the numbers";
    case ScheduleFault::kBadMaster:
      return "schedule.master_id: one of anchor_ids";
    case ScheduleFault::kBadMethod:
      return "schedule.method: not known to this node";
    case ScheduleFault::kBadTurnRound:
      return "schedule.turn_round_us: 150 to 5000";
    case ScheduleFault::kBadGap:
      return "schedule.response_gap_us: 50 to 2000";
    case ScheduleFault::kBadGuard:
      return "schedule.guard_us: 5 to 1000";
  }
  return "";
}

ScheduleFault check(const groma_Schedule& schedule) noexcept {
  if (outside(schedule.tag_ids_count, 1, kMaxTags)) return ScheduleFault::kNoTags;
  if (outside(schedule.anchor_ids_count, 1, kMaxAnchors)) return ScheduleFault::kNoAnchors;
  if (const ScheduleFault fault = check_ids(schedule); fault != ScheduleFault::kNone) return fault;
  if (number_of(schedule.method) > _groma_RangingMethod_MAX) return ScheduleFault::kBadMethod;
  if (outside(schedule.turn_round_us, 150, 5'000)) return ScheduleFault::kBadTurnRound;
  if (outside(schedule.response_gap_us, 50, 2'000)) return ScheduleFault::kBadGap;
  if (outside(schedule.guard_us, 5, 1'000)) return ScheduleFault::kBadGuard;
  return ScheduleFault::kNone;
}

std::uint32_t schedule_hash(const groma_Schedule& schedule, std::uint32_t network_id,
                            dw1000::Preamble preamble) noexcept {
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
  return hash.value();
}

Superframe::Superframe(const groma_Schedule& schedule, Phy phy) noexcept
    : phy_(phy),
      has_final_(schedule.method == groma_RangingMethod_METHOD_DS_FINAL),
      tag_count_(schedule.tag_ids_count),
      guard_(Ticks::from_us(schedule.guard_us)),
      turn_round_(Ticks::from_us(schedule.turn_round_us)),
      gap_(Ticks::from_us(schedule.response_gap_us)),
      first_frame_(round_up_to_grid(guard_ + phy.before_rmarker())),
      response_spacing_(round_up_to_grid(phy.air_time(kResponseBytes) + gap_)),
      beacon_slot_(round_up_to_grid(first_frame_ + Phy::after_rmarker(kBeaconBytes) + turn_round_)) {
  const std::size_t anchors = schedule.anchor_ids_count;
  const Ticks last_frame = has_final_ ? final(anchors) + Phy::after_rmarker(kFinalBytes)
                                      : response(anchors - 1, anchors) + Phy::after_rmarker(kResponseBytes);
  tag_slot_ = round_up_to_grid(first_frame_ + last_frame + gap_);
}

Ticks Superframe::response(std::size_t index, std::size_t count) const noexcept {
  const Ticks first =
      round_up_to_grid(Phy::after_rmarker(poll_bytes(count)) + turn_round_ + phy_.before_rmarker());
  return first + static_cast<std::int64_t>(index) * response_spacing_;
}

Ticks Superframe::final(std::size_t count) const noexcept {
  const std::size_t last = count == 0 ? 0 : count - 1;
  return response(last, count) +
         round_up_to_grid(Phy::after_rmarker(kResponseBytes) + turn_round_ + phy_.before_rmarker());
}

}  // namespace groma::mac
