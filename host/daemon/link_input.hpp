// A link on the event loop: opened again after it was lost, and read as soon as it has bytes.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <string_view>

#include "host/daemon/event_loop.hpp"
#include "host/link/reconnecting_link.hpp"

namespace groma::daemon {

class LinkInput {
 public:
  // Bytes that arrived at now_s, at most kReadSize.
  using OnBytes = std::function<void(std::span<const std::uint8_t> bytes, double now_s)>;
  using Log = std::function<void(std::string_view)>;
  static constexpr std::size_t kReadSize = 4096;

  struct Setup {
    std::string name;
    link::ReconnectingLink::Opener open;
    OnBytes on_bytes;
    // Each time that it was opened; again: after it was lost.
    std::function<void(bool again)> on_opened;
    Log log;
  };

  // The loop has to outlive the input.
  LinkInput(EventLoop& loop, Setup setup);

  // The first attempt; returns its error, unless the cause may vanish by itself: then service() goes on.
  [[nodiscard]] link::LinkError open();
  // Opens the link when that is due, and logs its events. Call it at each tick.
  void service();

  // The open link, or null.
  [[nodiscard]] link::ByteLink* link() const noexcept { return link_.get(); }
  [[nodiscard]] const std::string& name() const noexcept { return setup_.name; }
  [[nodiscard]] const link::LinkCounters& counters() const noexcept { return link_.counters(); }
  // As of ReconnectingLink.
  [[nodiscard]] const link::LinkError& last_error() const noexcept { return link_.last_error(); }
  [[nodiscard]] std::optional<link::CanCounters> can_counters() const { return link_.can_counters(); }

 private:
  static constexpr int kReadsPerTurn = 16;  // so that no link delays the others

  void opened(bool again);
  void read();
  void log_news();

  EventLoop& loop_;
  Setup setup_;
  link::ReconnectingLink link_;
  std::optional<EventLoop::Watch> watch_;  // while it is open
  bool has_more_ = false;                  // read() left bytes that the link may hold itself
  std::string logged_error_;               // the last one
};

}  // namespace groma::daemon
