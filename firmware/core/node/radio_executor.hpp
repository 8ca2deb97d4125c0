// Runs the tag's or the anchor's machine (mac/step.hpp) on the radio: passes it each event of the radio, arms
// the radio for the action that it returns, and keeps the radio's clock.
//
// The slots depend on the radio's clock only. The processor's clock times a deadline for each operation of
// the radio. If its interrupt does not come by then, or the radio does not answer as expected, it is
// deadline_us(): call restart(), and if that fails bring_up(). Afterwards resume() continues in the same
// place in the network.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <optional>
#include <span>
#include <type_traits>
#include <utility>

#include "firmware/core/node/air_link.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/core/node/machine.hpp"
#include "firmware/core/node/messages.hpp"
#include "firmware/core/node/platform.hpp"
#include "firmware/core/node/radio_clock.hpp"
#include "firmware/core/node/slack.hpp"
#include "firmware/core/node/survey.hpp"
#include "firmware/core/radio/radio.hpp"
#include "groma.pb.h"

namespace groma::node {

// What the parts of a node share.
template <Platform P>
struct Shared {
  P& platform;
  std::optional<groma_Config> config{};  // in force
  groma_Counters counters = groma_Counters_init_zero;
  AirLink air{};
  Survey survey{};
  // On the clock of now_us(): until when this tag's slot is lent, and the end of this round of a trial.
  std::optional<std::uint64_t> lent_until_us{};
  std::uint64_t trial_end_us = kNever_us;
};

template <Platform P>
class Reporter;

template <Platform P>
class RadioExecutor {
 public:
  using Driver = typename P::Radio;
  using BringUp = typename Driver::BringUp;
  using ClockTime = ranging::ClockTime;

  // Keeps the references. `reports` takes each completed exchange, before the radio is armed for what
  // follows.
  RadioExecutor(Shared<P>& shared, Reporter<P>& reports) noexcept
      : shared_(shared), reports_(reports), radio_(shared.platform.spi()) {}

  [[nodiscard]] Machine& machine() noexcept { return machine_; }
  [[nodiscard]] const Driver& driver() const noexcept { return radio_; }
  [[nodiscard]] Slack& slack() noexcept { return slack_; }
  // The result of the last bring_up().
  [[nodiscard]] BringUp state() const noexcept { return bring_up_; }
  [[nodiscard]] bool is_up() const noexcept { return bring_up_ == BringUp::kOk; }

  // ---- start and stop ------------------------------------------------------------------------------------

  // Resets and configures the radio; if it does not come up, it is deadline_us() a second later. The machine
  // is forgotten unless the radio's clock continues with an error of some us.
  void bring_up() noexcept {
    event_due_us_ = 0;
    launch_us_ = kNever_us;
    sampling_ = failed_ = false;
    const radio::Settings settings = shared_.config ? radio_settings(*shared_.config) : radio::Settings{};
    bring_up_ = radio_.bring_up(
        settings, [this] { shared_.platform.reset_radio(); }, delay());
    deadline_us_ = is_up() ? kNever_us : now_us() + kBringUpRetry_us;
    if (!is_up() || !continue_clock()) return machine_.forget();
    if (mac::Station* const station = machine_.station()) station->on_clock_restart();
  }

  // Checks the radio after it has failed or missed its deadline. Returns false if it does not work, or has
  // failed twice in a row: bring it up. At the third failure the machine is forgotten.
  [[nodiscard]] bool restart() noexcept {
    recover();
    ++failures_;
    const bool works =
        failures_ == 1 && radio_.restart(delay()) && clock_.is_plausible(radio_.now(), now_us());
    if (works) failed_ = false;
    if (failures_ > 2) machine_.forget();
    return works;
  }

  // Starts the machine, which searches for its network.
  void start() noexcept { perform(machine_.on(&mac::Station::start, refer_now())); }
  // The radio is off until start() or resume(). Its clock runs on.
  void stop() noexcept {
    radio_.stop();
    event_due_us_ = 0;
    launch_us_ = kNever_us;
    if (is_up()) deadline_us_ = kNever_us;
  }
  void resume() noexcept { perform(machine_.on(&mac::Station::resume, refer_now())); }
  // Listens from now on without a machine.
  void listen(ranging::Ticks duration) noexcept {
    perform({.action = {.kind = Kind::kListenNow, .until = refer_now() + duration}});
  }

  // ---- events --------------------------------------------------------------------------------------------

