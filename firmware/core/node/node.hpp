// A node: the radio driver, the tag or anchor that uses it, and the link to the host.
//
// After each radio interrupt the node takes the event, lets the state machine decide, and arms the radio for
// the next action. After that it evaluates and reports a completed exchange, in steps that fit into the time
// in which the radio does not need the processor (on_timer()). The slots depend on the DW1000's clock only.
// The processor's clock times the telemetry and a deadline for each operation of the radio. If the interrupt
// does not come by then, the node restarts the chip and continues in its place in the network: the same time,
// master and slot. Only if that fails twice in a row it joins again.
//
// An unconfigured node sends nothing. It listens for 20 ms each second, to prove that radio, bus, interrupt
// and loop are alive (platform.hpp, proof_of_life()).
#pragma once

#include <pb_decode.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <utility>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/node/air_link.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/core/node/machine.hpp"
#include "firmware/core/node/messages.hpp"
#include "firmware/core/node/platform.hpp"
#include "firmware/core/node/slack.hpp"
#include "firmware/core/node/stored_config.hpp"
#include "firmware/core/node/survey.hpp"
#include "firmware/core/node/trial.hpp"
#include "groma.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::node {

template <Platform P>
class Node {
 public:
  // Keeps a reference to the platform; the string build.version outlives the node.
  Node(P& platform, const Build& build) noexcept
      : platform_(platform), build_(build), radio_(platform.spi()), stored_(platform) {}

  // Call once after boot: loads the configuration, brings the radio up, sends a hello, and joins the network
  // if configured.
  void start() noexcept {
    platform_.set_indicator(Indicator::kUnconfigured);
    telemetry_due_us_ = next_telemetry_us_ = platform_.now_us() + kTelemetryPeriod_us;
    const auto stored = stored_.load();
    config_ = stored.config;
    if (stored.on_trial) trial_.begin(platform_.now_us(), Trial::kUsual_s);
    choose_link();
    bring_radio_up();
    send_hello();
  }

  // Call while the radio's interrupt line is high, until it is low.
  void on_radio_interrupt() noexcept {
    if (!handle_event(platform_.radio_interrupt_us())) return;
    serve_air();
    sample_ambient();
    prove_life();
  }

  // Bytes from the host, split in any way.
  void on_link_bytes(std::span<const std::uint8_t> bytes) noexcept {
    for (const std::uint8_t byte : bytes) {
      const bool complete = decoder_.push(byte);
      const wire::FrameCounters& seen = decoder_.counters();
      counters_.link_frames_bad = undecodable_ + seen.crc_errors + seen.version_errors + seen.oversize +
                                  seen.cobs_errors + seen.truncated;
      if (complete) on_command(decoder_.payload());
    }
  }

  // On the clock of now_us(); the maximum: never.
  [[nodiscard]] std::uint64_t next_deadline_us() const noexcept {
    const std::uint64_t piece_us = completed_ != nullptr ? next_piece_us_ : kNever_us;
    const std::uint64_t radio_us = failed_ ? 0 : radio_deadline_us_;
    return std::min(
        {radio_us, launch_us_, next_listening_us_, next_telemetry_us_, identify_until_us_, piece_us});
  }

  // Call at or after next_deadline_us(); earlier calls are harmless.
  void on_timer() noexcept {
    const std::uint64_t now_us = platform_.now_us();
    if (now_us >= launch_us_) launch();
    if (failed_ || now_us >= radio_deadline_us_) on_radio_deadline();
    if (now_us >= next_listening_us_) listen_unconfigured();
    if (now_us >= identify_until_us_) {
      identify_until_us_ = kNever_us;
      indicate();
    }
    if (completed_ != nullptr) {
      if (now_us >= next_piece_us_)
        next_piece_us_ = has_idle_time(now_us, kPiece_us) ? report_piece() : now_us + kPiece_us;
    } else if (now_us >= next_telemetry_us_) {
      if (has_idle_time(now_us, kTelemetry_us) || now_us >= telemetry_due_us_ + kTelemetryPatience_us) {
        send_telemetry(now_us);
      } else {
        next_telemetry_us_ = now_us + kTelemetryRetry_us;
      }
    }
  }

  // Until this time, on the clock of now_us(), the radio does not need the processor, so other work may run.
  // 0: the radio may need it at any time; the maximum: timing does not matter.
  [[nodiscard]] std::uint64_t quiet_until_us() const noexcept {
    if (!machine_.in_step()) return kNever_us;
    return event_due_us_ != 0 ? event_due_us_ : quiet_until_us_;
  }

  [[nodiscard]] const groma_Counters& counters() const noexcept { return counters_; }

