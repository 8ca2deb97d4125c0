// Ten tags and 64 anchors in three halls in a row. Walls keep each hall's frames inside. One anchor of each
// hall is mounted above the walls and hears its neighbours: the middle one is the master, the others relay
// its beacon. The halls' tags share their slots.
#include <gtest/gtest.h>

#include "host/provision/air_plan.hpp"
#include "test/sim/fault_site.hpp"

namespace groma::sim {
namespace {

constexpr int kCells = 3;
constexpr std::array<int, kCells> kTags{4, 3, 3};
constexpr std::array<int, kCells> kAnchors{22, 21, 21};
constexpr double kPitch_m = 30.0;  // from wall to wall

constexpr std::size_t kPlaces = 16;
constexpr std::uint16_t kMaster = 201;  // in the middle

int cell_of(double x_m) {
  return static_cast<int>(std::floor(x_m / kPitch_m));
}

class Halls final : public FreeSpace {
 public:
  [[nodiscard]] Propagation between(std::uint16_t a, std::uint16_t b, double t_s) const override {
    constexpr double kWallTop_m = 6.8;
    constexpr double kWallLoss_db = 40.0;
    constexpr double kSensitivity_dbm = -94.0;
    const Place& p = place(a);
    const Place& q = place(b);
    Propagation path = FreeSpace::between(a, b, t_s);
    const int low = std::min(cell_of(p.x_m), cell_of(q.x_m));
    const int high = std::max(cell_of(p.x_m), cell_of(q.x_m));
    for (int wall = low + 1; wall <= high; ++wall) {
      const double along = (wall * kPitch_m - p.x_m) / (q.x_m - p.x_m);
      if (p.z_m + along * (q.z_m - p.z_m) >= kWallTop_m) continue;
      path.receive_power_dbm -= kWallLoss_db;
      path.first_path_power_dbm -= kWallLoss_db;
    }
    path.audible = path.receive_power_dbm > kSensitivity_dbm;
    return path;
  }
};

struct CellNodes {
  std::vector<std::uint16_t> tags;
  std::vector<std::uint16_t> anchors;  // the first is above the walls
};

TEST(ThreeCells, RangeAtThePredictedRateWithoutCollisions) {
  constexpr double kSettled_s = 4.0;
  constexpr double kWatched_s = GROMA_WATCHED_S;
  std::array<CellNodes, kCells> cells;
  groma_Config config = groma_Config_init_zero;
  config.network_id = 7;
  config.has_schedule = true;
  config.preamble = groma_Preamble_PREAMBLE_64;
  config.transmit_antenna_delay_dtu = config.receive_antenna_delay_dtu = 16436;
  groma_Schedule& schedule = config.schedule;
  schedule.epoch = 1;
  schedule.method = groma_RangingMethod_METHOD_DS_NEXT_POLL;
  schedule.turn_round_us = mac::kUsualTurnaround_us;
  schedule.response_gap_us = mac::usual_gap_us(true, false);
  schedule.arm_ahead = true;
  schedule.guard_us = mac::kUsualGuard_us;
  schedule.responses = kPlaces;
  schedule.slots = 4;

  Halls halls;
  std::vector<NodeSpec> specs;
  const auto add = [&](std::uint16_t id, const Place& place) {
    const KeyedRandom draw = KeyedRandom(1).of(id);
    halls.put(id, place);
    NodeSpec spec;
    spec.chip.id = id;
    spec.chip.clock.offset_ppm = draw.of(1).uniform(-20.0, 20.0);
    spec.chip.clock.first_tick = draw.of(2).bits() & ((std::uint64_t{1} << 40) - 1);
    // The master first, then those that relay its beacon, then all others.
    const bool beaconer = id % 100 == 1 && id > 100;
    spec.power_on = from_seconds(id == kMaster ? 0.0 : beaconer ? 0.4 : draw.of(3).uniform(1.2, 1.6));
    specs.push_back(spec);
  };
  for (int cell = 0; cell < kCells; ++cell) {
    const auto at = static_cast<std::size_t>(cell);
    const double west_m = cell * kPitch_m;
    for (int i = 0; i < kTags[at]; ++i) {
      const auto id = static_cast<std::uint16_t>(1 + 10 * cell + i);
      cells[at].tags.push_back(id);
      schedule.tag_ids[schedule.tag_ids_count++] = id;
      schedule.tag_slots[schedule.tag_slots_count++] = static_cast<std::uint8_t>(i);
      add(id, {west_m + 9.0 + 4.0 * i, 5.0 + 2.5 * i, 0.5});
    }
    for (int i = 0; i < kAnchors[at]; ++i) {
      const auto id = static_cast<std::uint16_t>(101 + 100 * cell + i);
      cells[at].anchors.push_back(id);
      schedule.anchor_ids[schedule.anchor_ids_count++] = id;
      const double angle = 2.0 * std::numbers::pi * i / kAnchors[at];
      add(id, i == 0 ? Place{west_m + 15.0, 9.0, 8.0}
                     : Place{west_m + 15.0 + 12.0 * std::cos(angle), 9.0 + 8.0 * std::sin(angle), 3.0});
    }
  }
  schedule.master_id = kMaster;
  schedule.backup_ids[schedule.backup_ids_count++] = cells[0].anchors[0];
  schedule.backup_ids[schedule.backup_ids_count++] = cells[2].anchors[0];
  // Only the relays hear the master over the walls, and they do not hear each other.
  ASSERT_FALSE(halls.between(kMaster, cells[0].tags[0], 0.0).audible);
  ASSERT_FALSE(halls.between(kMaster, cells[2].anchors[1], 0.0).audible);
  ASSERT_FALSE(halls.between(cells[0].anchors[0], cells[2].anchors[0], 0.0).audible);

  Network network(halls, {.timestamp_noise_s = 1e-10}, 1);
  AirLog air(network.medium());
  network.medium().set_witness(&air);
  for (NodeSpec& spec : specs) {
    const bool tag = spec.chip.id < 100;
    config.role = tag ? groma_Role_ROLE_TAG : groma_Role_ROLE_ANCHOR;
    config.id = spec.chip.id;
    std::array<std::uint8_t, node::kMaxConfigBytes> blob{};
    const std::size_t size = node::encode_config(config, blob);
    ASSERT_GT(size, 0U);
    spec.stored_config.assign(blob.begin(), blob.begin() + static_cast<std::ptrdiff_t>(size));
    network.add_native(spec);
  }
  std::vector<Listener> listeners(specs.size());
  std::array<std::uint64_t, kCells> good{};
  double worst_m = 0.0;
  std::uint64_t collisions_before = 0;
  for (double t_s = 0.0; t_s < kSettled_s + kWatched_s;) {
    t_s += 0.25;
    network.run_until(from_seconds(t_s));
    if (t_s <= kSettled_s) collisions_before = air.collisions;
    std::vector<TimedByte> bytes;
    for (std::size_t i = 0; i < specs.size(); ++i) {
      bytes.clear();
      network.take(i, bytes);
      listeners[i].take(bytes);
      for (const Listener::Report& report : listeners[i].reports) {
        if (to_seconds(report.t) < kSettled_s) continue;
        for (pb_size_t k = 0; k < report.body.ranges_count; ++k) {
          const groma_Range& range = report.body.ranges[k];
          if (range.status != groma_RangeStatus_RANGE_OK) continue;
          const auto tag = static_cast<std::uint16_t>(report.body.tag_id);
          const auto anchor = static_cast<std::uint16_t>(range.anchor_id);
          ++good[static_cast<std::size_t>(tag / 10)];
          worst_m =
              std::max(worst_m, std::abs(static_cast<double>(range.range_m) - halls.distance_m(tag, anchor)));
        }
      }
      listeners[i].reports.clear();
    }
  }
  network.medium().set_witness(nullptr);

  config.role = groma_Role_ROLE_TAG;
  config.id = schedule.tag_ids[0];
  constexpr unsigned kBaud = 1'000'000;
  const provision::AirPlan plan = provision::plan_air(config, kBaud);
  std::printf("superframe %.2f ms, %llu collisions, worst range off by %.3f m\n", plan.superframe_s * 1e3,
              static_cast<unsigned long long>(air.collisions - collisions_before), worst_m);
  for (std::size_t cell = 0; cell < kCells; ++cell) {
    const double rate = static_cast<double>(good[cell]) / kWatched_s;
    const double predicted = kTags[cell] * plan.tag_ranges_per_s;
    std::printf("cell %zu: %.0f ranges/s, predicted %.0f\n", cell, rate, predicted);
    EXPECT_NEAR(rate, predicted, 0.05 * predicted) << cell;
    EXPECT_GE(rate, 1600.0) << cell;
  }
  EXPECT_EQ(air.collisions - collisions_before, 0U);
  EXPECT_LT(worst_m, 6.0 * 0.0225);  // at most sigma of a range for timestamps of 0.1 ns
}

}  // namespace
}  // namespace groma::sim
