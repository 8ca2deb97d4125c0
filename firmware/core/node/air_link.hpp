// Transport of the host link's messages over the air: a command from the wired node to another one, and the
// answer back. Only one message is in progress at a time.
//
// docs/reference/air.md specifies fragments, rounds, acknowledgements and relays. A message that is not
// acknowledged within kMaxTries is reported as undelivered.
#pragma once

#include <algorithm>
#include <array>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <utility>

#include "firmware/core/mac/control_channel.hpp"
#include "firmware/core/mac/frame.hpp"

namespace groma::node {

class AirLink final : public mac::ControlChannel {
 public:
  static constexpr std::size_t kMaxFragments = 8;
  static constexpr std::size_t kMaxMessageBytes = kMaxFragments * mac::kMaxDataBytes;
  static constexpr std::uint8_t kMaxHops = 3;
  // Consecutive rounds without an answer from the peer. Over two hops with 30 % loss each, all of them fail
  // with a probability of 0.1 %.
  static constexpr std::uint8_t kMaxTries = 24;

  // Call after boot and with each configuration. `passes_on`: this node relays the beacon. `seed`: differs
  // between nodes and boots.
  void start(std::uint16_t id, bool passes_on, std::uint32_t seed) noexcept {
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

  enum class Event : std::uint8_t {
    kNone,
    kCommand,    // received, in message(); answer it
    kAnswer,     // to the command sent, in message()
    kNoAnswer,   // to the command sent
    kDelivered,  // the answer was acknowledged
    kUndelivered,
  };
  // The event since the last call.
  [[nodiscard]] Event take_event() noexcept { return std::exchange(event_, Event::kNone); }
  [[nodiscard]] std::span<const std::uint8_t> message() const noexcept {
    return std::span(buffer_).first(size_);
  }
  // The node that asks, or is asked.
  [[nodiscard]] std::uint16_t peer() const noexcept { return peer_; }

  // ---- the wired node ------------------------------------------------------------------------------------

  enum class Asked : std::uint8_t { kUnderWay, kBusy, kTooLong };
  // Sends a command. If it repeats the last request, its answer is reported again or its transmission
  // continues.
  [[nodiscard]] Asked ask(std::uint16_t target, std::uint32_t request_id,
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
  [[nodiscard]] bool asking() const noexcept {
    return phase_ == Phase::kAsking || phase_ == Phase::kAwaiting;
  }
  [[nodiscard]] std::uint32_t request_id() const noexcept { return request_id_; }
  // Call about each second: a node without open slots, because it is not synchronized, gives up after a
  // while.
  void on_second() noexcept {
    if (!asking() || ++silent_s_ < kSilent_s) return;
    phase_ = Phase::kIdle;
    event_ = Event::kNoAnswer;
  }

  // ---- the addressed node ---------------------------------------------------------------------------------

  // Call after kCommand. An answer consists of messages, each after its length (2 bytes, little-endian).
  void begin_answer() noexcept { size_ = 0; }
  // The free space for the next message.
  [[nodiscard]] std::span<std::uint8_t> room() noexcept {
    const std::size_t begin = std::min<std::size_t>(size_ + kLengthBytes, buffer_.size());
    return std::span(buffer_).subspan(begin);
  }
  // Adds the first `size` bytes of room() as a message.
  void append(std::size_t size) noexcept {
    buffer_[size_] = static_cast<std::uint8_t>(size);
    buffer_[size_ + 1U] = static_cast<std::uint8_t>(size >> 8U);
    size_ = static_cast<std::uint16_t>(size_ + kLengthBytes + size);
  }
  void send_answer() noexcept { begin_sending(Phase::kAnswering); }
  // Removes the next message from `answer` and returns it; nothing at the end.
  [[nodiscard]] static std::optional<std::span<const std::uint8_t>> next_message(
      std::span<const std::uint8_t>& answer) noexcept {
    if (answer.size() < kLengthBytes) return std::nullopt;
    const std::size_t size = answer[0] | static_cast<std::size_t>(answer[1]) << 8U;
    answer = answer.subspan(kLengthBytes);
    if (size > answer.size()) return std::nullopt;
    const auto message = answer.first(size);
    answer = answer.subspan(size);
    return message;
  }

  // ---- mac::ControlChannel, called by the station --------------------------------------------------------

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t /*number*/) noexcept override {
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
  [[nodiscard]] std::optional<Outgoing> own_turn(std::uint32_t /*number*/) noexcept override {
    if (passing_ == 0) return std::nullopt;
    --passing_;
    return Outgoing{.body = passed_};
  }
  [[nodiscard]] bool wants_slot() const noexcept override {
    return acknowledge_ || passing_ != 0 || asking() || phase_ == Phase::kAnswering;
  }
  void on_control(const mac::Frame& frame, std::uint32_t /*number*/, bool leading) noexcept override {
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

 private:
  using Data = mac::Data;
  // Open slots after which no older frame is in transit any more.
  static constexpr std::uint8_t kForgotten = 64;
  static constexpr std::uint8_t kPassings = 2;
  static constexpr std::uint8_t kSilent_s = 5;
  static constexpr std::size_t kLengthBytes = 2;

  enum class Phase : std::uint8_t {
    kIdle,
    kAsking,     // sending the command
    kAwaiting,   // command delivered; waiting for the answer
    kHave,       // answer received
    kTaking,     // receiving a command
    kTaken,      // command received
    kAnswering,  // sending the answer
    kAnswered,   // answer delivered, or given up
  };
  struct Heard {
    std::uint16_t origin = mac::kNobody;
    std::uint8_t message = 0;
  };

  // Identifies a frame and its repetition number.
  [[nodiscard]] static std::uint32_t key_of(const Data& data) noexcept {
    return std::uint32_t{data.origin} << 16U | std::uint32_t{data.message} << 8U |
           (data.fragment & 7U) << 5U | (data.acknowledgement ? 0x10U : 0U) | (data.to_host ? 0x08U : 0U) |
           (data.round & 7U);
  }
  [[nodiscard]] std::optional<Outgoing> next_fragment() noexcept {
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
  [[nodiscard]] Data fragment(std::uint8_t index, bool asks) noexcept {
    Data data{.origin = id_,
              .target = peer_,
              .message = message_,
              .fragment = index,
              .fragments = fragments_,
              .to_host = phase_ == Phase::kAnswering,
              .asks = asks,
              .hops_left = hops_,
              .round = static_cast<std::uint8_t>(sent_++ & 7U)};
    const auto bytes = message().subspan(std::min<std::size_t>(index * mac::kMaxDataBytes, size_));
    data.size = static_cast<std::uint8_t>(std::min(bytes.size(), mac::kMaxDataBytes));
    std::copy_n(bytes.begin(), data.size, data.payload.begin());
    return data;
  }
  [[nodiscard]] Data acknowledgement() noexcept {
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
  void take_command(const Data& data, bool direct) noexcept {
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
  void take_answer(const Data& data) noexcept {
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
  void take_acknowledgement(const Data& data) noexcept {
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
  // Returns true if this completed the message.
  bool store(const Data& data) noexcept {
    if (have_ == 0) fragments_ = std::min<std::uint8_t>(data.fragments, kMaxFragments);
    const bool last = data.fragment + 1U == fragments_;
    if (data.fragments != fragments_ || (!last && data.size != mac::kMaxDataBytes)) return false;
    const std::size_t begin = data.fragment * mac::kMaxDataBytes;
    std::copy_n(data.payload.begin(), data.size, buffer_.begin() + static_cast<std::ptrdiff_t>(begin));
    have_ = static_cast<std::uint8_t>(have_ | 1U << data.fragment);
    if (last) size_ = static_cast<std::uint16_t>(begin + data.size);
    return have_ == all();
  }
  [[nodiscard]] bool stale(const Data& data) const noexcept {
    if (idle_ >= kForgotten) return false;
    return std::any_of(heard_.begin(), heard_.end(), [&](const Heard& heard) {
      return heard.origin == data.origin && static_cast<std::int8_t>(data.message - heard.message) <= 0;
    });
  }
  void begin_sending(Phase phase) noexcept {
    phase_ = phase;
    fragments_ = static_cast<std::uint8_t>(
        std::clamp<std::size_t>((size_ + mac::kMaxDataBytes - 1) / mac::kMaxDataBytes, 1, kMaxFragments));
    have_ = next_ = tries_ = wait_ = 0;
    round_over_ = acknowledge_ = false;
  }
  // Returns false if the number of tries is used up.
  bool try_again() noexcept {
    if (++tries_ > kMaxTries) {
      event_ = asking() ? Event::kNoAnswer : Event::kUndelivered;
      phase_ = asking() ? Phase::kIdle : Phase::kAnswered;
      return false;
    }
    if (tries_ % 2 == 0 && hops_ < kMaxHops) ++hops_;
    wait_ = reply_wait();
    return true;
  }
  void pass_on(const Data& data, bool leading) noexcept {
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

  [[nodiscard]] bool asked() const noexcept { return phase_ >= Phase::kTaking; }
  [[nodiscard]] std::uint8_t all() const noexcept {
    return static_cast<std::uint8_t>((1U << fragments_) - 1U);
  }
  [[nodiscard]] std::uint8_t last_missing() const noexcept {
    const auto missing = static_cast<std::uint8_t>(all() & ~have_);
    return missing == 0 ? static_cast<std::uint8_t>(fragments_ - 1U)
                        : static_cast<std::uint8_t>(std::bit_width(missing) - 1);
  }
  [[nodiscard]] std::uint8_t reply_wait() noexcept {
    return static_cast<std::uint8_t>(3U + 4U * hops_ + random() % 4);
  }
  // xorshift (Marsaglia 2003).
  [[nodiscard]] std::uint32_t random() noexcept {
    random_ ^= random_ << 13U;
    random_ ^= random_ >> 17U;
    random_ ^= random_ << 5U;
    return random_;
  }

  std::array<std::uint8_t, kMaxMessageBytes> buffer_{};
  std::uint16_t size_ = 0;
  std::uint16_t id_ = mac::kNobody;
  std::uint16_t peer_ = mac::kNobody;
  Phase phase_ = Phase::kIdle;
  Event event_ = Event::kNone;
  std::uint8_t message_ = 0;    // number of the message in progress
  std::uint8_t fragments_ = 0;  // of the message
  std::uint8_t have_ = 0;       // fragments received or acknowledged, one bit each
  std::uint8_t next_ = 0;       // next fragment of this round
  std::uint8_t hops_ = 0;
  std::uint8_t tries_ = 0;
  std::uint8_t wait_ = 0;    // open slots
  bool round_over_ = false;  // and an acknowledgement was requested
  bool acknowledge_ = false;
  std::uint8_t idle_ = 0;      // open slots since the peer was heard; saturates
  std::uint8_t silent_s_ = 0;  // seconds without an open slot
  std::uint8_t sent_ = 0;      // frames sent
  std::uint8_t asked_number_ = 0;
  std::uint16_t asked_target_ = mac::kNobody;
  std::uint32_t request_id_ = 0;
  std::uint32_t random_ = 1;
  std::array<Heard, 2> heard_{};  // last commands of two origins

  bool passes_on_ = false;
  std::uint8_t passing_ = 0;  // remaining transmissions
  std::uint8_t passing_wait_ = 0;
  std::uint8_t next_seen_ = 0;
  std::array<std::uint32_t, 8> seen_{};
  Data passed_;
};

}  // namespace groma::node
