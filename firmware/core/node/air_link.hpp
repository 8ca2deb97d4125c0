// Transport of the host link's messages over the air: a command from the wired node to another one, and the
// answer back. Only one message is in progress at a time.
//
// docs/reference/air.md specifies fragments, rounds, acknowledgements and relays. A message that is not
// acknowledged within kMaxTries is reported as undelivered.
#pragma once

#include <array>
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
  void start(std::uint16_t id, bool passes_on, std::uint32_t seed) noexcept;

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
                          std::span<const std::uint8_t> command) noexcept;
  [[nodiscard]] bool asking() const noexcept {
    return phase_ == Phase::kAsking || phase_ == Phase::kAwaiting;
  }
  [[nodiscard]] std::uint32_t request_id() const noexcept { return request_id_; }
  // Call about each second: a node without open slots, because it is not synchronized, gives up after a
  // while.
  void on_second() noexcept;

  // ---- the addressed node ---------------------------------------------------------------------------------

  // Call after kCommand. An answer consists of messages, each after its length (2 bytes, little-endian).
  void begin_answer() noexcept { size_ = 0; }
  // The free space for the next message.
  [[nodiscard]] std::span<std::uint8_t> room() noexcept;
  // Adds the first `size` bytes of room() as a message.
  void append(std::size_t size) noexcept;
  void send_answer() noexcept { begin_sending(Phase::kAnswering); }
  // Removes the next message from `answer` and returns it; nothing at the end.
  [[nodiscard]] static std::optional<std::span<const std::uint8_t>> next_message(
      std::span<const std::uint8_t>& answer) noexcept;

  // ---- mac::ControlChannel, called by the station --------------------------------------------------------

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override;
  [[nodiscard]] std::optional<Outgoing> own_turn(std::uint32_t number) noexcept override;
  [[nodiscard]] bool wants_slot() const noexcept override {
    return acknowledge_ || passing_ != 0 || asking() || phase_ == Phase::kAnswering;
  }
  void on_control(const mac::Frame& frame, std::uint32_t number, bool leading) noexcept override;

 private:
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

  [[nodiscard]] std::optional<Outgoing> next_fragment() noexcept;
  [[nodiscard]] mac::Data fragment(std::uint8_t index, bool asks) noexcept;
  [[nodiscard]] mac::Data acknowledgement() noexcept;
  void take_command(const mac::Data& data, bool direct) noexcept;
  void take_answer(const mac::Data& data) noexcept;
  void take_acknowledgement(const mac::Data& data) noexcept;
  // Returns true if this completed the message.
  bool store(const mac::Data& data) noexcept;
  [[nodiscard]] bool stale(const mac::Data& data) const noexcept;
  void begin_sending(Phase phase) noexcept;
  // Returns false if the number of tries is used up.
  bool try_again() noexcept;
  void pass_on(const mac::Data& data, bool leading) noexcept;

  [[nodiscard]] bool asked() const noexcept { return phase_ >= Phase::kTaking; }
  [[nodiscard]] std::uint8_t all() const noexcept {
    return static_cast<std::uint8_t>((1U << fragments_) - 1U);
  }
  [[nodiscard]] std::uint8_t last_missing() const noexcept;
  [[nodiscard]] std::uint8_t reply_wait() noexcept;
  [[nodiscard]] std::uint32_t random() noexcept;

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
  mac::Data passed_;
};

}  // namespace groma::node
