// A link that is reopened, at growing intervals, after it was lost. It reads no clock.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <string>

#include "host/link/byte_link.hpp"

namespace groma::link {

struct LinkCounters {
  std::uint32_t opened = 0;
  std::uint32_t lost = 0;
  std::uint32_t attempts_failed = 0;
};

class ReconnectingLink {
 public:
  using Opener = std::function<OpenedLink()>;

  // The wait between attempts doubles from the first to the longest; received bytes reset it to the first.
  static constexpr double kFirstWait_s = 0.1;
  static constexpr double kLongestWait_s = 3.0;
  static constexpr double kPendingWait_s = 0.02;  // while a connection is under way

  explicit ReconnectingLink(Opener open) : open_(std::move(open)) {}

  // Opens the link if it is closed and an attempt is due. True: this call opened it.
  bool service(double now_s);

  // Reads from the link if it is open. A link that is gone is closed, counted and scheduled for reopening.
  [[nodiscard]] ReadResult read(std::span<std::uint8_t> out, double now_s);

  // The open link, or null.
  [[nodiscard]] ByteLink* get() const noexcept { return link_.get(); }

  // Time of the next attempt; meaningless while the link is open.
  [[nodiscard]] double next_attempt_s() const noexcept { return next_attempt_s_; }

  // The error of the last failed attempt; none while the link is open.
  [[nodiscard]] const LinkError& last_error() const noexcept { return last_error_; }
  [[nodiscard]] const LinkCounters& counters() const noexcept { return counters_; }
  // Of a link over CAN, over all reopenings; nothing for others.
  [[nodiscard]] std::optional<CanCounters> can_counters() const;

 private:
  Opener open_;
  std::unique_ptr<ByteLink> link_;
  double next_attempt_s_ = 0.0;
  double wait_s_ = kFirstWait_s;
  LinkError last_error_;
  LinkCounters counters_;
  std::optional<CanCounters> can_before_;  // of earlier links
};

}  // namespace groma::link
