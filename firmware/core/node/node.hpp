// A node: the radio, the tag or anchor that uses it, and the link to the host.
//
// After each radio interrupt the node takes the event, lets the state machine decide, and arms the radio for
// the next action. After that it reports a completed exchange, in steps that fit into the time in which the
// radio does not need the processor (on_timer()).
//
//   radio_executor.hpp   runs the tag or the anchor on the radio
//   reporter.hpp         messages to the host
//   participation.hpp    a place in the network: joined, kept over failures of the radio, given up
//   configuration.hpp    stored, in force, on trial
//   command_handler.hpp  commands, wherever they come from
//   remote_commands.hpp  commands over the air
#pragma once

#include <algorithm>
#include <cstdint>
#include <span>

#include "firmware/core/node/command_handler.hpp"
#include "firmware/core/node/configuration.hpp"
#include "firmware/core/node/participation.hpp"
#include "firmware/core/node/radio_executor.hpp"
#include "firmware/core/node/remote_commands.hpp"
#include "firmware/core/node/reporter.hpp"
#include "groma.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::node {

template <Platform P>
class Node {
 public:
  // Keeps a reference to the platform; the string build.version outlives the node.
  Node(P& platform, const Build& build) noexcept
      : shared_{platform}, radio_(shared_, reports_), reports_(shared_, radio_, build) {}

  // Call once after boot: loads the configuration, brings the radio up, sends a hello, and joins the network
  // if configured.
  void start() noexcept {
    telemetry_due_us_ = next_telemetry_us_ = shared_.platform.now_us() + kTelemetryPeriod_us;
    configuration_.apply(Configuration<P>::kUsualTrial_s);
    network_.show_state();
  }

  // Call while the radio's interrupt line is high, until it is low.
  void on_radio_interrupt() noexcept {
    if (!network_.on_interrupt(shared_.platform.radio_interrupt_us())) return;
    remote_.serve();
    radio_.sample_ambient();
    network_.show_state();
  }

  // Bytes from the host, split in any way.
  void on_link_bytes(std::span<const std::uint8_t> bytes) noexcept {
    for (const std::uint8_t byte : bytes) {
      if (decoder_.push(byte)) on_command(decoder_.payload());
      const wire::FrameCounters& seen = decoder_.counters();
      shared_.counters.link_frames_bad = undecodable_ + seen.crc_errors + seen.version_errors +
                                         seen.oversize + seen.cobs_errors + seen.truncated;
    }
    network_.show_state();
  }

  // On the clock of now_us(); the maximum: never.
  [[nodiscard]] std::uint64_t next_deadline_us() const noexcept {
    return std::min({network_.next_deadline_us(), next_telemetry_us_, reports_.report_due_us()});
  }

  // Call at or after next_deadline_us(); earlier calls are harmless.
  void on_timer() noexcept {
    const std::uint64_t now_us = shared_.platform.now_us();
    network_.on_timer(now_us);
    if (reports_.is_reporting()) {
      reports_.continue_report(now_us);
    } else if (now_us >= next_telemetry_us_) {
      if (radio_.has_idle_time(now_us, kTelemetry_us) ||
          now_us >= telemetry_due_us_ + kTelemetryPatience_us) {
        send_telemetry(now_us);
      } else {
        next_telemetry_us_ = now_us + kTelemetryRetry_us;
      }
    }
    network_.show_state();
  }

  // Until this time, on the clock of now_us(), the radio does not need the processor, so other work may run.
  // 0: the radio may need it at any time; the maximum: timing does not matter.
  [[nodiscard]] std::uint64_t quiet_until_us() const noexcept { return radio_.quiet_until_us(); }

  [[nodiscard]] const groma_Counters& counters() const noexcept { return shared_.counters; }

 private:
  static constexpr std::uint64_t kTelemetryPeriod_us = 1'000'000;
  // Each part of the telemetry waits for this much idle time, up to kTelemetryPatience_us.
  static constexpr std::uint64_t kTelemetry_us = 1'300;
  static constexpr std::uint64_t kTelemetryRetry_us = 250;
  static constexpr std::uint64_t kTelemetryPatience_us = 100'000;

  void on_command(std::span<const std::uint8_t> payload) noexcept {
    if (!commands_.read(payload)) {
      ++undecodable_;
      return;
    }
    const groma_HostToNode& command = commands_.command();
    const ReplyContext to = ReplyContext::link(command.request_id);
    if (command.target_id == 0 || (shared_.config && command.target_id == shared_.config->id)) {
      commands_.finish(commands_.carry_out(to));
    } else {
      reports_.answer(to, remote_.ask(command, payload, network_.in_step()));
    }
  }

  // The status and the counters in turn: idle times are too short for both.
  void send_telemetry(std::uint64_t now_us) noexcept {
    next_telemetry_us_ = now_us;
    if (counters_next_) {
      reports_.send_counters();
      reports_.warn_if_late();
      next_telemetry_us_ += kTelemetryPeriod_us;
    } else {
      radio_.compare_clocks();
      reports_.send_status();
      remote_.on_second(now_us);
      configuration_.on_second(now_us);
    }
    telemetry_due_us_ = next_telemetry_us_;
    counters_next_ = !counters_next_;
  }

  Shared<P> shared_;
  RadioExecutor<P> radio_;
  Reporter<P> reports_;
  Participation<P> network_{shared_, radio_, reports_};
  Configuration<P> configuration_{shared_, reports_, network_};
  CommandHandler<P> commands_{shared_, radio_, reports_, network_, configuration_};
  RemoteCommands<P> remote_{shared_, reports_, configuration_, commands_};

  wire::FrameDecoder decoder_;
  std::uint32_t undecodable_ = 0;  // whole frames from the host that contained no command
  std::uint64_t next_telemetry_us_ = kNever_us;
  std::uint64_t telemetry_due_us_ = kNever_us;
  bool counters_next_ = false;  // the next part of the telemetry
};

}  // namespace groma::node
