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
#include "firmware/core/mac/site.hpp"

namespace groma::mac {

class ReplayGuard final : public ControlChannel {
 public:
  // `site` outlives this object. In an open network every frame is trusted. The nodes that the schedule names
  // take turns in the open slots, so that nodes that start together do not collide forever; other nodes
  // derive their turns from their ids.
  explicit ReplayGuard(const Site& site) noexcept;

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

  const Site& site_;
  bool fresh_;
  bool tag_;
  std::uint32_t turns_;
  std::uint32_t turn_;
  std::uint64_t nonce_ = 0;  // 0: none made yet
  std::uint32_t asked_ = 0;
  ChallengeResponse pending_answer_{};  // the response to the last challenge received
};

}  // namespace groma::mac
