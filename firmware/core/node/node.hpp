// A node: the radio driver, the tag or anchor that uses it, and the link to the host.
//
// After each radio interrupt the node takes the event, lets the state machine decide, and arms the radio for
// the next action. After that it evaluates and reports a completed exchange, in steps that fit into the time
// in which the radio does not need the processor (on_timer()). The slots depend on the radio's clock only.
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
#include <optional>
#include <span>
#include <utility>

#include "firmware/core/node/air_link.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/core/node/messages.hpp"
#include "firmware/core/node/platform.hpp"
#include "firmware/core/node/radio_executor.hpp"
#include "firmware/core/node/reporter.hpp"
#include "firmware/core/node/shared.hpp"
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
      : platform_(platform), reports_(shared_, radio_, build), stored_(platform) {}

  // Call once after boot: loads the configuration, brings the radio up, sends a hello, and joins the network
  // if configured.
  void start() noexcept {
    platform_.set_indicator(Indicator::kUnconfigured);
    telemetry_due_us_ = next_telemetry_us_ = platform_.now_us() + kTelemetryPeriod_us;
    const auto stored = stored_.load();
    config_ = stored.config;
    if (stored.on_trial) trial_.begin(platform_.now_us(), Trial::kUsual_s);
    reports_.choose_link();
    bring_radio_up();
    reports_.send_hello();
  }

  // Call while the radio's interrupt line is high, until it is low.
  void on_radio_interrupt() noexcept {
    if (!handle_event(platform_.radio_interrupt_us())) return;
    serve_air();
    radio_.sample_ambient();
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
    return std::min({radio_.deadline_us(), radio_.launch_us(), next_listening_us_, next_telemetry_us_,
                     identify_until_us_, reports_.report_due_us()});
  }

  // Call at or after next_deadline_us(); earlier calls are harmless.
  void on_timer() noexcept {
    const std::uint64_t now_us = platform_.now_us();
    if (now_us >= radio_.launch_us()) {
      radio_.launch();
      watch_sync();
    }
    if (now_us >= radio_.deadline_us()) on_radio_deadline();
    if (now_us >= next_listening_us_) listen_unconfigured();
    if (now_us >= identify_until_us_) {
      identify_until_us_ = kNever_us;
      indicate();
    }
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
  static constexpr std::uint64_t kUnconfiguredPeriod_us = 1'000'000;
  static constexpr ranging::Ticks kUnconfiguredListening = ranging::Ticks::from_us(20'000);
  static constexpr std::uint32_t kMaxIdentify_s = 3'600;
  static constexpr const char* kOffTheAir = "off the air to write flash";
  static constexpr std::uint64_t kLongestSurvey_us = 60'000'000;
  // After a survey that was not answered.
  static constexpr std::uint64_t kLentOn_us = 5'000'000;

  // ---- the radio -----------------------------------------------------------------------------------------

  // Brings the radio up. The machine, if there is one, continues.
  void bring_radio_up() noexcept {
    reports_.drop_report();  // it would read the radio's clock
    next_listening_us_ = kNever_us;
    radio_.bring_up();
    if (!radio_.is_up()) {
      reports_.log(groma_LogLevel_LOG_ERROR, describe(radio_.state()));
      return indicate();
    }
    if (radio_.driver().woken()) reports_.log(groma_LogLevel_LOG_INFO, "radio: woken from sleep");
    if (const char* text = radio_.driver().warning(); text[0] != '\0')
      reports_.log(groma_LogLevel_LOG_WARNING, text);
    resume();
  }

  // Joins the network from the beginning, with the configuration in force.
  void join() noexcept {
    next_listening_us_ = kNever_us;
    radio_.slack().clear();
    if (!radio_.is_up()) return indicate();
    if (!config_) {
      next_listening_us_ = platform_.now_us() + kUnconfiguredPeriod_us;
      return indicate();
    }
    mac::Site site = site_of(*config_, radio_.driver().phy(), radio_.driver().transmit_antenna_delay());
    site.boot_count = platform_.boot_count();
    site.on_trial = trial_.under_way();
    site.sessions = &sessions_;
    site.network_key = std::span(config_->network_key.bytes).first(config_->network_key.size);
    site.cipher = &platform_.cipher();
    site.nonces = &nonces_;
    site.signed_places = &signed_places_;
    site.lender = survey_.lender();
    if (!survey_.under_way()) site.lent_until_us = &lent_until_us_;
    if (config_->role == groma_Role_ROLE_TAG || survey_.under_way()) {
      machine_.become<mac::Tag>(site, counters_);
    } else {
      machine_.become<mac::Anchor>(site, counters_);
    }
    air_.start(site.id, mac::rank_of(*site.schedule, site.id).has_value(), platform_.boot_count());
    machine_.call([this](auto& machine) { machine.attach(air_); });
    radio_.start();
    proven_superframe_ = machine_.superframe();
    indicate();
  }

  void listen_unconfigured() noexcept {
    next_listening_us_ = platform_.now_us() + kUnconfiguredPeriod_us;
    radio_.listen(kUnconfiguredListening);
  }

  // Call after an interrupt that reported an event.
  void prove_life() noexcept {
    if (machine_.in_step() && machine_.superframe() == proven_superframe_) return;
    proven_superframe_ = machine_.superframe();
    platform_.proof_of_life();
  }

  // Goes off the air until resume(), join() or bring_radio_up().
  void leave() noexcept {
    radio_.stop();
    next_listening_us_ = kNever_us;
  }

  // Continues after leave(). The radio's clock has continued, so a master's beacons come when the other
  // nodes, which have coasted meanwhile, expect them.
  void resume() noexcept {
    if (machine_.station() == nullptr || !radio_.is_up()) return join();
    radio_.resume();
    watch_sync();
  }

  void forget_machine() noexcept {
    radio_.forget();
    reports_.drop_report();
  }

  bool handle_event(std::uint64_t interrupt_us) noexcept {
    if (!radio_.handle_event(interrupt_us)) return false;
    watch_sync();
    return true;
  }

  void on_radio_deadline() noexcept {
    if (!radio_.is_up()) {
      bring_radio_up();
      if (radio_.is_up()) reports_.send_hello();
      return;
    }
    // Handle an event whose interrupt was lost like any other.
    if (radio_.deadline_us() != 0 && handle_event(platform_.now_us())) return;
    if (radio_.restart()) {
      reports_.log(groma_LogLevel_LOG_WARNING, "radio: no answer, started again");
      return resume();
    }
    reports_.drop_report();
    reports_.log(groma_LogLevel_LOG_WARNING, "radio: no answer, brought up again");
    bring_radio_up();
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
      reports_.log(groma_LogLevel_LOG_WARNING, "beacons lost, searching");
    } else if (was_searching) {
      reports_.log(groma_LogLevel_LOG_INFO, "in step with the master");
    } else {
      return;
    }
    indicate();
  }

  void indicate() noexcept {
    if (identify_until_us_ != kNever_us) return;
    if (!radio_.is_up()) {
      platform_.set_indicator(Indicator::kRadioFault);
    } else if (machine_.station() == nullptr) {
      platform_.set_indicator(Indicator::kUnconfigured);
    } else {
      platform_.set_indicator(machine_.in_step() ? Indicator::kRanging : Indicator::kSearching);
    }
  }

  // ---- once a second
  // ---------------------------------------------------------------------------------------

  // The status and the counters in turn: idle times are too short for both.
  void send_telemetry(std::uint64_t now_us) noexcept {
    if (counters_next_) {
      reports_.send_counters();
      reports_.warn_if_late();
      telemetry_due_us_ = next_telemetry_us_ = now_us + kTelemetryPeriod_us;
    } else {
      radio_.compare_clocks();
      reports_.send_status();
      watch_air(now_us);
      telemetry_due_us_ = next_telemetry_us_ = now_us;
    }
    counters_next_ = !counters_next_;
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
    const ReplyContext to = ReplyContext::link(command_.request_id);
    if (command_.target_id != 0 && !(config_ && command_.target_id == config_->id))
      return ask_by_air(payload, to);
    carry_out(to);
  }

  // Carries out command_.
  void carry_out(const ReplyContext& to) noexcept {
    switch (command_.which_body) {
      case groma_HostToNode_get_hello_tag:
        reports_.reply(to, groma_Result_RESULT_OK, "");
        reports_.send_hello(to);
        break;
      case groma_HostToNode_get_counters_tag:
        reports_.reply(to, groma_Result_RESULT_OK, "");
        reports_.send_counters(to);
        break;
      case groma_HostToNode_get_slack_tag:
        reports_.reply(to, groma_Result_RESULT_OK, "");
        reports_.send_slack(to);
        break;
      case groma_HostToNode_read_config_tag:
        read_config(to);
        break;
      case groma_HostToNode_write_config_tag:
        write_config(command_.body.write_config, to);
        break;
      case groma_HostToNode_apply_config_tag:
        apply_config(to);
        break;
      case groma_HostToNode_identify_s_tag:
        identify(command_.body.identify_s, to);
        break;
      case groma_HostToNode_prefer_anchors_tag:
        prefer_anchors(command_.body.prefer_anchors, to);
        break;
      case groma_HostToNode_leave_network_tag:
        if (machine_.tag() == nullptr) {
          reports_.refuse(to, groma_Result_RESULT_UNSUPPORTED, "only a tag has a slot to leave");
          break;
        }
        machine_.tag()->membership().leave();
        reports_.reply(to, groma_Result_RESULT_OK, "");
        break;
      case groma_HostToNode_reboot_tag:
        reports_.reply(to, groma_Result_RESULT_OK, "");
        after_ = After::kReboot;
        if (!to.by_air()) do_after();
        break;
      case groma_HostToNode_factory_reset_tag:
        factory_reset(to);
        break;
      case groma_HostToNode_survey_tag:
        begin_survey(command_.body.survey.exchanges, to);
        break;
      case groma_HostToNode_time_request_tag:
        send_time(to);
        break;
      default:
        reports_.refuse(to, groma_Result_RESULT_UNSUPPORTED, "not a command of this protocol version");
        break;
    }
  }

  void send_time(const ReplyContext& to) noexcept {
    if (!radio_.is_up()) {
      return reports_.refuse(to, groma_Result_RESULT_UNSUPPORTED, "no clock: the radio is down");
    }
    const ranging::ClockTime received = radio_.read_clock();
    reports_.send(groma_NodeToHost_time_reply_tag, to, [&](auto& body) {
      body.time_reply.host_time_ns = command_.body.time_request.host_time_ns;
      body.time_reply.received_dtu = static_cast<std::uint64_t>(received.count());
      body.time_reply.transmitted_dtu = static_cast<std::uint64_t>(radio_.read_clock().count());
    });
  }

  [[gnu::noinline]] void read_config(const ReplyContext& to) noexcept {
    const bool good = stored_.load().config.has_value();
    reports_.reply(to, groma_Result_RESULT_OK, "", good ? stored_.shown() : std::span<const std::uint8_t>());
  }

  // If the key is missing but its hash is there, inserts the node's present key if the hash matches.
  [[gnu::noinline]] void complete_key(groma_Config& config) noexcept {
    if (config.network_key.size != 0 || config.network_key_hash == 0) return;
    const auto stored = stored_.load();
    if (stored.config && stored.config->network_key_hash == config.network_key_hash)
      config.network_key = stored.config->network_key;
  }

  [[gnu::noinline]] void write_config(groma_Config& config, const ReplyContext& to) noexcept {
    if (to.by_air() && config.network_key.size != 0) {
      return reports_.refuse(to, groma_Result_RESULT_INVALID,
                             "network_key: not over the air, where anyone can read it");
    }
    complete_key(config);
    if (const char* fault = fault_of(config); fault[0] != '\0') {
      return reports_.refuse(to, groma_Result_RESULT_INVALID, fault);
    }
    // A configuration that came over the air may cut the node off, so the present one is stored with it.
    const bool trial = to.by_air() && config_;
    if (keep(config, trial ? &*config_ : nullptr)) {
      trial_.end();
      read_config(to);
    } else {
      reports_.refuse(to, groma_Result_RESULT_STORAGE, "not stored: write it again");
    }
    resume();
  }

  // Leaves the air and logs it. Returns false as StoredConfig::keep().
  [[gnu::noinline]] bool keep(const groma_Config& config, const groma_Config* before) noexcept {
    reports_.log(groma_LogLevel_LOG_INFO, kOffTheAir);
    leave();
    return stored_.keep(config, before);
  }

  [[gnu::noinline]] void apply_config(const ReplyContext& to) noexcept {
    const std::uint32_t trial_s = command_.trial_s;
    const auto stored = stored_.load();
    if (!stored.config) {
      return reports_.refuse(to, groma_Result_RESULT_INVALID, "no valid configuration is stored: write one");
    }
    reports_.reply(to, groma_Result_RESULT_OK, "", stored_.shown());
    if (to.by_air()) {
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
    reports_.choose_link();
    bring_radio_up();
    reports_.send_hello();
  }

  [[gnu::noinline]] void factory_reset(const ReplyContext& to) noexcept {
    reports_.log(groma_LogLevel_LOG_INFO, kOffTheAir);
    leave();
    if (!stored_.erase()) {
      reports_.refuse(to, groma_Result_RESULT_STORAGE, "not erased: try again");
      return resume();
    }
    forget_machine();
    config_.reset();
    reports_.reply(to, groma_Result_RESULT_OK, "");
    reports_.choose_link();
    join();
    reports_.send_hello();
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
  void ask_by_air(std::span<const std::uint8_t> payload, const ReplyContext& to) noexcept {
    if (!machine_.in_step()) {
      return reports_.refuse(to, groma_Result_RESULT_UNREACHABLE,
                             "the wired node is not synchronized with its network");
    }
    switch (air_.ask(command_.target_id, to.request_id, payload)) {
      case AirLink::Asked::kTooLong:
        return reports_.refuse(to, groma_Result_RESULT_INVALID, "too long to go over the air");
      case AirLink::Asked::kUnderWay:
        lent_until_us_.reset();
        if (command_.which_body == groma_HostToNode_survey_tag) lend(kLongestSurvey_us);
        return reports_.reply(to, groma_Result_RESULT_PENDING, "");
      case AirLink::Asked::kBusy:
        return reports_.reply(to, groma_Result_RESULT_PENDING, "waiting for another command");
    }
  }

  // Handles what came over the air since the last call.
  void serve_air() noexcept {
    if (survey_.is_complete()) end_survey();
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
    const ReplyContext to = ReplyContext::air(command_.request_id);
    air_.begin_answer();
    // A node that is reset could not be found again. A time request is useless over the air, because frames
    // wait for their slots.
    const bool by_cable_alone = command_.which_body == groma_HostToNode_factory_reset_tag ||
                                command_.which_body == groma_HostToNode_time_request_tag;
    if (whole && by_cable_alone) {
      reports_.refuse(to, groma_Result_RESULT_UNSUPPORTED, "not over the air");
    } else if (whole) {
      carry_out(to);
    } else {
      reports_.refuse(to, groma_Result_RESULT_INVALID, "not a command of this protocol version");
    }
    if (!survey_.under_way()) air_.send_answer();
  }

  void pass_answer_on() noexcept {
    lent_until_us_.reset();
    auto answer = air_.message();
    while (const auto message = AirLink::next_message(answer)) reports_.pass_on(*message, air_.peer());
  }

  void report_silence() noexcept {
    if (lent_until_us_) lend(kLentOn_us);
    reports_.reply(ReplyContext::link(air_.request_id()), groma_Result_RESULT_UNREACHABLE,
                   "no answer over the air");
  }

  void watch_air(std::uint64_t now_us) noexcept {
    air_.on_second();
    serve_air();
    if (air_.asking()) reports_.reply(ReplyContext::link(air_.request_id()), groma_Result_RESULT_PENDING, "");
    if (trial_.is_over(now_us)) end_trial();
    if (lent_until_us_ && now_us >= *lent_until_us_) lent_until_us_.reset();
    if (survey_.is_overdue(now_us)) end_survey();
  }

  // ---- ranges between anchors ----------------------------------------------------------------------------

  void lend(std::uint64_t duration_us) noexcept { lent_until_us_ = platform_.now_us() + duration_us; }

  void begin_survey(std::uint32_t exchanges, const ReplyContext& to) noexcept {
    if (exchanges == 0 || exchanges > Survey::kMaxExchanges) {
      return reports_.refuse(to, groma_Result_RESULT_INVALID, "survey.exchanges: 1 to 200");
    }
    if (!to.by_air() || !machine_.anchor() || machine_.station()->election().leads()) {
      return reports_.refuse(to, groma_Result_RESULT_UNSUPPORTED,
                             "only over the air, to an anchor that does not lead");
    }
    if (!mac::configured_slot(config_->schedule, air_.peer())) {
      return reports_.refuse(to, groma_Result_RESULT_INVALID,
                             "ask through a tag of the schedule, which lends its slot");
    }
    survey_reply_ = to;
    survey_.begin(air_.peer(), exchanges, platform_.now_us() + kLongestSurvey_us / 2);
    leave();
    forget_machine();
    join();
  }

  void end_survey() noexcept {
    air_.begin_answer();
    reports_.send(groma_NodeToHost_survey_report_tag, survey_reply_,
                  [&](auto& body) { survey_.fill(body.survey_report); });
    reports_.reply(survey_reply_, groma_Result_RESULT_OK, "");
    air_.send_answer();
    survey_.end();
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
    reports_.log(groma_LogLevel_LOG_WARNING,
                 before ? "on trial: back to the previous configuration" : "on trial: trying again");
    work_by(stored.config);
  }

  // Confirms the configuration in force, and discards the one before.
  void settle() noexcept {
    trial_.end();
    if (config_ && !keep(*config_, nullptr)) trial_.go_on(platform_.now_us());
    resume();
  }

  void prefer_anchors(const groma_AnchorPreference& hint, const ReplyContext& to) noexcept {
    if (!machine_.tag())
      return reports_.refuse(to, groma_Result_RESULT_UNSUPPORTED, "only a tag polls anchors");
    if (hint.ids_count != hint.weights_count) {
      return reports_.refuse(to, groma_Result_RESULT_INVALID, "prefer_anchors: a weight for each id");
    }
    mac::AnchorSet& anchors = machine_.tag()->membership().anchors();
    anchors.prefer_none();
    for (pb_size_t i = 0; i < hint.ids_count; ++i) {
      if (!anchors.knows(hint.ids[i]) && hint.weights[i] > 0) (void)anchors.announce(hint.ids[i]);
      anchors.prefer(hint.ids[i], hint.weights[i]);
    }
    reports_.reply(to, groma_Result_RESULT_OK, "");
  }

  void identify(std::uint32_t duration_s, const ReplyContext& to) noexcept {
    if (duration_s > kMaxIdentify_s)
      return reports_.refuse(to, groma_Result_RESULT_INVALID, "identify_s: 0 to 3600");
    reports_.reply(to, groma_Result_RESULT_OK, "");
    platform_.set_indicator(Indicator::kIdentify);
    identify_until_us_ = platform_.now_us() + std::uint64_t{duration_s} * 1'000'000;
  }

  P& platform_;
  Shared<P> shared_{platform_};
  RadioExecutor<P> radio_{shared_, reports_};
  Reporter<P> reports_;
  // The executor's machine, and what all parts share.
  Machine& machine_ = radio_.machine();
  std::optional<groma_Config>& config_ = shared_.config;
  groma_Counters& counters_ = shared_.counters;
  AirLink& air_ = shared_.air;
  Survey& survey_ = shared_.survey;
  mac::SyncState sync_state_ = mac::SyncState::kSearching;
  std::uint32_t proven_superframe_ = 0;  // superframe at the last proof of life
  std::uint16_t sessions_ = 0;           // started in this boot
  std::uint32_t nonces_ = 0;             // made in this boot
  mac::SignedPlaces signed_places_;
  std::uint32_t undecodable_ = 0;  // whole frames from the host that contained no command

  wire::FrameDecoder decoder_;
  groma_HostToNode command_ = groma_HostToNode_init_zero;

  After after_ = After::kNothing;
  ReplyContext survey_reply_;
  std::optional<std::uint64_t> lent_until_us_;  // this tag's slot
  Trial trial_;
  std::uint32_t trial_s_ = Trial::kUsual_s;  // duration of the next trial

  StoredConfig<P> stored_;

  std::uint64_t next_listening_us_ = kNever_us;  // while unconfigured
  std::uint64_t next_telemetry_us_ = kNever_us;
  std::uint64_t telemetry_due_us_ = kNever_us;
  bool counters_next_ = false;  // the next part of the telemetry
  std::uint64_t identify_until_us_ = kNever_us;
};

}  // namespace groma::node
