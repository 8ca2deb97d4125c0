// A node's link to its host over CAN: splits frames of frame_codec.hpp into CAN payloads, and passes on the
// bytes received from the host.
//
// The platform runs it in steps while the radio does not need the processor; each step moves at most one CAN
// frame, in or out. The cost of steps differs, and short ones fit between two frames on the air: see
// step_us().
//
// docs/explanation/can.md has what happens on errors of the bus.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <span>

#include "firmware/core/mcp2518fd/driver.hpp"
#include "groma.pb.h"
#include "proto/can_segment.hpp"
#include "proto/frame_codec.hpp"

namespace groma::node {

struct CanLinkCounters {
  std::uint32_t frames_sent = 0;  // handed to the controller
  std::uint32_t frames_received = 0;
  std::uint32_t receive_overruns = 0;
  std::uint32_t bus_offs = 0;
  std::uint32_t restarts = 0;  // the controller had lost its settings and was brought up again
  mcp2518fd::ErrorCounters errors{};
};

template <mcp2518fd::Spi S>
class CanLink {
 public:
  // Holds the largest frame, a report of 16 ranges with raw timestamps; or four without, or eight compact
  // ones.
  static constexpr std::size_t kQueueBytes = 1536;
  static_assert(kQueueBytes >= wire::max_encoded_size(groma_NodeToHost_size));

  explicit constexpr CanLink(S& spi) noexcept : chip_(spi) {}

  // Brings the controller up with an empty queue, as Mcp2518fd::bring_up(). If that fails, retries
  // periodically, unless the bit rate is impossible.
  template <class Delay>
  mcp2518fd::BringUp start(const mcp2518fd::Settings& settings, std::uint64_t now_us,
                           Delay&& delay_us) noexcept {
    settings_ = settings;
    begin_ = size_ = 0;
    blocked_ = false;
    resume_at_us_ = 0;
    back_off_us_ = kShortestBackOff_us;
    const auto result = chip_.bring_up(settings, delay_us);
    wanted_ = result != mcp2518fd::BringUp::kNoBitRate;
    next_check_us_ = now_us + (result == mcp2518fd::BringUp::kOk ? kCheckPeriod_us : kRetryPeriod_us);
    return result;
  }

  void stop() noexcept { wanted_ = false; }

  // Queues a whole frame, or nothing and returns false.
  bool write(std::span<const std::uint8_t> frame) noexcept {
    if (!up() || frame.size() > kQueueBytes - size_) return false;
    for (const std::uint8_t byte : frame) queue_[(begin_ + size_++) % kQueueBytes] = byte;
    return true;
  }

  // Runs one step. Call it when the controller pulls its line low (`interrupt`), when a frame was written,
  // and at next_deadline_us(); extra calls are harmless. `sink(bytes)` receives the bytes from the host;
  // `delay_us(n)` waits if the controller has to be brought up again. Returns true if there is more to do at
  // once.
  template <class Sink, class Delay>
  bool service(bool interrupt, std::uint64_t now_us, Sink&& sink, Delay&& delay_us) noexcept {
    if (!wanted_) return false;
    if (checks(interrupt, now_us)) {
      checked_ = true;
      const Poll seen = poll(interrupt, now_us, delay_us);
      if (seen == Poll::kDown) return false;
      if (seen == Poll::kReceived) receive(sink);
      // If the line stays low without a reported cause, leave it until the next check.
      return (interrupt && seen != Poll::kNothing) || has_to_send(now_us);
    }
    checked_ = false;
    return has_to_send(now_us) && (send_one() || interrupt);
  }

  // The longest time that service() would take now at 8 MHz. Classic CAN and CAN FD: 2 or 3 SPI transfers
  // with 31 or 87 bytes if it sends; 11 with 88 or 144 if it looks for events and may receive a frame.
  [[nodiscard]] std::uint32_t step_us(bool interrupt, std::uint64_t now_us) const noexcept {
    const bool fd = settings_.format == wire::CanFormat::kFd;
    if (checks(interrupt, now_us)) return fd ? kLongestStep_us : kLongestStep_us * 2 / 3;
    return fd ? kLongestStep_us / 2 : kLongestStep_us / 4;
  }

  // When service() has to be called without an interrupt; the maximum: never.
  [[nodiscard]] std::uint64_t next_deadline_us() const noexcept {
    if (!wanted_) return ~std::uint64_t{0};
    const bool held = size_ != 0 && !blocked_ && chip_.state() == mcp2518fd::State::kOnBus;
    return held ? std::min(next_check_us_, resume_at_us_) : next_check_us_;
  }

