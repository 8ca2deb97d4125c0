// Whether what a node hears of its keyed network is of now. A code tells who made a frame, not when.
//
// A node that begins to listen could be shown a recording. Before it believes the time that beacons tell it
// sends a nonce that it never sent before, in a JOIN, and waits for a beacon that brings it back (a Welcome).
// The JOIN's own code holds in its superframe alone: who answers it is in step with this node. From then on
// the node's clock is the witness: a beacon that does not fit to it is not believed.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"

namespace groma::mac {

class Freshness final : public ControlChannel {
 public:
  // `required`: the network has a key; without it all is fresh. `boot_count`: this boot's, as it was never
  // before; `nonces`: those made in this boot, outlives it. `turn` of `turns`: the open slots are taken in
  // turns by the nodes that the schedule names, so that those that start together do not collide for ever.
  // `relays`: as Schedule.backup_ids.
  struct Settings {
    std::uint16_t id = kNobody;
    bool tag = false;
    bool required = false;
    std::uint32_t boot_count = 0;
    std::uint32_t* nonces = nullptr;
    std::uint32_t turn = 0;
    std::uint32_t turns = 1;
    std::uint32_t relays = 0;
  };
  explicit Freshness(const Settings& settings) noexcept : settings_(settings), fresh_(!settings.required) {}

  // What was heard counts for nothing any more: the node searches.
  void forget() noexcept;
  // The node itself has begun the session.
  void found() noexcept { fresh_ = true; }

  [[nodiscard]] bool fresh() const noexcept { return fresh_; }
  // It has asked for so long that whoever it hears may be a recording: it looks for somebody else.
  [[nodiscard]] bool hopeless() const noexcept { return !fresh_ && asked_ > kMostAsked; }

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override;
  void on_sent(std::uint32_t number, bool sent) noexcept override;
  void on_control(const Frame& frame, std::uint32_t number, bool leading) noexcept override;
  void on_beacon(const Frame& frame, const Beacon& beacon) noexcept override;
  void on_beacon_out(Beacon& beacon, bool leading) noexcept override;

 private:
  static constexpr std::uint32_t kMostAsked = 8;

  Settings settings_;
  bool fresh_;
  std::uint64_t nonce_ = 0;  // 0: none made yet
  std::uint32_t asked_ = 0;
  Welcome owed_{};  // to whoever asked this node last
};

}  // namespace groma::mac
