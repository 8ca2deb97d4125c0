// Protects a node of a keyed network against replay. A MIC proves who made a frame, not when. A node that
// starts to listen therefore sends a challenge before it trusts the time in beacons
// (docs/explanation/security.md#why-replays-fail).
#pragma once

#include <cstdint>
#include <optional>

#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/site.hpp"

namespace groma::mac {

class ReplayGuard final : public ControlChannel {
 public:
  // `site` outlives this object. In an open network every frame is trusted.
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
