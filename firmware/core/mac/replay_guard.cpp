#include "firmware/core/mac/replay_guard.hpp"

#include <algorithm>
#include <limits>
#include <span>

#include "firmware/core/mac/superframe.hpp"

namespace groma::mac {
namespace {

// The number of ids if it is not among them.
std::uint32_t index_of(std::uint16_t id, std::span<const std::uint16_t> ids) noexcept {
  return static_cast<std::uint32_t>(std::find(ids.begin(), ids.end(), id) - ids.begin());
}

}  // namespace

ReplayGuard::ReplayGuard(const Site& site) noexcept : site_(site), fresh_(site.network_key.empty()) {
  const auto anchors = anchors_of(*site.schedule);
  const auto tags = tags_of(*site.schedule);
  const std::uint32_t anchor = index_of(site.id, anchors);
  const std::uint32_t tag = index_of(site.id, tags);
  tag_ = tag < tags.size();
  turns_ = static_cast<std::uint32_t>(anchors.size() + tags.size());
  turn_ = anchor < anchors.size() ? anchor : anchor + tag;
  if (turn_ >= turns_) turn_ = site.id % turns_;
}

void ReplayGuard::forget() noexcept {
  fresh_ = site_.network_key.empty();
  nonce_ = 0;
  asked_ = 0;
  pending_answer_ = {};
}

std::optional<ControlChannel::Outgoing> ReplayGuard::open_slot(std::uint32_t number) noexcept {
  // A boot that could not be counted has no unique nonce.
  if (fresh_ || site_.nonces == nullptr || site_.boot_count == 0) return std::nullopt;
  // Send the first challenge at once, the others in turn. The order of turns rotates, so that two senders do
  // not collide forever.
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

void ReplayGuard::on_sent(std::uint32_t, bool sent) noexcept {
  if (sent) ++asked_;
}

void ReplayGuard::on_control(const Frame& frame, std::uint32_t, bool) noexcept {
  const Join* challenge = challenge_of(frame.body);
  if (challenge != nullptr && fresh_) pending_answer_ = {.id = challenge->origin, .nonce = challenge->nonce};
}

void ReplayGuard::on_beacon(const Frame&, const Beacon& beacon) noexcept {
  if (fresh_ || nonce_ == 0 || !beacon.challenge_response) return;
  fresh_ = beacon.challenge_response->id == site_.id && beacon.challenge_response->nonce == nonce_;
}

void ReplayGuard::on_beacon_out(Beacon& beacon, bool) noexcept {
  if (pending_answer_.id == kNobody || beacon.challenge_response || !fresh_) return;
  beacon.challenge_response = pending_answer_;
  pending_answer_ = {};
}

}  // namespace groma::mac
