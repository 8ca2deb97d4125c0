// Protects a node of a keyed network against replay. A MIC proves who made a frame, not when.
//
// A node that starts to listen could receive a recording. Before it trusts the time in beacons it sends a
// challenge, a nonce that it never used before, in a JOIN, and waits for a beacon that returns the nonce (a
// ChallengeResponse). The JOIN's own MIC is valid in its superframe only, so a node that answers it is
// synchronized with this node. From then on the node compares beacons with its own clock and rejects those
// that do not fit.
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"

namespace groma::mac {

class ReplayGuard final : public ControlChannel {
 public:
  // `required`: the network has a key; without one every frame is trusted. `boot_count`: this boot's number,
  // never used before; `nonces`: how many were made in this boot, outlives this object. `turn` of `turns`:
  // the nodes that the schedule names take turns in the open slots, so that nodes that start together do not
  // collide forever. `relays`: the size of Schedule.backup_ids.
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
  explicit ReplayGuard(const Settings& settings) noexcept : settings_(settings), fresh_(!settings.required) {}

  // Discards all trust: the node searches.
  void forget() noexcept;
  // The node itself has started the session.
  void found() noexcept { fresh_ = true; }

  [[nodiscard]] bool fresh() const noexcept { return fresh_; }
  // The node has sent too many challenges without an answer. It may be hearing a recording, so it should
  // search again.
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
  ChallengeResponse pending_answer_{};  // the response to the last challenge received
};

}  // namespace groma::mac
