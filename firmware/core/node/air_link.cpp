#include "firmware/core/node/air_link.hpp"

#include <algorithm>
#include <bit>

namespace groma::node {

using mac::Data;
using mac::kMaxDataBytes;

namespace {

// Open slots after which no older frame is in transit any more.
constexpr std::uint8_t kForgotten = 64;
constexpr std::uint8_t kPassings = 2;
constexpr std::uint8_t kSilent_s = 5;
constexpr std::size_t kLengthBytes = 2;

// Identifies a frame and its repetition number.
std::uint32_t key_of(const Data& data) noexcept {
  return std::uint32_t{data.origin} << 16U | std::uint32_t{data.message} << 8U | (data.fragment & 7U) << 5U |
         (data.acknowledgement ? 0x10U : 0U) | (data.to_host ? 0x08U : 0U) | (data.round & 7U);
}

}  // namespace

void AirLink::start(std::uint16_t id, bool passes_on, std::uint32_t seed) noexcept {
  if (id != id_) {
    phase_ = Phase::kIdle;
    random_ = seed * 2'654'435'761U ^ id;
    if (random_ == 0) random_ = 1;
    asked_number_ = static_cast<std::uint8_t>(random() >> 8U);
  }
  id_ = id;
  passes_on_ = passes_on;
  passing_ = 0;
}

// xorshift (Marsaglia 2003).
std::uint32_t AirLink::random() noexcept {
  random_ ^= random_ << 13U;
  random_ ^= random_ >> 17U;
  random_ ^= random_ << 5U;
  return random_;
}

// ---- asking and answering -------------------------------------------------------------------------------

AirLink::Asked AirLink::ask(std::uint16_t target, std::uint32_t request_id,
                            std::span<const std::uint8_t> command) noexcept {
  if (command.empty() || command.size() > buffer_.size()) return Asked::kTooLong;
  const bool same = target == asked_target_ && request_id == request_id_;
  if (asking()) return same ? Asked::kUnderWay : Asked::kBusy;
  const bool serving = phase_ == Phase::kTaking || phase_ == Phase::kTaken || phase_ == Phase::kAnswering;
  if (serving && idle_ < kForgotten) return Asked::kBusy;
  if (phase_ == Phase::kHave && same) {
    event_ = Event::kAnswer;
    return Asked::kUnderWay;
  }
  if (!same) ++asked_number_;
  if (target != asked_target_) hops_ = 0;
  peer_ = asked_target_ = target;
  request_id_ = request_id;
  message_ = asked_number_;
  std::copy(command.begin(), command.end(), buffer_.begin());
  size_ = static_cast<std::uint16_t>(command.size());
  silent_s_ = 0;
  begin_sending(Phase::kAsking);
  return Asked::kUnderWay;
}

void AirLink::on_second() noexcept {
  if (!asking() || ++silent_s_ < kSilent_s) return;
  phase_ = Phase::kIdle;
  event_ = Event::kNoAnswer;
}

std::span<std::uint8_t> AirLink::room() noexcept {
  const std::size_t begin = std::min<std::size_t>(size_ + kLengthBytes, buffer_.size());
  return std::span(buffer_).subspan(begin);
}

void AirLink::append(std::size_t size) noexcept {
  buffer_[size_] = static_cast<std::uint8_t>(size);
  buffer_[size_ + 1U] = static_cast<std::uint8_t>(size >> 8U);
  size_ = static_cast<std::uint16_t>(size_ + kLengthBytes + size);
}

std::optional<std::span<const std::uint8_t>> AirLink::next_message(
    std::span<const std::uint8_t>& answer) noexcept {
  if (answer.size() < kLengthBytes) return std::nullopt;
  const std::size_t size = answer[0] | static_cast<std::size_t>(answer[1]) << 8U;
  answer = answer.subspan(kLengthBytes);
  if (size > answer.size()) return std::nullopt;
  const auto message = answer.first(size);
  answer = answer.subspan(size);
  return message;
}

void AirLink::begin_sending(Phase phase) noexcept {
  phase_ = phase;
  fragments_ = static_cast<std::uint8_t>(
      std::clamp<std::size_t>((size_ + kMaxDataBytes - 1) / kMaxDataBytes, 1, kMaxFragments));
  have_ = next_ = tries_ = wait_ = 0;
  round_over_ = acknowledge_ = false;
}

// ---- to the air -----------------------------------------------------------------------------------------

std::optional<mac::ControlChannel::Outgoing> AirLink::own_turn(std::uint32_t /*number*/) noexcept {
  if (passing_ == 0) return std::nullopt;
  --passing_;
  return Outgoing{.body = passed_};
}

std::optional<mac::ControlChannel::Outgoing> AirLink::open_slot(std::uint32_t /*number*/) noexcept {
  silent_s_ = 0;
  if (idle_ < kForgotten) ++idle_;
  if (wait_ > 0) --wait_;
  if (passing_wait_ > 0) --passing_wait_;
  // Leave slots free for nodes that join and for other messages.
  if (random() % 4 == 0) return std::nullopt;
  if (std::exchange(acknowledge_, false)) return Outgoing{.body = acknowledgement()};
  if (passing_ != 0 && passing_wait_ == 0) {
    passing_ = 0;
    return Outgoing{.body = passed_};
  }
  if (wait_ > 0) return std::nullopt;
  if (phase_ == Phase::kAwaiting && try_again()) return Outgoing{.body = acknowledgement()};
  if (phase_ == Phase::kAsking || phase_ == Phase::kAnswering) return next_fragment();
  return std::nullopt;
}

std::optional<mac::ControlChannel::Outgoing> AirLink::next_fragment() noexcept {
  if (std::exchange(round_over_, false)) {
    if (!try_again()) return std::nullopt;
    next_ = last_missing();
  }
  while (next_ < fragments_ && (unsigned{have_} >> next_ & 1U) != 0) ++next_;
  const std::uint8_t last = last_missing();
  const std::uint8_t index = std::min(next_, last);
  round_over_ = index == last;
  next_ = static_cast<std::uint8_t>(index + 1U);
  // A frame with hops left needs one more open slot if the master is one of the relays.
  wait_ = round_over_ ? reply_wait() : static_cast<std::uint8_t>(hops_ > 0 ? 2 : 0);
  return Outgoing{.body = fragment(index, round_over_)};
}

bool AirLink::try_again() noexcept {
  if (++tries_ > kMaxTries) {
    event_ = asking() ? Event::kNoAnswer : Event::kUndelivered;
    phase_ = asking() ? Phase::kIdle : Phase::kAnswered;
    return false;
  }
  if (tries_ % 2 == 0 && hops_ < kMaxHops) ++hops_;
  wait_ = reply_wait();
  return true;
}

std::uint8_t AirLink::reply_wait() noexcept {
  return static_cast<std::uint8_t>(3U + 4U * hops_ + random() % 4);
}

Data AirLink::fragment(std::uint8_t index, bool asks) noexcept {
  Data data{.origin = id_,
            .target = peer_,
            .message = message_,
            .fragment = index,
            .fragments = fragments_,
            .to_host = phase_ == Phase::kAnswering,
            .asks = asks,
            .hops_left = hops_,
            .round = static_cast<std::uint8_t>(sent_++ & 7U)};
  const auto bytes = message().subspan(std::min<std::size_t>(index * kMaxDataBytes, size_));
  data.size = static_cast<std::uint8_t>(std::min(bytes.size(), kMaxDataBytes));
  std::copy_n(bytes.begin(), data.size, data.payload.begin());
  return data;
}

Data AirLink::acknowledgement() noexcept {
  Data data{.origin = id_,
            .target = peer_,
            .message = message_,
            .fragments = 1,
            .acknowledgement = true,
            .to_host = !asked(),
            .hops_left = hops_,
            .round = static_cast<std::uint8_t>(sent_++ & 7U),
            .size = 1};
  data.payload[0] = have_;
  return data;
}

std::uint8_t AirLink::last_missing() const noexcept {
  const auto missing = static_cast<std::uint8_t>(all() & ~have_);
  return missing == 0 ? static_cast<std::uint8_t>(fragments_ - 1U)
                      : static_cast<std::uint8_t>(std::bit_width(missing) - 1);
}

// ---- from the air ---------------------------------------------------------------------------------------

void AirLink::on_control(const mac::Frame& frame, std::uint32_t /*number*/, bool leading) noexcept {
  const auto* data = std::get_if<Data>(&frame.body);
  if (data == nullptr || id_ == mac::kNobody || data->origin == id_) return;
  if (data->target != id_) return pass_on(*data, leading);
  const bool direct = frame.source == data->origin;
  if (data->acknowledgement) {
    take_acknowledgement(*data);
  } else if (data->to_host) {
    take_answer(*data);
  } else {
    take_command(*data, direct);
  }
  if (direct && data->origin == peer_) hops_ = 0;
}

void AirLink::pass_on(const Data& data, bool leading) noexcept {
  if (!passes_on_ || data.hops_left == 0 || passing_ == kPassings) return;
  const std::uint32_t key = key_of(data);
  if (std::find(seen_.begin(), seen_.end(), key) != seen_.end()) return;
  seen_[next_seen_++ % seen_.size()] = key;
  passed_ = data;
  --passed_.hops_left;
  passing_ = kPassings;
  // The master relays in an open slot soon. Back-ups relay in their own turns, and in an open slot only if
  // they get none.
  passing_wait_ = leading ? 1 : static_cast<std::uint8_t>(3 + random() % 4);
}

bool AirLink::stale(const Data& data) const noexcept {
  if (idle_ >= kForgotten) return false;
  return std::any_of(heard_.begin(), heard_.end(), [&](const Heard& heard) {
    return heard.origin == data.origin && static_cast<std::int8_t>(data.message - heard.message) <= 0;
  });
}

void AirLink::take_command(const Data& data, bool direct) noexcept {
  if (asking()) return;
  const bool same = asked() && data.origin == peer_ && data.message == message_;
  if (!same) {
    // Do not replace a command that is being executed.
    if (phase_ == Phase::kTaken) return;
    const bool serving = asked() && phase_ != Phase::kAnswered && data.origin != peer_;
    if (stale(data) || (serving && idle_ < kForgotten) || data.fragments > kMaxFragments) return;
    if (heard_[0].origin != data.origin) heard_[1] = heard_[0];
    heard_[0] = {.origin = data.origin, .message = data.message};
    phase_ = Phase::kTaking;
    event_ = Event::kNone;
    peer_ = data.origin;
    message_ = data.message;
    hops_ = direct ? 0 : kMaxHops;
    fragments_ = have_ = 0;
    acknowledge_ = false;
  }
  idle_ = 0;
  if (phase_ == Phase::kTaking) {
    if (store(data)) {
      phase_ = Phase::kTaken;
      event_ = Event::kCommand;
    }
    acknowledge_ = acknowledge_ || data.asks || phase_ == Phase::kTaken;
  } else if (phase_ == Phase::kTaken) {
    acknowledge_ = data.asks;
  } else if (phase_ == Phase::kAnswered) {
    // The peer has started again, or never acknowledged the answer.
    begin_sending(Phase::kAnswering);
    next_ = last_missing();
  }
}

void AirLink::take_answer(const Data& data) noexcept {
  if (asked() || phase_ == Phase::kIdle || data.origin != peer_ || data.message != message_) return;
  if (phase_ == Phase::kAsking) {
    phase_ = Phase::kAwaiting;
    fragments_ = have_ = 0;
  }
  if (phase_ == Phase::kAwaiting) {
    tries_ = 0;
    wait_ = reply_wait();
    if (store(data)) {
      phase_ = Phase::kHave;
      event_ = Event::kAnswer;
    }
  }
  acknowledge_ = acknowledge_ || data.asks || phase_ == Phase::kHave;
}

bool AirLink::store(const Data& data) noexcept {
  if (have_ == 0) fragments_ = std::min<std::uint8_t>(data.fragments, kMaxFragments);
  const bool last = data.fragment + 1U == fragments_;
  if (data.fragments != fragments_ || (!last && data.size != kMaxDataBytes)) return false;
  const std::size_t begin = data.fragment * kMaxDataBytes;
  std::copy_n(data.payload.begin(), data.size, buffer_.begin() + static_cast<std::ptrdiff_t>(begin));
  have_ = static_cast<std::uint8_t>(have_ | 1U << data.fragment);
  if (last) size_ = static_cast<std::uint16_t>(begin + data.size);
  return have_ == all();
}

void AirLink::take_acknowledgement(const Data& data) noexcept {
  if (data.origin != peer_ || data.message != message_ || data.size != 1) return;
  // A node that is still executing the command acknowledges it when asked for progress.
  if (data.to_host && phase_ == Phase::kTaken) acknowledge_ = true;
  if (!data.to_host && phase_ == Phase::kAwaiting) tries_ = 0;
  const bool mine =
      data.to_host ? phase_ == Phase::kAnswering || phase_ == Phase::kAnswered : phase_ == Phase::kAsking;
  if (!mine) return;
  const std::uint8_t held = data.payload[0] & all();
  if (phase_ == Phase::kAnswered) {
    if (held == all()) return;
    begin_sending(Phase::kAnswering);
  }
  idle_ = 0;
  if (phase_ == Phase::kAnswering && held == 0 && have_ == 0 && !round_over_) return;  // a progress request
  tries_ = 0;
  have_ = static_cast<std::uint8_t>(have_ | held);
  if (have_ == all()) {
    if (phase_ == Phase::kAnswering) {
      phase_ = Phase::kAnswered;
      event_ = Event::kDelivered;
      return;
    }
    phase_ = Phase::kAwaiting;
    fragments_ = have_ = 0;
    wait_ = reply_wait();
    return;
  }
  // Start a new round with the missing fragments.
  round_over_ = false;
  next_ = wait_ = 0;
}

}  // namespace groma::node
