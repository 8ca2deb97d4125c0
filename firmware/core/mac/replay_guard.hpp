// Protects a node of a keyed network against replay. A MIC proves who made a frame, not when. A node that
// starts to listen therefore sends a challenge before it trusts the time in beacons
// (docs/explanation/security.md#why-replays-fail).
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>

#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"
#include "firmware/core/mac/site.hpp"
#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {

class ReplayGuard final : public ControlChannel {
 public:
  // `site` outlives this object. In an open network every frame is trusted.
  explicit ReplayGuard(const Site& site) noexcept : site_(site), fresh_(site.network_key.empty()) {
    const auto anchors = anchors_of(*site.schedule);
    const auto tags = tags_of(*site.schedule);
    const std::uint32_t anchor = index_of(site.id, anchors);
    const std::uint32_t tag = index_of(site.id, tags);
    tag_ = tag < tags.size();
    turns_ = static_cast<std::uint32_t>(anchors.size() + tags.size());
    turn_ = anchor < anchors.size() ? anchor : anchor + tag;
    if (turn_ >= turns_) turn_ = site.id % turns_;
  }

  // Discards all trust: the node searches.
  void forget() noexcept {
    fresh_ = site_.network_key.empty();
    nonce_ = 0;
    asked_ = 0;
    pending_answer_ = {};
  }
  // The node itself has started the session.
  void found() noexcept { fresh_ = true; }

  [[nodiscard]] bool fresh() const noexcept { return fresh_; }
  // The node has sent too many challenges without an answer. It may be hearing a recording, so it should
  // search again.
  [[nodiscard]] bool hopeless() const noexcept { return !fresh_ && asked_ > kMostAsked; }

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override {
    // A boot that could not be counted has no unique nonce.
    if (fresh_ || site_.nonces == nullptr || site_.boot_count == 0) return std::nullopt;
    // Send the first challenge at once, the others in turn. The order of turns rotates, so that two senders
    // do not collide forever.
    const std::uint32_t slot = number / (site_.schedule->backup_ids_count + 1U);
    const std::uint32_t round = slot / turns_;
    if (asked_ != 0 && (slot + round) % turns_ != turn_) return std::nullopt;
    if (nonce_ == 0) {
      if (*site_.nonces == std::numeric_limits<std::uint32_t>::max()) return std::nullopt;
      nonce_ = std::uint64_t{site_.boot_count} << 32 | (*site_.nonces)++;
    }
    return Outgoing{
        .body = Join{.origin = site_.id, .nonce = nonce_, .tag = tag_, .wants_challenge_response = true}};
  }
  void on_sent(std::uint32_t, bool sent) noexcept override {
    if (sent) ++asked_;
  }
  void on_control(const Frame& frame, std::uint32_t, bool) noexcept override {
    const Join* challenge = challenge_of(frame.body);
    if (challenge != nullptr && fresh_)
      pending_answer_ = {.id = challenge->origin, .nonce = challenge->nonce};
  }
  void on_beacon(const Frame&, const Beacon& beacon) noexcept override {
    if (fresh_ || nonce_ == 0 || !beacon.challenge_response) return;
    fresh_ = beacon.challenge_response->id == site_.id && beacon.challenge_response->nonce == nonce_;
  }
  void on_beacon_out(Beacon& beacon, bool) noexcept override {
    if (pending_answer_.id == kNobody || beacon.challenge_response || !fresh_) return;
    beacon.challenge_response = pending_answer_;
    pending_answer_ = {};
  }

 private:
  static constexpr std::uint32_t kMostAsked = 8;

  // The number of ids if it is not among them.
  [[nodiscard]] static std::uint32_t index_of(std::uint16_t id, std::span<const std::uint16_t> ids) noexcept {
    return static_cast<std::uint32_t>(std::find(ids.begin(), ids.end(), id) - ids.begin());
  }

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