  // Takes the radio's event, lets the machine decide, and arms the radio for the next action. `interrupt_us`:
  // when the radio reported the event. Returns false if there was none.
  bool handle_event(std::uint64_t interrupt_us) noexcept {
    radio::Event event = radio_.poll_event();
    if (event.kind == radio::EventKind::kNone) return false;
    failures_ = 0;
    if (event.kind == radio::EventKind::kTransmitted) {
      on_transmitted(event, interrupt_us);
    } else if (event.kind == radio::EventKind::kReceived) {
      on_received(event, interrupt_us);
    } else {
      on_missed(event.kind);
    }
    precompute();
    return true;
  }
  // When to call launch(); the maximum: no frame is loaded.
  [[nodiscard]] std::uint64_t launch_us() const noexcept { return launch_us_; }
  // Launches the frame that was loaded early.
  void launch() noexcept {
    launch_us_ = kNever_us;
    const radio::Start start = radio_.launch();
    if (start == radio::Start::kStarted) return expect_event(loaded_);
    if (start == radio::Start::kNotIdle) return recover();
    if (start == radio::Start::kTooClose) ++shared_.counters.power_up_errors;
    slack_.add(loaded_.slot, -1);
    perform(machine_.on(&mac::Station::on_late, refer_now()));
    precompute();
  }

  // ---- time ----------------------------------------------------------------------------------------------

  // By when the radio should have reported an event; 0: it has failed; the maximum: never.
  [[nodiscard]] std::uint64_t deadline_us() const noexcept { return failed_ ? 0 : deadline_us_; }
  // Until this time the radio does not need the processor; 0: it may need it at any time; the maximum: timing
  // does not matter.
  [[nodiscard]] std::uint64_t quiet_until_us() const noexcept {
    if (!machine_.in_step()) return kNever_us;
    return event_due_us_ != 0 ? event_due_us_ : quiet_until_us_;
  }
  // The radio does not need the processor for this long.
  [[nodiscard]] bool has_idle_time(std::uint64_t from_us, std::uint64_t needed_us) const noexcept {
    return event_due_us_ == 0 || from_us + needed_us <= event_due_us_;
  }

  // The radio's clock, or where it should be if the radio has failed.
  ClockTime read_clock() noexcept {
    const ranging::DeviceTime counter = radio_.now();
    const std::uint64_t us = now_us();
    if (clock_.is_plausible(counter, us)) return clock_.unwrap(counter);
    recover();
    return clock_.expected_at(us);
  }
  // The latest reading of the radio's clock.
  [[nodiscard]] ClockTime latest() const noexcept { return clock_.latest(); }
  // Call about once a second, even off the air: extends the radio's clock over its wraps.
  void compare_clocks() noexcept {
    if (!is_up()) return;
    const std::uint64_t before_us = now_us();
    const ClockTime radio = read_clock();
    const std::uint64_t us = (before_us + now_us()) / 2;
    if (!failed_) clock_.pair(radio, us);
  }

  // ---- temperature and supply ----------------------------------------------------------------------------

  // Of the chip; nothing: not sampled yet.
  [[nodiscard]] const std::optional<radio::Ambient>& ambient() const noexcept { return ambient_; }
  // Samples them once a second, in two halves with the chip's conversion time between. Each half runs when
  // the radio is armed for later, so it costs no slot.
  void sample_ambient() noexcept {
    const std::uint64_t us = now_us();
    const bool armed_soon = machine_.in_step() && us + kAmbientWork_us > quiet_until_us_;
    if (us < next_ambient_us_ || armed_soon) return;
    if (!sampling_) {
      radio_.start_sampling();
      next_ambient_us_ = us + Driver::kSampling_us + kAmbientWork_us;
    } else {
      ambient_ = radio_.finish_sampling();
      next_ambient_us_ = us + kAmbientPeriod_us;
      if (mac::Station* const station = machine_.station())
        station->set_health(ambient_ ? health_of(*ambient_) : mac::Health{});
    }
    sampling_ = !sampling_;
  }

 private:
  using Kind = mac::Action::Kind;

  // Time after its due end until an operation of the radio is aborted.
  static constexpr std::uint64_t kGrace_us = 5'000;
  static constexpr std::uint64_t kBringUpRetry_us = 1'000'000;
  // A frame that is loaded early is launched so long before its preamble: enough for the longest step of a
  // report and the launch itself.
  static constexpr std::uint64_t kLaunchAhead_us = 200;
  static constexpr std::uint64_t kAmbientPeriod_us = 1'000'000;
  // Processor time for each half of a sampling.
  static constexpr std::uint64_t kAmbientWork_us = 100;
  static constexpr std::pair<radio::EventKind, std::uint32_t groma_Counters::*> kMissed[]{
      {radio::EventKind::kPreambleTimeout, &groma_Counters::preamble_timeouts},
      {radio::EventKind::kFrameTimeout, &groma_Counters::frame_timeouts},
      {radio::EventKind::kSfdTimeout, &groma_Counters::sfd_timeouts},
      {radio::EventKind::kCheckError, &groma_Counters::crc_errors},
      {radio::EventKind::kHeaderError, &groma_Counters::header_errors}};