 private:
  static constexpr std::uint64_t kNever_us = std::numeric_limits<std::uint64_t>::max();
  static constexpr std::uint64_t kTelemetryPeriod_us = 1'000'000;
  // Each part of the telemetry waits for this much idle time, up to kTelemetryPatience_us.
  static constexpr std::uint64_t kTelemetry_us = 1'300;
  static constexpr std::uint64_t kTelemetryRetry_us = 250;
  static constexpr std::uint64_t kTelemetryPatience_us = 100'000;
  // The longest step of a report.
  static constexpr std::uint64_t kPiece_us = 100;
  // A frame that is loaded early is launched so long before its preamble: enough for the longest step of a
  // report and the launch itself.
  static constexpr std::uint64_t kLaunchAhead_us = 200;
  // Time after its due end until an operation of the radio is aborted.
  static constexpr std::uint64_t kRadioGrace_us = 5'000;
  static constexpr std::uint64_t kBringUpRetry_us = 1'000'000;
  static constexpr std::uint64_t kUnconfiguredPeriod_us = 1'000'000;
  static constexpr ranging::Ticks kUnconfiguredListening = ranging::Ticks::from_us(20'000);
  static constexpr std::uint32_t kMaxIdentify_s = 3'600;
  static constexpr const char* kOffTheAir = "off the air to write flash";
  static constexpr std::uint64_t kLongestSurvey_us = 60'000'000;
  // After a survey that was not answered.
  static constexpr std::uint64_t kLentOn_us = 5'000'000;
  static constexpr std::uint64_t kAmbientPeriod_us = 1'000'000;
  // Processor time for each half of a sampling.
  static constexpr std::uint64_t kAmbientWork_us = 100;

  // ---- the radio -----------------------------------------------------------------------------------------

  // Resets and configures the radio. The machine, if there is one, continues.
  void bring_radio_up() noexcept {
    completed_ = nullptr;  // its report would read the radio's clock
    armed_.reset();
    launch_us_ = kNever_us;
    event_due_us_ = 0;
    next_listening_us_ = kNever_us;
    sampling_ = false;
    failed_ = false;
    const dw1000::RadioSettings settings = config_ ? radio_settings(*config_) : dw1000::RadioSettings{};
    bring_up_ = radio_.bring_up(
        settings, [this] { platform_.reset_radio(); }, [this](std::uint32_t us) { platform_.delay_us(us); });
    if (bring_up_ != dw1000::BringUp::kOk) {
      forget_machine();
      log(groma_LogLevel_LOG_ERROR, dw1000::describe(bring_up_));
      radio_deadline_us_ = platform_.now_us() + kBringUpRetry_us;
      indicate();
      return;
    }
    if (radio_.woken()) log(groma_LogLevel_LOG_INFO, "radio: woken from sleep");
    if (const char* text = radio_.warning(); text[0] != '\0') log(groma_LogLevel_LOG_WARNING, text);
    radio_deadline_us_ = kNever_us;
    if (continue_clock()) {
      machine_.on_clock_restart();
    } else {
      forget_machine();
    }
    resume();
  }

  // Joins the network from the beginning, with the configuration in force.
  void join() noexcept {
    next_listening_us_ = kNever_us;
    slack_.clear();
    if (bring_up_ != dw1000::BringUp::kOk) return indicate();
    if (!config_) {
      next_listening_us_ = platform_.now_us() + kUnconfiguredPeriod_us;
      return indicate();
    }
    mac::Site site = site_of(*config_, radio_.transmit_antenna_delay());
    site.boot_count = platform_.boot_count();
    site.on_trial = trial_.under_way();
    site.sessions = &sessions_;
    site.network_key = std::span(config_->network_key.bytes).first(config_->network_key.size);
    site.cipher = &platform_.cipher();
    site.nonces = &nonces_;
    site.signed_places = &signed_places_;
    site.lender = lender_;
    if (lender_ == mac::kNobody) site.lent_until_us = &lent_until_us_;
    if (config_->role == groma_Role_ROLE_TAG || lender_ != mac::kNobody) {
      machine_.become_tag(site, counters_);
    } else {
      machine_.become_anchor(site, counters_);
    }
    air_.start(site.id, mac::rank_of(*site.schedule, site.id).has_value(), platform_.boot_count());
    machine_.attach(air_);
    const ranging::ClockTime now = read_clock();
    perform(machine_.dispatch([now](auto& machine) { return machine.start(now); }));
    proven_superframe_ = machine_.superframe();
    indicate();
  }

  void listen_unconfigured() noexcept {
    next_listening_us_ = platform_.now_us() + kUnconfiguredPeriod_us;
    const ranging::ClockTime now = refer_now();
    if (radio_.receive_now(kUnconfiguredListening, std::nullopt) != dw1000::Start::kStarted) return recover();
    supervise({.kind = mac::Action::Kind::kListenNow, .until = now + kUnconfiguredListening});
  }

  // Call after an interrupt that reported an event.
  void prove_life() noexcept {
    if (machine_.in_step() && machine_.superframe() == proven_superframe_) return;
    proven_superframe_ = machine_.superframe();
    platform_.proof_of_life();
  }

  // Samples the chip's temperature and supply, in two halves with the chip's conversion time between. Each
  // half runs when the radio is armed for later, so it costs no slot.
  void sample_ambient() noexcept {
    const std::uint64_t now_us = platform_.now_us();
    const bool armed_soon = machine_.in_step() && now_us + kAmbientWork_us > quiet_until_us_;
    if (now_us < next_ambient_us_ || armed_soon) return;
    if (!sampling_) {
      radio_.start_sampling();
      next_ambient_us_ = now_us + radio_.kSampling_us + kAmbientWork_us;
    } else {
      ambient_ = radio_.finish_sampling();
      next_ambient_us_ = now_us + kAmbientPeriod_us;
      machine_.set_health(ambient_ ? health_of(*ambient_) : mac::Health{});
    }
    sampling_ = !sampling_;
  }

  // Goes off the air until resume(), join() or bring_radio_up().
  void leave() noexcept {
    radio_.stop();
    launch_us_ = kNever_us;
    event_due_us_ = 0;
    next_listening_us_ = kNever_us;
    if (bring_up_ == dw1000::BringUp::kOk) radio_deadline_us_ = kNever_us;
  }

  // Continues after leave(). The DW1000's clock has continued, so a master's beacons come when the other
  // nodes, which have coasted meanwhile, expect them.
  void resume() noexcept {
    if (machine_.station() == nullptr || bring_up_ != dw1000::BringUp::kOk) return join();
    const ranging::ClockTime now = refer_now();
    perform(machine_.dispatch([now](auto& machine) { return machine.resume(now); }));
    watch_sync();
  }

  void forget_machine() noexcept {
    machine_.forget();
    completed_ = nullptr;
    armed_.reset();
    launch_us_ = kNever_us;
    event_due_us_ = 0;
  }

  // `interrupt_us`: when the radio reported the event. Returns false if there was none.
  bool handle_event(std::uint64_t interrupt_us) noexcept {
    using dw1000::EventKind;
    dw1000::Event event = radio_.poll_event();
    if (event.kind != EventKind::kNone) failures_ = 0;
    switch (event.kind) {
      case EventKind::kNone:
        return false;
      case EventKind::kTransmitted: {
        const ranging::ClockTime timestamp = clock_.unwrap(event.timestamp);
        refer(timestamp + dw1000::Phy::after_rmarker(sent_bytes_), interrupt_us);
        perform(machine_.dispatch([&](auto& machine) { return machine.on_transmitted(timestamp); }));
        break;
      }
      case EventKind::kReceived: {
        ++counters_.frames_received;
        armed_.reset();
        // Reading a frame while the receiver is armed for the next one is fast, but unproven on hardware.
        if (arms_ahead()) arm_next_window();
        // The answer to a POLL is urgent, and a POLL's quality is not needed.
        radio_.read_frame(event, [this](std::span<const std::uint8_t> frame) {
          machine_.begin_verify(frame);
          return !mac::looks_like_poll(frame);
        });
        if (!arms_ahead()) arm_next_window();
        const ranging::ClockTime timestamp =
            event.timestamp_valid ? clock_.unwrap(event.timestamp) : refer_now();
        if (event.timestamp_valid) {
          refer(timestamp + dw1000::Phy::after_rmarker(event.frame.size() + dw1000::kFrameCheckBytes),
                interrupt_us);
        }
        if (machine_.station() == nullptr) ++counters_.foreign_frames;
        const mac::Reception reception{timestamp, event.timestamp_valid, event.frame, event.quality};
        perform(machine_.dispatch([&](auto& machine) { return machine.on_received(reception); }));
        break;
      }
      case EventKind::kPreambleTimeout:
      case EventKind::kSfdTimeout:
      case EventKind::kFrameTimeout:
      case EventKind::kCheckError:
      case EventKind::kHeaderError: {
        armed_.reset();
        arm_next_window();
        const bool error = count_failure(event.kind);
        const ranging::ClockTime now = refer_now();
        perform(machine_.dispatch(
            [&](auto& machine) { return error ? machine.on_error(now) : machine.on_timeout(now); }));
        break;
      }
    }
    precompute();
    watch_sync();
    return true;
  }

  // The radio is armed: precompute for the next frames.
  void precompute() noexcept {
    const std::size_t on_air_bytes = machine_.precompute();
    if (on_air_bytes != 0) radio_.expect_length(on_air_bytes - dw1000::kFrameCheckBytes);
  }

  [[nodiscard]] bool arms_ahead() const noexcept { return config_ && config_->schedule.arm_ahead; }

  // Time is short between two RESPONSEs: arms the next window before the machine evaluates the frame.
  void arm_next_window() noexcept {
    const std::optional<mac::Action> next = machine_.next_rx_window();
    if (!next) return;
    dw1000::Start start =
        radio_.receive_at(clock_.wrap(next->at), next->until - next->at, preamble_timeout(*next, next->at));
    if (start == dw1000::Start::kLate) {
      const ranging::ClockTime now = read_clock();
      if (now >= next->preamble_until.value_or(next->until)) return;
      ++counters_.late_receives;
      start = radio_.receive_now(next->until - now, preamble_timeout(*next, now));
    }
    armed_us_ = platform_.now_us();
    if (start == dw1000::Start::kStarted) armed_ = next->at;
  }

  // Returns true for a failed reception, false for a missing one.
  bool count_failure(dw1000::EventKind kind) noexcept {
    switch (kind) {
      case dw1000::EventKind::kPreambleTimeout:
        ++counters_.preamble_timeouts;
        return false;
      case dw1000::EventKind::kFrameTimeout:
        ++counters_.frame_timeouts;
        return false;
      case dw1000::EventKind::kSfdTimeout:
        ++counters_.sfd_timeouts;
        return true;
      case dw1000::EventKind::kCheckError:
        ++counters_.crc_errors;
        return true;
      default:
        ++counters_.header_errors;
        return true;
    }
  }

  // Arms the radio for the step's action. If the action is too late, informs the machine, which continues
  // with the next one. If all actions are too late, the chip is broken.
  void perform(mac::Step step) noexcept {
    constexpr int kTries = 100;
    // The most by which a beacon moves the next listening.
    constexpr ranging::Ticks kSame = ranging::Ticks::from_us(1);
    for (int i = 0; i < kTries; ++i) {
      if (step.completed != nullptr) {
        finish_report();
        completed_ = step.completed;
        ranges_left_ = completed_->count;
        reporting_ = Reporting::kChoosing;
        next_piece_us_ = 1;
      }
      const mac::Action& action = step.action;
      if (armed_) {
        const ranging::Ticks apart = action.at - *armed_;
        const bool same = action.kind == mac::Action::Kind::kListen && apart < kSame && -apart < kSame;
        armed_.reset();
        if (same) return supervise(action);
        radio_.stop();
      }
      dw1000::Start start = dw1000::Start::kStarted;
      switch (action.kind) {
        case mac::Action::Kind::kNone:
          radio_deadline_us_ = quiet_until_us_ = kNever_us;
          event_due_us_ = 0;
          return;
        case mac::Action::Kind::kTransmit:
          start = radio_.load(clock_.wrap(action.at), action.frame, [this] { machine_.finish_signing(); });
          if (start == dw1000::Start::kStarted) {
            if (const auto at_us = launch_time_us(action)) {
              armed_us_ = platform_.now_us();
              supervise(action);
              launch_us_ = quiet_until_us_ = event_due_us_ = *at_us;
              launching_ = action;
              return;
            }
            start = radio_.launch();
          }
          break;
        case mac::Action::Kind::kListen:
          start = radio_.receive_at(clock_.wrap(action.at), action.until - action.at,
                                    preamble_timeout(action, action.at));
          break;
        case mac::Action::Kind::kListenNow:
          start = dw1000::Start::kLate;
          break;
      }
      armed_us_ = platform_.now_us();
      if (start == dw1000::Start::kStarted) return supervise(action);
      if (start == dw1000::Start::kTooClose) {
        ++counters_.power_up_errors;
        start = dw1000::Start::kLate;
      }
      if (start != dw1000::Start::kLate) return recover();

      const ranging::ClockTime now = refer_now();
      slack_.add(action.slot, std::min<std::int32_t>(slack_us(action), -1));
      if (action.kind == mac::Action::Kind::kTransmit) {
        step = machine_.dispatch([&](auto& machine) { return machine.on_late(now); });
        continue;
      }
      if (action.kind == mac::Action::Kind::kListen) ++counters_.late_receives;
      if (now >= action.preamble_until.value_or(action.until)) {
        step = machine_.dispatch([&](auto& machine) { return machine.on_timeout(now); });
        continue;
      }
      if (radio_.receive_now(action.until - now, preamble_timeout(action, now)) != dw1000::Start::kStarted) {
        return recover();
      }
      return supervise(action);
    }
    recover();
  }

  [[nodiscard]] static std::optional<ranging::Ticks> preamble_timeout(const mac::Action& action,
                                                                      ranging::ClockTime from) noexcept {
    if (!action.preamble_until) return std::nullopt;
    return *action.preamble_until - from;
  }

  void supervise(const mac::Action& action) noexcept {
    if (action.kind != mac::Action::Kind::kListenNow) slack_.add(action.slot, slack_us(action));
    expect_event(action);
  }

  void expect_event(const mac::Action& action) noexcept {
    using Kind = mac::Action::Kind;
    if (action.kind == Kind::kTransmit) sent_bytes_ = action.frame.size() + dw1000::kFrameCheckBytes;
    const bool later = action.kind != Kind::kListenNow && action.at > reference_;
    quiet_until_us_ = later ? reference_us_ + rough_us(action.at - reference_) : 0;
    event_due_us_ = quiet_until_us_;
    if (later && action.kind == Kind::kListen) {
      // An event comes after the shortest frame, or when the preamble search ends.
      constexpr std::size_t kShortest_bytes = 12;
      const mac::Station* member = machine_.station();
      const ranging::Ticks until_out = action.preamble_until.value_or(action.until) - action.at;
      event_due_us_ += rough_us(
          member == nullptr ? until_out
                            : std::min(until_out, member->superframe().phy().air_time(kShortest_bytes)));
    }
    const ranging::ClockTime end = action.kind == Kind::kTransmit ? action.at : action.until;
    radio_deadline_us_ = reference_us_ + rough_us(end - reference_) + kRadioGrace_us;
  }

  // When to launch a loaded frame, so that its lead does not depend on its slot; nothing: now.
  [[nodiscard]] std::optional<std::uint64_t> launch_time_us(const mac::Action& action) const noexcept {
    const mac::Station* member = machine_.station();
    if (member == nullptr) return std::nullopt;
    const ranging::Ticks ahead = action.at - member->superframe().phy().before_rmarker() - reference_;
    const std::uint64_t start_us = reference_us_ + rough_us(ahead);
    if (start_us <= platform_.now_us() + kLaunchAhead_us) return std::nullopt;
    return start_us - kLaunchAhead_us;
  }

  void launch() noexcept {
    launch_us_ = kNever_us;
    const dw1000::Start start = radio_.launch();
    if (start == dw1000::Start::kStarted) return expect_event(launching_);
    if (start == dw1000::Start::kNotIdle) return recover();
    if (start == dw1000::Start::kTooClose) ++counters_.power_up_errors;
    slack_.add(launching_.slot, -1);
    const ranging::ClockTime now = refer_now();
    perform(machine_.dispatch([now](auto& machine) { return machine.on_late(now); }));
    precompute();
    watch_sync();
  }

  // At most 1 us too short, without 64-bit division: 65536 ticks are 40/39 us. 0 for times that have passed.
  [[nodiscard]] static std::uint64_t rough_us(ranging::Ticks t) noexcept {
    if (t.count() <= 0) return 0;
    const auto uus = static_cast<std::uint32_t>(t.count() >> 16);
    return std::uint64_t{uus} + uus / 39;
  }

  // How long before its deadline the action was armed, at armed_us_.
  [[nodiscard]] std::int32_t slack_us(const mac::Action& action) const noexcept {
    const mac::Station* member = machine_.station();
    if (member == nullptr) return 0;
    const bool sends = action.kind == mac::Action::Kind::kTransmit;
    const ranging::ClockTime deadline =
        sends ? action.at - member->superframe().phy().before_rmarker() : action.at;
    const ranging::Ticks left = deadline - reference_;
    const auto left_us =
        static_cast<std::int64_t>(rough_us(left)) - static_cast<std::int64_t>(rough_us(-left));
    return static_cast<std::int32_t>(left_us - static_cast<std::int64_t>(armed_us_ - reference_us_));
  }

  // The radio does not need the processor for this long.
  [[nodiscard]] bool has_idle_time(std::uint64_t now_us, std::uint64_t needed_us) const noexcept {
    return event_due_us_ == 0 || now_us + needed_us <= event_due_us_;
  }

  void on_radio_deadline() noexcept {
    if (bring_up_ != dw1000::BringUp::kOk) {
      bring_radio_up();
      if (bring_up_ == dw1000::BringUp::kOk) send_hello();
      return;
    }
    // Handle an event whose interrupt was lost like any other.
    if (!failed_ && handle_event(platform_.now_us())) return;
    recover();
    restart_radio();
  }

  // The radio did not answer as expected: on_timer() restarts it, as soon as possible.
  void recover() noexcept {
    if (failed_) return;
    failed_ = true;
    ++counters_.radio_recoveries;
  }

  // At the first failure checks the chip and continues. If the chip does not work, or at the second failure
  // in a row, resets it. At the third one also the machine starts again.
  void restart_radio() noexcept {
    ++failures_;
    const bool works = failures_ == 1 &&
                       radio_.restart([this](std::uint32_t us) { platform_.delay_us(us); }) &&
                       is_plausible(radio_.now());
    if (works) {
      log(groma_LogLevel_LOG_WARNING, "radio: no answer, started again");
      failed_ = false;
      armed_.reset();
      return resume();
    }
    if (failures_ > 2) forget_machine();
    completed_ = nullptr;
    log(groma_LogLevel_LOG_WARNING, "radio: no answer, brought up again");
    bring_radio_up();
  }

  // The radio's clock, or where it should be if the radio has failed.
  [[nodiscard]] ranging::ClockTime read_clock() noexcept {
    const ranging::DeviceTime counter = radio_.now();
    if (is_plausible(counter)) return clock_.unwrap(counter);
    recover();
    return expected_clock();
  }

  [[nodiscard]] bool is_plausible(ranging::DeviceTime counter) noexcept {
    constexpr ranging::Ticks kMostApart = ranging::Ticks::from_us(100'000);
    const ranging::Ticks apart = counter - clock_.wrap(expected_clock());
    return apart < kMostApart && -apart < kMostApart;
  }

  // The radio's clock by the processor's, to some ms.
  [[nodiscard]] ranging::ClockTime expected_clock() noexcept {
    constexpr std::int64_t kRoughlyPer_us = 63'898;
    return reference_ +
           kRoughlyPer_us * ranging::Ticks(static_cast<std::int64_t>(platform_.now_us() - reference_us_));
  }

  // Both clocks, read together.
  struct ClockPair {
    ranging::ClockTime radio;
    std::uint64_t us = 0;  // 0: never
  };
  [[nodiscard]] ClockPair read_clocks() noexcept {
    const std::uint64_t before_us = platform_.now_us();
    const ranging::ClockTime radio = read_clock();
    return {radio, (before_us + platform_.now_us()) / 2};
  }

  // The counter has restarted: continues the radio's clock by the processor's. Returns whether the error is
  // some us, which takes two pairs, about a second apart.
  bool continue_clock() noexcept {
    const std::uint64_t before_us = platform_.now_us();
    const ranging::DeviceTime counter = radio_.now();
    const std::uint64_t now_us = (before_us + platform_.now_us()) / 2;
    ranging::ClockTime now = reference_ + elapsed_ticks(now_us - reference_us_);
    const bool exact = former_pair_.us != 0;
    if (exact) {
      const std::uint64_t apart_us = pair_.us - former_pair_.us;
      const std::uint64_t since_us = now_us - pair_.us;
      const std::int64_t excess = (pair_.radio - former_pair_.radio - elapsed_ticks(apart_us)).count();
      now =
          pair_.radio + elapsed_ticks(since_us) +
          ranging::Ticks(excess * static_cast<std::int64_t>(since_us) / static_cast<std::int64_t>(apart_us));
    }
    clock_.restart(counter, std::max(now - clock_.latest(), ranging::Ticks(0)));
    refer(clock_.latest(), now_us);
    return exact;
  }

  [[nodiscard]] static ranging::Ticks elapsed_ticks(std::uint64_t us) noexcept {
    return ranging::Ticks::from_us(static_cast<std::int64_t>(us));
  }

  // Records that the radio's clock showed `then` at `at_us`.
  void refer(ranging::ClockTime then, std::uint64_t at_us) noexcept {
    reference_ = then;
    reference_us_ = at_us;
  }
  ranging::ClockTime refer_now() noexcept {
    const std::uint64_t now_us = platform_.now_us();
    refer(read_clock(), now_us);
    return reference_;
  }

  void watch_sync() noexcept {
    const mac::Station* member = machine_.station();
    if (member == nullptr) {
      sync_state_ = mac::SyncState::kSearching;
      return;
    }
    const mac::SyncState state = member->sync().state();
    if (state == sync_state_) return;
    const bool was_searching = sync_state_ == mac::SyncState::kSearching;
    sync_state_ = state;
    if (state == mac::SyncState::kSearching) {
      log(groma_LogLevel_LOG_WARNING, "beacons lost, searching");
    } else if (was_searching) {
      log(groma_LogLevel_LOG_INFO, "in step with the master");
    } else {
      return;
    }
    indicate();
  }

  void indicate() noexcept {
    if (identify_until_us_ != kNever_us) return;
    if (bring_up_ != dw1000::BringUp::kOk) {
      platform_.set_indicator(Indicator::kRadioFault);
    } else if (machine_.station() == nullptr) {
      platform_.set_indicator(Indicator::kUnconfigured);
    } else {
      platform_.set_indicator(machine_.in_step() ? Indicator::kRanging : Indicator::kSearching);
    }
  }

  // ---- to the host ---------------------------------------------------------------------------------------

  // kAsker: over the link on which the present command came.
  enum class To : std::uint8_t { kHost, kAsker };

  // Configures the link of the configuration in force, or the platform's default without one.
  void choose_link() noexcept {
    if constexpr (ChoosesLink<P>) {
      link_error_ = platform_.configure_link(config_.value_or(groma_Config groma_Config_init_zero));
    }
  }

  template <class Fill>
  void send(pb_size_t which, Fill&& fill, To to = To::kHost, const ReplyConfig& config = {}) noexcept {
    finish_report();
    message_ = groma_NodeToHost_init_zero;
    message_.which_body = which;
    fill(message_.body);
    if (!write_message(to, config)) ++counters_.reports_dropped;
  }

  bool write_message(To to, const ReplyConfig& config = {}) noexcept {
    if (to == To::kAsker && by_air_) {
      const std::size_t size = encode_message(message_, config, air_.room());
      if (size != 0) air_.append(size);
      return size != 0;
    }
    const auto frame = encoder_.encode(message_, config);
    return to == To::kAsker ? answer_link(frame) : platform_.link_write(frame);
  }

  bool answer_link(std::span<const std::uint8_t> frame) noexcept {
    if constexpr (ChoosesLink<P>) return platform_.link_answer(frame);
    return platform_.link_write(frame);
  }

  // Reports completed_ in steps of 50 us at 64 MHz, its ranges from the last to the first. Returns the time
  // of the next step.
  std::uint64_t report_piece() noexcept {
    groma_SlotReport& report = message_.body.slot_report;
    switch (reporting_) {
      case Reporting::kChoosing:
        if (machine_.tag()) machine_.tag()->choose_anchors();
        if (lender_ != mac::kNobody) {
          survey(*std::exchange(completed_, nullptr));
          break;
        }
        reporting_ = Reporting::kBegin;
        break;
      case Reporting::kBegin:
        message_ = groma_NodeToHost_init_zero;
        message_.which_body = groma_NodeToHost_slot_report_tag;
        report.sequence = report_sequence_++;
        report.tag_id = config_->id;
        report_time_ = read_clock();
        begin_slot_report(report, *completed_, report_time_);
        place_in_network(report, report_time_);
        encoder_.begin(report);
        reporting_ = Reporting::kRanges;
        break;
      case Reporting::kRanges:
        if (ranges_left_ != 0) {
          --ranges_left_;
          fill_range(report, ranges_left_, *completed_, report_time_, ranging(), counters_);
          if (config_->link != groma_Link_LINK_CAN) encoder_.put_range(report.ranges[ranges_left_]);
        } else if (config_->link == groma_Link_LINK_CAN) {
          make_compact(message_);
          completed_ = nullptr;
          if (!write_message(To::kHost)) ++counters_.reports_dropped;
        } else {
          encoder_.close(report);
          reporting_ = Reporting::kFraming;
        }
        break;
      case Reporting::kFraming:
        if (!encoder_.step()) break;
        completed_ = nullptr;
        if (!platform_.link_write(encoder_.frame())) ++counters_.reports_dropped;
        break;
    }
    return 1;
  }

  void finish_report() noexcept {
    while (completed_ != nullptr) report_piece();
  }

  [[nodiscard]] Ranging ranging() const noexcept {
    return {.raw_stamps = config_->report_raw_stamps,
            .correct_temperature = config_->correct_temperature,
            .correct_power_bias = config_->correct_power_bias,
            .ambient = ambient_};
  }

  void place_in_network(groma_SlotReport& report, ranging::ClockTime now) noexcept {
    const mac::Station* member = machine_.station();
    if (member == nullptr) return;
    const auto network_time = member->network_time(now);
    if (!network_time) return;
    report.network_time_dtu = static_cast<std::uint64_t>(network_time->count());
    report.network_rate_ppb = -member->sync().skew_ppb();
  }

  void send_hello(To to = To::kHost) noexcept {
    send(
        groma_NodeToHost_hello_tag,
        [&](auto& body) {
          fill_hello(body.hello, build_, config_, platform_.reset_reason(), platform_.last_fault(),
                     platform_.stack_use(), dw1000::describe(bring_up_));
          body.hello.boot_count = platform_.boot_count();
          copy_text(body.hello.link_error, link_error_);
          copy_text(body.hello.radio_warning, radio_.warning());
        },
        to);
  }

  void send_counters(To to = To::kHost) noexcept {
    if constexpr (ChoosesLink<P>) platform_.count_link(counters_);
    counters_.pll_flags = radio_.pll_flags();
    send(
        groma_NodeToHost_counters_tag, [&](auto& body) { body.counters = counters_; }, to);
  }

  void fill_membership(groma_NetworkStatus& status) const noexcept {
    if (const mac::Tag* tag = machine_.tag()) {
      const mac::TagMembership& membership = tag->membership();
      const auto slot = membership.slot(machine_.superframe());
      status.has_slot = slot.has_value();
      status.slot = static_cast<std::uint8_t>(slot.value_or(0));
      status.candidates = static_cast<std::uint32_t>(membership.anchors().size());
      status.answering = static_cast<std::uint32_t>(membership.anchors().answering());
    } else if (const mac::Anchor* anchor = machine_.anchor()) {
      const auto owners = anchor->membership().slots().owners();
      std::copy(owners.begin(), owners.end(), status.holders);
      status.holders_count = static_cast<pb_size_t>(owners.size());
    }
  }

  // The status and the counters in turn: idle times are too short for both.
  void send_telemetry(std::uint64_t now_us) noexcept {
    if (counters_next_) {
      send_counters();
      report_late();
      telemetry_due_us_ = next_telemetry_us_ = now_us + kTelemetryPeriod_us;
    } else {
      send_status();
      watch_air(now_us);
      telemetry_due_us_ = next_telemetry_us_ = now_us;
    }
    counters_next_ = !counters_next_;
  }

  void send_status() noexcept {
    // Reading the clock at least this often extends it over its wraps, even off the air.
    if (bring_up_ == dw1000::BringUp::kOk) {
      const ClockPair pair = read_clocks();
      if (!failed_) {
        former_pair_ = std::exchange(pair_, pair);
        refer(pair.radio, pair.us);
      }
    }
    if (const mac::Station* member = machine_.station()) {
      send(groma_NodeToHost_network_status_tag, [&](auto& body) {
        body.network_status.state = sync_state_of(member->sync().state());
        body.network_status.superframe = machine_.superframe();
        body.network_status.skew_ppb = -member->sync().skew_ppb();
        body.network_status.beacons_missed = member->sync().missed_in_a_row();
        body.network_status.has_temperature_cdegc = body.network_status.has_supply_mv = ambient_.has_value();
        if (ambient_) {
          body.network_status.temperature_cdegc = ambient_->temperature_cdegc;
          body.network_status.supply_mv = ambient_->supply_mv;
        }
        fill_membership(body.network_status);
        if (!machine_.in_step()) return;
        const mac::MasterElection& election = member->election();
        body.network_status.master_id = election.master();
        body.network_status.hop = election.hop();
        body.network_status.session = election.session();
        body.network_status.network_time_dtu =
            static_cast<std::uint64_t>(member->sync().network_time(clock_.latest()).count());
      });
    }
  }

  // Once for each period of seconds in which the schedule leaves this node too little time.
  void report_late() noexcept {
    constexpr std::uint32_t kMany = 10;
    const std::uint32_t late = counters_.late_transmits + counters_.late_receives;
    const bool many = late - late_before_ > kMany;
    if (many && !were_late_) {
      log(groma_LogLevel_LOG_WARNING, "late for the schedule: lengthen its turnaround or gap");
    }
    late_before_ = late;
    were_late_ = many;
  }

  void log(groma_LogLevel level, const char* text) noexcept {
    send(groma_NodeToHost_log_tag, [&](auto& body) {
      body.log.level = level;
      copy_text(body.log.text, text);
    });
  }

  // ---- from the host -------------------------------------------------------------------------------------

  // Decodes into command_; returns false if it is not a command.
  bool read_command(std::span<const std::uint8_t> payload) noexcept {
    command_ = groma_HostToNode_init_zero;
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    return pb_decode(&stream, groma_HostToNode_fields, &command_);
  }

  void on_command(std::span<const std::uint8_t> payload) noexcept {
    if (!read_command(payload)) {
      ++undecodable_;
      ++counters_.link_frames_bad;
      return;
    }
    by_air_ = false;
    if (command_.target_id != 0 && !(config_ && command_.target_id == config_->id))
      return ask_by_air(payload);
    carry_out();
  }

  void carry_out() noexcept {
    switch (command_.which_body) {
      case groma_HostToNode_get_hello_tag:
        reply(groma_Result_RESULT_OK, "");
        send_hello(To::kAsker);
        break;
      case groma_HostToNode_get_counters_tag:
        reply(groma_Result_RESULT_OK, "");
        send_counters(To::kAsker);
        break;
      case groma_HostToNode_get_slack_tag:
        reply(groma_Result_RESULT_OK, "");
        send(
            groma_NodeToHost_slack_tag, [&](auto& body) { slack_.fill(body.slack); }, To::kAsker);
        break;
      case groma_HostToNode_read_config_tag:
        read_config();
        break;
      case groma_HostToNode_write_config_tag:
        write_config(command_.body.write_config);
        break;
      case groma_HostToNode_apply_config_tag:
        apply_config();
        break;
      case groma_HostToNode_identify_s_tag:
        identify(command_.body.identify_s);
        break;
      case groma_HostToNode_prefer_anchors_tag:
        prefer_anchors(command_.body.prefer_anchors);
        break;
      case groma_HostToNode_leave_network_tag:
        if (machine_.tag() == nullptr) {
          refuse(groma_Result_RESULT_UNSUPPORTED, "only a tag has a slot to leave");
          break;
        }
        machine_.tag()->membership().leave();
        reply(groma_Result_RESULT_OK, "");
        break;
      case groma_HostToNode_reboot_tag:
        reply(groma_Result_RESULT_OK, "");
        after_ = After::kReboot;
        if (!by_air_) do_after();
        break;
      case groma_HostToNode_factory_reset_tag:
        factory_reset();
        break;
      case groma_HostToNode_survey_tag:
        begin_survey(command_.body.survey.exchanges);
        break;
      case groma_HostToNode_time_request_tag:
        send_time();
        break;
      default:
        refuse(groma_Result_RESULT_UNSUPPORTED, "not a command of this protocol version");
        break;
    }
  }

  void reply(groma_Result result, const char* text, const ReplyConfig& config = {}) noexcept {
    send(
        groma_NodeToHost_reply_tag,
        [&](auto& body) {
          body.reply.request_id = command_.request_id;
          body.reply.result = result;
          copy_text(body.reply.text, text);
        },
        To::kAsker, config);
  }

  void send_time() noexcept {
    if (bring_up_ != dw1000::BringUp::kOk) {
      return refuse(groma_Result_RESULT_UNSUPPORTED, "no clock: the radio is down");
    }
    const ranging::ClockTime received = read_clock();
    send(
        groma_NodeToHost_time_reply_tag,
        [&](auto& body) {
          body.time_reply.host_time_ns = command_.body.time_request.host_time_ns;
          body.time_reply.received_dtu = static_cast<std::uint64_t>(received.count());
          body.time_reply.transmitted_dtu = static_cast<std::uint64_t>(read_clock().count());
        },
        To::kAsker);
  }

  void refuse(groma_Result result, const char* text) noexcept {
    ++counters_.commands_refused;
    reply(result, text);
  }

  [[gnu::noinline]] void read_config() noexcept {
    const bool good = stored_.load().config.has_value();
    reply(groma_Result_RESULT_OK, "", good ? stored_.shown() : std::span<const std::uint8_t>());
  }

  // If the key is missing but its hash is there, inserts the node's present key if the hash matches.
  [[gnu::noinline]] void complete_key(groma_Config& config) noexcept {
    if (config.network_key.size != 0 || config.network_key_hash == 0) return;
    const auto stored = stored_.load();
    if (stored.config && stored.config->network_key_hash == config.network_key_hash)
      config.network_key = stored.config->network_key;
  }

  [[gnu::noinline]] void write_config(groma_Config& config) noexcept {
    if (by_air_ && config.network_key.size != 0) {
      return refuse(groma_Result_RESULT_INVALID, "network_key: not over the air, where anyone can read it");
    }
    complete_key(config);
    if (const char* fault = fault_of(config); fault[0] != '\0') {
      return refuse(groma_Result_RESULT_INVALID, fault);
    }
    // A configuration that came over the air may cut the node off, so the present one is stored with it.
    const bool trial = by_air_ && config_;
    if (keep(config, trial ? &*config_ : nullptr)) {
      trial_.end();
      read_config();
    } else {
      refuse(groma_Result_RESULT_STORAGE, "not stored: write it again");
    }
    resume();
  }

  // Leaves the air and logs it. Returns false as StoredConfig::keep().
  [[gnu::noinline]] bool keep(const groma_Config& config, const groma_Config* before) noexcept {
    log(groma_LogLevel_LOG_INFO, kOffTheAir);
    leave();
    return stored_.keep(config, before);
  }

  [[gnu::noinline]] void apply_config() noexcept {
    const std::uint32_t trial_s = command_.trial_s;
    const auto stored = stored_.load();
    if (!stored.config) {
      return refuse(groma_Result_RESULT_INVALID, "no valid configuration is stored: write one");
    }
    reply(groma_Result_RESULT_OK, "", stored_.shown());
    if (by_air_) {
      trial_s_ = trial_s != 0 ? trial_s : Trial::kUsual_s;
      after_ = After::kApply;
      return;
    }
    work_by(stored.config);
    if (stored.on_trial) settle();  // a host at the cable needs no trial
  }

  void work_by(const std::optional<groma_Config>& config) noexcept {
    leave();
    forget_machine();
    config_ = config;
    choose_link();
    bring_radio_up();
    send_hello();
  }

  [[gnu::noinline]] void factory_reset() noexcept {
    log(groma_LogLevel_LOG_INFO, kOffTheAir);
    leave();
    if (!stored_.erase()) {
      refuse(groma_Result_RESULT_STORAGE, "not erased: try again");
      return resume();
    }
    forget_machine();
    config_.reset();
    reply(groma_Result_RESULT_OK, "");
    choose_link();
    join();
    send_hello();
  }

  // ---- over the air --------------------------------------------------------------------------------------

  // Actions that would cut off the answer to a command over the air are delayed until the answer has arrived.
  enum class After : std::uint8_t { kNothing, kApply, kReboot };

  void do_after() noexcept {
    const After what = std::exchange(after_, After::kNothing);
    if (what == After::kNothing) return;
    if (what == After::kReboot) return platform_.restart();
    const auto stored = stored_.load();
    work_by(stored.config);
    if (stored.on_trial) trial_.begin(platform_.now_us(), trial_s_);
  }

  // Forwards a command for another node.
  void ask_by_air(std::span<const std::uint8_t> payload) noexcept {
    if (!machine_.in_step()) {
      return refuse(groma_Result_RESULT_UNREACHABLE, "the wired node is not synchronized with its network");
    }
    switch (air_.ask(command_.target_id, command_.request_id, payload)) {
      case AirLink::Asked::kTooLong:
        return refuse(groma_Result_RESULT_INVALID, "too long to go over the air");
      case AirLink::Asked::kUnderWay:
        lent_until_us_.reset();
        if (command_.which_body == groma_HostToNode_survey_tag) lend(kLongestSurvey_us);
        return reply(groma_Result_RESULT_PENDING, "");
      case AirLink::Asked::kBusy:
        return reply(groma_Result_RESULT_PENDING, "waiting for another command");
    }
  }

  // Handles what came over the air since the last call.
  void serve_air() noexcept {
    if (lender_ != mac::kNobody && survey_left_ == 0) end_survey();
    switch (air_.take_event()) {
      case AirLink::Event::kNone:
        return;
      case AirLink::Event::kCommand:
        return carry_out_by_air();
      case AirLink::Event::kAnswer:
        return pass_answer_on();
      case AirLink::Event::kNoAnswer:
        return report_silence();
      case AirLink::Event::kDelivered:
        if (after_ != After::kNothing) return do_after();
        if (trial_.under_way()) settle();
        return;
      case AirLink::Event::kUndelivered:
        // The asking node may have received the answer and then left the air; a trial repairs a wrong guess.
        return do_after();
    }
  }

  void carry_out_by_air() noexcept {
    // A new command shows that the answer to the one before has arrived.
    do_after();
    const bool whole = read_command(air_.message());
    by_air_ = true;
    air_.begin_answer();
    // A node that is reset could not be found again. A time request is useless over the air, because frames
    // wait for their slots.
    const bool by_cable_alone = command_.which_body == groma_HostToNode_factory_reset_tag ||
                                command_.which_body == groma_HostToNode_time_request_tag;
    if (whole && by_cable_alone) {
      refuse(groma_Result_RESULT_UNSUPPORTED, "not over the air");
    } else if (whole) {
      carry_out();
    } else {
      refuse(groma_Result_RESULT_INVALID, "not a command of this protocol version");
    }
    if (lender_ == mac::kNobody) air_.send_answer();
    by_air_ = false;
  }

  void pass_answer_on() noexcept {
    finish_report();
    lent_until_us_.reset();
    auto answer = air_.message();
    while (const auto message = AirLink::next_message(answer)) {
      if (!answer_link(encoder_.encode_of(*message, air_.peer()))) ++counters_.reports_dropped;
    }
  }

  void report_silence() noexcept {
    if (lent_until_us_) lend(kLentOn_us);
    command_.request_id = air_.request_id();
    by_air_ = false;
    reply(groma_Result_RESULT_UNREACHABLE, "no answer over the air");
  }

  void watch_air(std::uint64_t now_us) noexcept {
    air_.on_second();
    serve_air();
    if (air_.asking()) {
      command_.request_id = air_.request_id();
      by_air_ = false;
      reply(groma_Result_RESULT_PENDING, "");
    }
    if (trial_.is_over(now_us)) end_trial();
    if (lent_until_us_ && now_us >= *lent_until_us_) lent_until_us_.reset();
    if (lender_ != mac::kNobody && now_us >= survey_until_us_) end_survey();
  }

  // ---- ranges between anchors ----------------------------------------------------------------------------
  //
  // An anchor that surveys acts as a tag meanwhile: it polls the other anchors in the slot of the tag that
  // forwarded the command, while that tag is silent. The sums are kept in the buffer of the answer.

  void lend(std::uint64_t duration_us) noexcept { lent_until_us_ = platform_.now_us() + duration_us; }

  void begin_survey(std::uint32_t exchanges) noexcept {
    constexpr std::uint32_t kMost = 200;
    if (exchanges == 0 || exchanges > kMost) {
      return refuse(groma_Result_RESULT_INVALID, "survey.exchanges: 1 to 200");
    }
    if (!by_air_ || !machine_.anchor() || machine_.station()->election().leads()) {
      return refuse(groma_Result_RESULT_UNSUPPORTED, "only over the air, to an anchor that does not lead");
    }
    if (!mac::configured_slot(config_->schedule, air_.peer())) {
      return refuse(groma_Result_RESULT_INVALID, "ask through a tag of the schedule, which lends its slot");
    }
    lender_ = air_.peer();
    survey_request_ = command_.request_id;
    survey_left_ = static_cast<std::uint16_t>(exchanges);
    survey_sums_.clear();
    survey_until_us_ = platform_.now_us() + kLongestSurvey_us / 2;
    leave();
    forget_machine();
    join();
  }

  void survey(const mac::Exchange& exchange) noexcept {
    if (survey_left_ == 0) return;
    for (std::size_t i = 0; i < exchange.count; ++i) {
      const mac::Leg& leg = exchange.legs[i];
      if (const mac::Range range = mac::evaluate(exchange, leg); range.status == mac::RangeStatus::kOk) {
        survey_sums_.add(leg.anchor, range.flight.distance_m(), air_.scratch());
      }
    }
    --survey_left_;  // serve_air() ends the survey after the last one, where the machine may be changed
  }

  void end_survey() noexcept {
    by_air_ = true;
    air_.begin_answer();
    send(
        groma_NodeToHost_survey_report_tag,
        [&](auto& body) { survey_sums_.fill(body.survey_report, air_.scratch()); }, To::kAsker);
    command_.request_id = survey_request_;
    reply(groma_Result_RESULT_OK, "");
    by_air_ = false;
    air_.send_answer();
    lender_ = mac::kNobody;
    leave();
    forget_machine();
    join();
  }

  // ---- a configuration on trial --------------------------------------------------------------------------

  void end_trial() noexcept {
    if (!trial_.in_first_round() && machine_.in_step()) return settle();
    const bool before = trial_.next_round();
    const auto stored = stored_.load(before);
    if (!stored.on_trial) return trial_.end();
    trial_.go_on(platform_.now_us());
    if (!stored.config) return;
    log(groma_LogLevel_LOG_WARNING,
        before ? "on trial: back to the previous configuration" : "on trial: trying again");
    work_by(stored.config);
  }

  // Confirms the configuration in force, and discards the one before.
  void settle() noexcept {
    trial_.end();
    if (config_ && !keep(*config_, nullptr)) trial_.go_on(platform_.now_us());
    resume();
  }

  void prefer_anchors(const groma_AnchorPreference& hint) noexcept {
    if (!machine_.tag()) return refuse(groma_Result_RESULT_UNSUPPORTED, "only a tag polls anchors");
    if (hint.ids_count != hint.weights_count) {
      return refuse(groma_Result_RESULT_INVALID, "prefer_anchors: a weight for each id");
    }
    mac::AnchorSet& anchors = machine_.tag()->membership().anchors();
    anchors.prefer_none();
    for (pb_size_t i = 0; i < hint.ids_count; ++i) {
      if (!anchors.knows(hint.ids[i]) && hint.weights[i] > 0) (void)anchors.announce(hint.ids[i]);
      anchors.prefer(hint.ids[i], hint.weights[i]);
    }
    reply(groma_Result_RESULT_OK, "");
  }

  void identify(std::uint32_t duration_s) noexcept {
    if (duration_s > kMaxIdentify_s) return refuse(groma_Result_RESULT_INVALID, "identify_s: 0 to 3600");
    reply(groma_Result_RESULT_OK, "");
    platform_.set_indicator(Indicator::kIdentify);
    identify_until_us_ = platform_.now_us() + std::uint64_t{duration_s} * 1'000'000;
  }

  P& platform_;
  Build build_;
  dw1000::Dw1000<std::remove_reference_t<decltype(std::declval<P&>().spi())>> radio_;
  dw1000::BringUp bring_up_ = dw1000::BringUp::kNoChip;
  ranging::Unwrapper clock_;
  ranging::ClockTime reference_;
  std::uint64_t reference_us_ = 0;
  ClockPair pair_;  // of the last telemetry, and of the one before
  ClockPair former_pair_;
  bool failed_ = false;         // the radio; on_timer() restarts it
  std::uint8_t failures_ = 0;   // in a row, without an event between
  std::size_t sent_bytes_ = 0;  // of the last frame, on the air
  std::uint64_t armed_us_ = 0;  // when the radio was last armed
  Slack slack_;

  std::optional<groma_Config> config_;  // in force
  Machine machine_;
  mac::SyncState sync_state_ = mac::SyncState::kSearching;
  // The completed exchange, and the progress of its report.
  enum class Reporting : std::uint8_t { kChoosing, kBegin, kRanges, kFraming };
  const mac::Exchange* completed_ = nullptr;
  Reporting reporting_ = Reporting::kChoosing;
  std::size_t ranges_left_ = 0;
  ranging::ClockTime report_time_;
  std::uint64_t next_piece_us_ = 0;
  std::optional<ranging::ClockTime> armed_;  // start of a listening armed before the machine asked for it
  std::uint32_t proven_superframe_ = 0;      // superframe at the last proof of life
  std::uint32_t report_sequence_ = 0;
  std::optional<dw1000::Ambient> ambient_;
  bool sampling_ = false;
  std::uint64_t next_ambient_us_ = 0;
  std::uint16_t sessions_ = 0;  // started in this boot
  std::uint32_t nonces_ = 0;    // made in this boot
  mac::SignedPlaces signed_places_;
  const char* link_error_ = "";
  groma_Counters counters_ = groma_Counters_init_zero;
  std::uint32_t late_before_ = 0;  // transmissions and receptions, at the last telemetry
  bool were_late_ = false;         // many in the second before
  std::uint32_t undecodable_ = 0;  // whole frames from the host that contained no command

  wire::FrameDecoder decoder_;
  MessageEncoder encoder_;
  groma_NodeToHost message_ = groma_NodeToHost_init_zero;
  groma_HostToNode command_ = groma_HostToNode_init_zero;

  AirLink air_;
  bool by_air_ = false;  // the present command came over the air
  After after_ = After::kNothing;
  std::uint16_t lender_ = mac::kNobody;  // the tag in whose slot this anchor surveys
  std::uint16_t survey_left_ = 0;        // exchanges left
  SurveySums survey_sums_;
  std::uint32_t survey_request_ = 0;
  std::uint64_t survey_until_us_ = 0;
  std::optional<std::uint64_t> lent_until_us_;  // this tag's slot
  Trial trial_;
  std::uint32_t trial_s_ = Trial::kUsual_s;  // duration of the next trial

  StoredConfig<P> stored_;

  std::uint64_t radio_deadline_us_ = kNever_us;
  mac::Action launching_;                        // loaded, to be launched
  std::uint64_t launch_us_ = kNever_us;          // when
  std::uint64_t quiet_until_us_ = 0;             // the radio is armed for this time
  std::uint64_t event_due_us_ = 0;               // the next radio interrupt is not before; 0: not known
  std::uint64_t next_listening_us_ = kNever_us;  // while unconfigured
  std::uint64_t next_telemetry_us_ = kNever_us;
  std::uint64_t telemetry_due_us_ = kNever_us;
  bool counters_next_ = false;  // the next part of the telemetry
  std::uint64_t identify_until_us_ = kNever_us;
};

}  // namespace groma::node