  // Started, and the controller answers; it may be bus-off.
  [[nodiscard]] bool up() const noexcept { return wanted_ && chip_.state() != mcp2518fd::State::kDown; }
  [[nodiscard]] bool started() const noexcept { return wanted_; }
  [[nodiscard]] bool empty() const noexcept { return size_ == 0; }
  [[nodiscard]] const mcp2518fd::Settings& settings() const noexcept { return settings_; }
  [[nodiscard]] const CanLinkCounters& counters() const noexcept { return counters_; }

 private:
  static constexpr std::uint32_t kLongestStep_us = 300;
  static constexpr std::uint64_t kCheckPeriod_us = 100'000;
  static constexpr std::uint64_t kShortestBackOff_us = 10'000;
  static constexpr std::uint64_t kLongestBackOff_us = 1'000'000;
  // A failing attempt blocks the processor for 10 ms or more.
  static constexpr std::uint64_t kRetryPeriod_us = 10'000'000;

  enum class Poll : std::uint8_t { kDown, kNothing, kSomething, kReceived };

  [[nodiscard]] bool has_to_send(std::uint64_t now_us) const noexcept {
    return size_ != 0 && !blocked_ && now_us >= resume_at_us_;
  }
  // The next step looks for events; otherwise it sends. They alternate if both are due.
  [[nodiscard]] bool checks(bool interrupt, std::uint64_t now_us) const noexcept {
    return (interrupt || now_us >= next_check_us_) && !(checked_ && has_to_send(now_us));
  }

  template <class Delay>
  Poll poll(bool interrupt, std::uint64_t now_us, Delay& delay_us) noexcept {
    if (chip_.state() == mcp2518fd::State::kDown) {
      return now_us < next_check_us_ ? Poll::kDown : restart(now_us, delay_us);
    }
    if (!interrupt) next_check_us_ = now_us + kCheckPeriod_us;
    const mcp2518fd::Events events = chip_.take_events();
    if (events.lost) return restart(now_us, delay_us);
    if (events.overrun) ++counters_.receive_overruns;
    if (events.bus_off) {
      ++counters_.bus_offs;
      const bool soon = now_us < resume_at_us_ + kLongestBackOff_us;
      back_off_us_ = soon ? std::min(2 * back_off_us_, kLongestBackOff_us) : kShortestBackOff_us;
      resume_at_us_ = now_us + back_off_us_;
    }
    // After any change the next frame checks whether there is room.
    if (events.room || events.bus_off || events.on_bus) blocked_ = false;
    if (!interrupt) counters_.errors = chip_.error_counters();
    if (events.received) return Poll::kReceived;
    return events.any ? Poll::kSomething : Poll::kNothing;
  }

  template <class Delay>
  Poll restart(std::uint64_t now_us, Delay& delay_us) noexcept {
    ++counters_.restarts;
    blocked_ = false;
    const bool success = chip_.bring_up(settings_, delay_us) == mcp2518fd::BringUp::kOk;
    next_check_us_ = now_us + (success ? kCheckPeriod_us : kRetryPeriod_us);
    return success ? Poll::kNothing : Poll::kDown;
  }

  template <class Sink>
  void receive(Sink& sink) noexcept {
    wire::CanFrame frame;
    if (!chip_.receive(frame)) return;
    ++counters_.frames_received;
    sink(wire::stream_in(frame, {wire::CanDirection::kToNode, settings_.node}));
  }

  bool send_one() noexcept {
    std::array<std::uint8_t, wire::kMaxFdPayload> head{};
    const std::size_t available = std::min(size_, head.size());
    for (std::size_t i = 0; i < available; ++i) head[i] = queue_[(begin_ + i) % kQueueBytes];
    wire::CanFrame frame;
    frame.id = wire::can_id({wire::CanDirection::kToHost, settings_.node});
    const std::size_t taken =
        wire::cut_can_payload(std::span(head).first(available), settings_.format, frame);
    if (!chip_.send(frame)) {
      blocked_ = true;
      return false;
    }
    ++counters_.frames_sent;
    begin_ = (begin_ + taken) % kQueueBytes;
    size_ -= taken;
    return size_ != 0;
  }

  mcp2518fd::Mcp2518fd<S> chip_;
  mcp2518fd::Settings settings_;
  CanLinkCounters counters_;
  std::array<std::uint8_t, kQueueBytes> queue_{};
  std::size_t begin_ = 0;
  std::size_t size_ = 0;
  bool wanted_ = false;
  bool blocked_ = false;  // the controller had no room; an event reports when it has
  bool checked_ = false;  // the last step looked for events
  std::uint64_t resume_at_us_ = 0;
  std::uint64_t back_off_us_ = kShortestBackOff_us;
  std::uint64_t next_check_us_ = 0;
};

}  // namespace groma::node