  [[nodiscard]] std::uint64_t now_us() const noexcept { return shared_.platform.now_us(); }
  [[nodiscard]] radio::Phy phy() const noexcept { return radio_.phy(); }
  [[nodiscard]] auto delay() noexcept {
    return [this](std::uint32_t us) { shared_.platform.delay_us(us); };
  }

  void on_transmitted(const radio::Event& event, std::uint64_t interrupt_us) noexcept {
    const ClockTime timestamp = clock_.unwrap(event.timestamp);
    clock_.refer(timestamp + phy().after_rmarker(sent_bytes_), interrupt_us);
    perform(machine_.on(&mac::Station::on_transmitted, timestamp));
  }

  void on_received(radio::Event& event, std::uint64_t interrupt_us) noexcept {
    ++shared_.counters.frames_received;
    std::optional<ClockTime> armed;
    // Reading a frame while the receiver is armed for the next one is fast, but unproven on hardware.
    const bool ahead = shared_.config && shared_.config->schedule.arm_ahead;
    if (ahead) armed = arm_next_window();
    // The answer to a POLL is urgent, and a POLL's quality is not needed.
    radio_.read_frame(event, [this](std::span<const std::uint8_t> frame) {
      if (mac::Station* const station = machine_.station()) station->begin_verify(frame);
      return !mac::looks_like_poll(frame);
    });
    if (!ahead) armed = arm_next_window();
    const ClockTime timestamp = event.timestamp_valid ? clock_.unwrap(event.timestamp) : refer_now();
    if (event.timestamp_valid) {
      clock_.refer(timestamp + phy().after_rmarker(event.frame.size() + radio::kFrameCheckBytes),
                   interrupt_us);
    }
    if (machine_.station() == nullptr) ++shared_.counters.foreign_frames;
    const mac::Reception reception{timestamp, event.timestamp_valid, event.frame, event.quality};
    perform(machine_.on(&mac::Station::on_received, reception), armed);
  }

  // A reception failed, or nothing came.
  void on_missed(radio::EventKind kind) noexcept {
    const std::optional<ClockTime> armed = arm_next_window();
    for (const auto& [missed, counter] : kMissed) shared_.counters.*counter += missed == kind ? 1U : 0U;
    perform(machine_.on(&mac::Station::on_timeout, refer_now()), armed);
  }

  // The radio is armed: precompute for the next frames.
  void precompute() noexcept {
    const std::size_t on_air_bytes = machine_.precompute();
    if (on_air_bytes != 0) radio_.expect_length(on_air_bytes - radio::kFrameCheckBytes);
  }

  // Time is short between two RESPONSEs: arms the next window before the machine evaluates the frame. Returns
  // the window's start if it is armed.
  [[nodiscard]] std::optional<ClockTime> arm_next_window() noexcept {
    const std::optional<mac::Action> next = machine_.next_rx_window();
    if (!next) return std::nullopt;
    const radio::Start start = receive(*next);
    armed_us_ = now_us();
    if (start != radio::Start::kStarted) return std::nullopt;
    return next->at;
  }

  // Arms the radio for the step's action, unless it is `armed` for it. If the action is too late, informs the
  // machine, which continues with the next one. If all actions are too late, the chip is broken.
  void perform(mac::Step step, std::optional<ClockTime> armed = {}) noexcept {
    constexpr int kTries = 100;
    for (int i = 0; i < kTries; ++i) {
      if (step.completed != nullptr) reports_.on_completed(*step.completed);
      const mac::Action& action = step.action;
      if (const auto at = std::exchange(armed, std::nullopt)) {
        if (is_listening(action, *at)) return supervise(action);
        radio_.stop();
      }
      if (action.kind == Kind::kNone) return rest();
      const radio::Start start = arm(action);
      armed_us_ = now_us();
      if (start == radio::Start::kStarted) return supervise(action);
      if (start != radio::Start::kLate && start != radio::Start::kTooClose) return recover();
      if (start == radio::Start::kTooClose) ++shared_.counters.power_up_errors;
      if (action.kind == Kind::kListen) ++shared_.counters.late_receives;
      slack_.add(action.slot, std::min<std::int32_t>(slack_us(action), -1));
      const bool sends = action.kind == Kind::kTransmit;
      step = machine_.on(sends ? &mac::Station::on_late : &mac::Station::on_timeout, refer_now());
    }
    recover();
  }

