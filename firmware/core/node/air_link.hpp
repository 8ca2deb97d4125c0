// Messages of the host link's protocol over the air: a command from the wired node to another one, and the
// answer back. One message is under way at a time.
//
// A message is cut into DATA frames (mac/frame.hpp), sent in open shared slots. The last one of a round asks
// for an acknowledgement, which tells all that came; what is missing goes out again. The answer acknowledges
// the command. Where nothing comes back the frames are sent with more hops to go: the nodes that relay the
// beacon pass each on once, in their own turns of the shared slot.
//
// A command is carried out once: its number tells one that comes again, which is answered by the answer that
// was given. What nobody acknowledges within kMaxTries is reported as lost.
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
  // Rounds in a row without a sign of the other one. Two hops at 30 % loss each fail so often in 0.1 %.
  static constexpr std::uint8_t kMaxTries = 24;

  // After boot and with each configuration. `passes_on`: this node relays the beacon. `seed`: another at each
  // node and each boot.
  void start(std::uint16_t id, bool passes_on, std::uint32_t seed) noexcept;

  enum class Event : std::uint8_t {
    kNone,
    kCommand,    // in message(); to be answered
    kAnswer,     // to what was asked, in message()
    kNoAnswer,   // to what was asked
    kDelivered,  // the answer that was given
    kUndelivered,
  };
  // What has happened since the last call.
  [[nodiscard]] Event take_event() noexcept { return std::exchange(event_, Event::kNone); }
  [[nodiscard]] std::span<const std::uint8_t> message() const noexcept {
    return std::span(buffer_).first(size_);
  }
  // Who asks, or is asked.
  [[nodiscard]] std::uint16_t peer() const noexcept { return peer_; }

  // ---- the wired node ------------------------------------------------------------------------------------

  enum class Asked : std::uint8_t { kUnderWay, kBusy, kTooLong };
  // A request that is asked again gets the answer that it had, or goes on.
  [[nodiscard]] Asked ask(std::uint16_t target, std::uint32_t request_id,
                          std::span<const std::uint8_t> command) noexcept;
  [[nodiscard]] bool asking() const noexcept {
    return phase_ == Phase::kAsking || phase_ == Phase::kAwaiting;
  }
  [[nodiscard]] std::uint32_t request_id() const noexcept { return request_id_; }
  // About each second: a node without open slots, for it is out of step, gives up after a while.
  void on_second() noexcept;

  // ---- the asked one -------------------------------------------------------------------------------------

  // After kCommand. An answer is made of messages, one after the other, each behind its length (2 bytes,
  // little-endian).
  void begin_answer() noexcept { size_ = 0; }
  // While the command is carried out: kMaxMessageBytes of the carrier's own, until it begins to answer.
  [[nodiscard]] std::span<std::uint8_t> scratch() noexcept { return buffer_; }
  // Room for the next message.
  [[nodiscard]] std::span<std::uint8_t> room() noexcept;
  // So many bytes of room() are one.
  void append(std::size_t size) noexcept;
  void send_answer() noexcept;
  // The next message of an answer, and the rest; nothing where it ends.
  [[nodiscard]] static std::optional<std::span<const std::uint8_t>> next_message(
      std::span<const std::uint8_t>& answer) noexcept;

  // ---- the station's -------------------------------------------------------------------------------------

  [[nodiscard]] std::optional<Outgoing> open_slot(std::uint32_t number) noexcept override;
  [[nodiscard]] std::optional<Outgoing> own_turn(std::uint32_t number) noexcept override;
  [[nodiscard]] bool wants_slot() const noexcept override {
    return acknowledge_ || passing_ != 0 || phase_ == Phase::kAsking || phase_ == Phase::kAwaiting ||
           phase_ == Phase::kAnswering;
  }
  void on_sent(std::uint32_t /*number*/, bool /*sent*/) noexcept override {}
  void on_control(const mac::Frame& frame, std::uint32_t number, bool leading) noexcept override;
  void on_beacon(const mac::Frame& /*frame*/, const mac::Beacon& /*beacon*/) noexcept override {}
  void on_beacon_out(mac::Beacon& /*beacon*/, bool /*leading*/) noexcept override {}

 private:
  enum class Phase : std::uint8_t {
    kIdle,
    kAsking,     // the command goes out
    kAwaiting,   // it has arrived; the answer comes in
    kHave,       // the answer is there
    kTaking,     // a command comes in
    kTaken,      // it is there
    kAnswering,  // the answer goes out
    kAnswered,   // it has arrived, or was given up
  };
  struct Heard {
    std::uint16_t origin = mac::kNobody;
    std::uint8_t message = 0;
  };

  [[nodiscard]] std::optional<mac::Data> next() noexcept;
  [[nodiscard]] std::optional<mac::Data> next_fragment() noexcept;
  [[nodiscard]] mac::Data fragment(std::uint8_t index, bool asks) noexcept;
  [[nodiscard]] mac::Data acknowledgement() noexcept;
  void take_command(const mac::Data& data, bool direct) noexcept;
  void take_answer(const mac::Data& data) noexcept;
  void take_acknowledgement(const mac::Data& data) noexcept;
  // True: that was the last one missing.
  bool store(const mac::Data& data) noexcept;
  [[nodiscard]] bool stale(const mac::Data& data) const noexcept;
  void begin_sending(Phase phase) noexcept;
  // False where it was one too many.
  bool try_again() noexcept;
  void pass_on(const mac::Data& data) noexcept;

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
  std::uint8_t message_ = 0;    // the number of the one under way
  std::uint8_t fragments_ = 0;  // of it
  std::uint8_t have_ = 0;       // those that arrived, a bit each
  std::uint8_t next_ = 0;       // to be sent in this round
  std::uint8_t hops_ = 0;
  std::uint8_t tries_ = 0;
  std::uint8_t wait_ = 0;    // open slots
  bool round_over_ = false;  // and an acknowledgement asked for
  bool acknowledge_ = false;
  std::uint8_t idle_ = 0;      // open slots since the peer was heard; saturates
  std::uint8_t silent_s_ = 0;  // without an open slot
  std::uint8_t sent_ = 0;      // frames
  std::uint8_t asked_number_ = 0;
  std::uint16_t asked_target_ = mac::kNobody;
  std::uint32_t request_id_ = 0;
  std::uint32_t random_ = 1;
  std::array<Heard, 2> heard_{};  // the last commands begun, of two origins

  bool passes_on_ = false;
  bool leading_ = false;
  std::uint8_t passing_ = 0;  // how often it is still to be sent
  std::uint8_t passing_wait_ = 0;
  std::uint8_t next_seen_ = 0;
  std::array<std::uint32_t, 8> seen_{};
  mac::Data passed_;
};

}  // namespace groma::node
