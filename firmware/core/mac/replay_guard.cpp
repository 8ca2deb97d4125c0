#include "firmware/core/mac/replay_guard.hpp"

#include <limits>

namespace groma::mac {

void ReplayGuard::forget() noexcept {
  fresh_ = !settings_.required;
  nonce_ = 0;
  asked_ = 0;
  pending_answer_ = {};
}

std::optional<ControlChannel::Outgoing> ReplayGuard::open_slot(std::uint32_t number) noexcept {
  // A boot that could not be counted has no unique nonce.
  if (fresh_ || settings_.nonces == nullptr || settings_.boot_count == 0) return std::nullopt;
  // Send the first challenge at once, the others in turn. The order of turns rotates, so that two senders do
  // not collide forever.
  const std::uint32_t slot = number / (settings_.relays + 1);
  const std::uint32_t round = slot / settings_.turns;
  if (asked_ != 0 && (slot + round) % settings_.turns != settings_.turn) return std::nullopt;
  if (nonce_ == 0) {
    if (*settings_.nonces == std::numeric_limits<std::uint32_t>::max()) return std::nullopt;
    nonce_ = std::uint64_t{settings_.boot_count} << 32 | (*settings_.nonces)++;
  }
  return Outgoing{
      .body = Join{
          .origin = settings_.id, .nonce = nonce_, .tag = settings_.tag, .wants_challenge_response = true}};
}

void ReplayGuard::on_sent(std::uint32_t, bool sent) noexcept {
  if (sent) ++asked_;
}

void ReplayGuard::on_control(const Frame& frame, std::uint32_t, bool) noexcept {
  const auto* join = std::get_if<Join>(&frame.body);
  if (join != nullptr && join->wants_challenge_response && fresh_) {
    pending_answer_ = {.id = join->origin, .nonce = join->nonce};
  }
}

void ReplayGuard::on_beacon(const Frame&, const Beacon& beacon) noexcept {
  if (fresh_ || nonce_ == 0 || !beacon.challenge_response) return;
  fresh_ = beacon.challenge_response->id == settings_.id && beacon.challenge_response->nonce == nonce_;
}

void ReplayGuard::on_beacon_out(Beacon& beacon, bool) noexcept {
  if (pending_answer_.id == kNobody || beacon.challenge_response || !fresh_) return;
  beacon.challenge_response = pending_answer_;
  pending_answer_ = {};
}

}  // namespace groma::mac