  [[nodiscard]] radio::Start arm(const mac::Action& action) noexcept {
    if (action.kind != Kind::kTransmit) return receive(action);
    const radio::Start loaded = radio_.load(clock_.wrap(action.at), action.frame, [this] {
      if (mac::Station* const station = machine_.station()) station->finish_signing();
    });
    if (loaded != radio::Start::kStarted) return loaded;
    const std::uint64_t ahead_us = clock_.us_at(preamble_of(action)) - kLaunchAhead_us;
    if (ahead_us <= now_us()) return radio_.launch();
    // Its lead must not depend on its slot.
    loaded_ = action;
    launch_us_ = ahead_us;
    return radio::Start::kStarted;
  }
  // Listens, at once if it is late for the action's start. Returns kLate if its end has passed too.
  [[nodiscard]] radio::Start receive(const mac::Action& action) noexcept {
    const auto hunt = [&action](ClockTime from) -> std::optional<ranging::Ticks> {
      if (!action.preamble_until) return std::nullopt;
      return *action.preamble_until - from;
    };
    if (action.kind == Kind::kListen) {
      const radio::Start start =
          radio_.receive_at(clock_.wrap(action.at), action.until - action.at, hunt(action.at));
      if (start != radio::Start::kLate) return start;
    }
    const ClockTime now = refer_now();
    if (now >= end_of(action)) return radio::Start::kLate;
    if (action.kind == Kind::kListen) ++shared_.counters.late_receives;
    return radio_.receive_now(action.until - now, hunt(now));
  }
  [[nodiscard]] ClockTime preamble_of(const mac::Action& action) const noexcept {
    return action.at - phy().before_rmarker();
  }
  // When the listening ends at the latest if no frame has begun.
  [[nodiscard]] static ClockTime end_of(const mac::Action& action) noexcept {
    return action.preamble_until.value_or(action.until);
  }
  // The action is the listening that was armed for `at`, but for what a beacon moves it.
  [[nodiscard]] static bool is_listening(const mac::Action& action, ClockTime at) noexcept {
    constexpr ranging::Ticks kSame = ranging::Ticks::from_us(1);
    const ranging::Ticks apart = action.at - at;
    return action.kind == Kind::kListen && apart < kSame && -apart < kSame;
  }

  void rest() noexcept {
    deadline_us_ = quiet_until_us_ = kNever_us;
    event_due_us_ = 0;
  }

  void supervise(const mac::Action& action) noexcept {
    slack_.add(action.slot, slack_us(action));
    expect_event(action);
    if (launch_us_ != kNever_us) event_due_us_ = quiet_until_us_ = launch_us_;
  }

  void expect_event(const mac::Action& action) noexcept {
    if (action.kind == Kind::kTransmit) sent_bytes_ = action.frame.size() + radio::kFrameCheckBytes;
    const bool later = action.kind != Kind::kListenNow && action.at > clock_.reference();
    event_due_us_ = quiet_until_us_ = later ? clock_.us_at(action.at) : 0;
    if (later && action.kind == Kind::kListen) {
      // An event comes after the shortest frame, or when the preamble search ends.
      constexpr std::size_t kShortest_bytes = 12;
      event_due_us_ +=
          RadioClock::rough_us(std::min(end_of(action) - action.at, phy().air_time(kShortest_bytes)));
    }
    deadline_us_ = clock_.us_at(action.kind == Kind::kTransmit ? action.at : action.until) + kGrace_us;
  }

  // How long before its deadline the action was armed, at armed_us_.
  [[nodiscard]] std::int32_t slack_us(const mac::Action& action) const noexcept {
    return clock_.us_until(action.kind == Kind::kTransmit ? preamble_of(action) : action.at, armed_us_);
  }

  // The radio did not answer as expected.
  void recover() noexcept {
    if (failed_) return;
    failed_ = true;
    ++shared_.counters.radio_recoveries;
  }

  bool continue_clock() noexcept {
    const std::uint64_t before_us = now_us();
    const ranging::DeviceTime counter = radio_.now();
    return clock_.restart(counter, (before_us + now_us()) / 2);
  }
  ClockTime refer_now() noexcept {
    const std::uint64_t us = now_us();
    clock_.refer(read_clock(), us);
    return clock_.reference();
  }

  Shared<P>& shared_;
  Reporter<P>& reports_;
  Driver radio_;
  RadioClock clock_;
  Machine machine_;
  Slack slack_;
  BringUp bring_up_ = BringUp::kNoChip;
  bool failed_ = false;
  std::uint8_t failures_ = 0;   // in a row, without an event between
  std::size_t sent_bytes_ = 0;  // of the last frame, on the air
  std::uint64_t armed_us_ = 0;  // when the radio was last armed
  std::uint64_t deadline_us_ = kNever_us;
  mac::Action loaded_;  // to be launched at launch_us_
  std::uint64_t launch_us_ = kNever_us;
  std::uint64_t quiet_until_us_ = 0;  // the radio is armed for this time
  std::uint64_t event_due_us_ = 0;    // the next radio interrupt is not before; 0: not known
  std::optional<radio::Ambient> ambient_;
  bool sampling_ = false;
  std::uint64_t next_ambient_us_ = 0;
};

}  // namespace groma::node
