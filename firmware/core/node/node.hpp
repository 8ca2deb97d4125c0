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
  Node(P& platform, const Build& build) noexcept : platform_(platform), build_(build), stored_(platform) {}

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
    const std::uint64_t piece_us = completed_ != nullptr ? next_piece_us_ : kNever_us;
    return std::min({radio_.deadline_us(), radio_.launch_us(), next_listening_us_, next_telemetry_us_,
                     identify_until_us_, piece_us});
  }

  // Call at or after next_deadline_us(); earlier calls are harmless.
  void on_timer() noexcept {
    const std::uint64_t now_us = platform_.now_us();
    if (now_us >= radio_.launch_us()) {
      radio_.launch();
      after_event();
    }
    if (now_us >= radio_.deadline_us()) on_radio_deadline();
    if (now_us >= next_listening_us_) listen_unconfigured();
    if (now_us >= identify_until_us_) {
      identify_until_us_ = kNever_us;
      indicate();
    }
    if (completed_ != nullptr) {
      if (now_us < next_piece_us_) return;
      if (radio_.has_idle_time(now_us, kPiece_us)) {
        report_piece();
      } else {
        next_piece_us_ = now_us + kPiece_us;
      }
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
  // The longest step of a report.
  static constexpr std::uint64_t kPiece_us = 100;
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
    completed_ = nullptr;  // its report would read the radio's clock
    next_listening_us_ = kNever_us;
    radio_.bring_up();
    if (!radio_.is_up()) {
      log(groma_LogLevel_LOG_ERROR, describe(radio_.state()));
      return indicate();
    }
    if (radio_.driver().woken()) log(groma_LogLevel_LOG_INFO, "radio: woken from sleep");
    if (const char* text = radio_.driver().warning(); text[0] != '\0') log(groma_LogLevel_LOG_WARNING, text);
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
    after_event();
  }

  void forget_machine() noexcept {
    radio_.forget();
    completed_ = nullptr;
  }

  bool handle_event(std::uint64_t interrupt_us) noexcept {
    if (!radio_.handle_event(interrupt_us)) return false;
    after_event();
    return true;
  }

  void after_event() noexcept {
    if (const mac::Exchange* exchange = radio_.take_completed()) begin_report(*exchange);
    watch_sync();
  }

  void on_radio_deadline() noexcept {
    if (!radio_.is_up()) {
      bring_radio_up();
      if (radio_.is_up()) send_hello();
      return;
    }
    // Handle an event whose interrupt was lost like any other.
    if (radio_.deadline_us() != 0 && handle_event(platform_.now_us())) return;
    if (radio_.restart()) {
      log(groma_LogLevel_LOG_WARNING, "radio: no answer, started again");
      return resume();
    }
    completed_ = nullptr;
    log(groma_LogLevel_LOG_WARNING, "radio: no answer, brought up again");
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
    if (!radio_.is_up()) {
      platform_.set_indicator(Indicator::kRadioFault);
    } else if (machine_.station() == nullptr) {
      platform_.set_indicator(Indicator::kUnconfigured);
    } else {
      platform_.set_indicator(machine_.in_step() ? Indicator::kRanging : Indicator::kSearching);
    }
  }

  // ---- to the host ---------------------------------------------------------------------------------------

  // Configures the link of the configuration in force, or the platform's default without one.
  void choose_link() noexcept {
    if constexpr (ChoosesLink<P>) {
      link_error_ = platform_.configure_link(config_.value_or(groma_Config groma_Config_init_zero));
    }
  }

  template <class Fill>
  void send(pb_size_t which, Fill&& fill, const ReplyContext& to = {},
            const ReplyConfig& config = {}) noexcept {
    finish_report();
    message_ = groma_NodeToHost_init_zero;
    message_.which_body = which;
    fill(message_.body);
    if (!write_message(to, config)) ++counters_.reports_dropped;
  }

  bool write_message(const ReplyContext& to = {}, const ReplyConfig& config = {}) noexcept {
    if (to.by_air()) {
      const std::size_t size = encode_message(message_, config, air_.room());
      if (size != 0) air_.append(size);
      return size != 0;
    }
    const auto frame = encoder_.encode(message_, config);
    return to.way == ReplyContext::Way::kAsker ? answer_link(frame) : platform_.link_write(frame);
  }

  bool answer_link(std::span<const std::uint8_t> frame) noexcept {
    if constexpr (ChoosesLink<P>) return platform_.link_answer(frame);
    return platform_.link_write(frame);
  }

  // `exchange` is valid until the next one is complete.
  void begin_report(const mac::Exchange& exchange) noexcept {
    finish_report();
    completed_ = &exchange;
    ranges_left_ = exchange.count;
    reporting_ = Reporting::kChoosing;
    next_piece_us_ = 0;
  }

  // Reports completed_ in steps of 50 us at 64 MHz, its ranges from the last to the first.
  void report_piece() noexcept {
    groma_SlotReport& report = message_.body.slot_report;
    switch (reporting_) {
      case Reporting::kChoosing:
        if (machine_.tag()) machine_.tag()->choose_anchors();
        if (survey_.under_way()) {
          // serve_air() ends the survey after its last exchange, where the machine may be changed.
          survey_.add(*std::exchange(completed_, nullptr));
          break;
        }
        reporting_ = Reporting::kBegin;
        break;
      case Reporting::kBegin:
        message_ = groma_NodeToHost_init_zero;
        message_.which_body = groma_NodeToHost_slot_report_tag;
        report.sequence = report_sequence_++;
        report.tag_id = config_->id;
        report_time_ = radio_.read_clock();
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
          if (!write_message()) ++counters_.reports_dropped;
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
  }

  void finish_report() noexcept {
    while (completed_ != nullptr) report_piece();
  }

  [[nodiscard]] Ranging ranging() const noexcept {
    return {.raw_stamps = config_->report_raw_stamps,
            .correct_temperature = config_->correct_temperature,
            .correct_power_bias = config_->correct_power_bias,
            .ambient = radio_.ambient()};
  }

  void place_in_network(groma_SlotReport& report, ranging::ClockTime now) noexcept {
    const mac::Station* member = machine_.station();
    if (member == nullptr) return;
    const auto network_time = member->network_time(now);
    if (!network_time) return;
    report.network_time_dtu = static_cast<std::uint64_t>(network_time->count());
    report.network_rate_ppb = -member->sync().skew_ppb();
  }

  void send_hello(const ReplyContext& to = {}) noexcept {
    send(
        groma_NodeToHost_hello_tag,
        [&](auto& body) {
          fill_hello(body.hello, build_, config_, platform_.reset_reason(), platform_.last_fault(),
                     platform_.stack_use(), describe(radio_.state()));
          body.hello.boot_count = platform_.boot_count();
          copy_text(body.hello.link_error, link_error_);
          copy_text(body.hello.radio_warning, radio_.driver().warning());
        },
        to);
  }

  void send_counters(const ReplyContext& to = {}) noexcept {
    if constexpr (ChoosesLink<P>) platform_.count_link(counters_);
    counters_.pll_flags = radio_.driver().pll_flags();
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
    radio_.compare_clocks();
    if (const mac::Station* member = machine_.station()) {
      send(groma_NodeToHost_network_status_tag, [&](auto& body) {
        body.network_status.state = static_cast<groma_SyncState>(member->sync().state());
        body.network_status.superframe = machine_.superframe();
        body.network_status.skew_ppb = -member->sync().skew_ppb();
        body.network_status.beacons_missed = member->sync().missed_in_a_row();
        body.network_status.has_temperature_cdegc = body.network_status.has_supply_mv =
            radio_.ambient().has_value();
        if (radio_.ambient()) {
          body.network_status.temperature_cdegc = radio_.ambient()->temperature_cdegc;
          body.network_status.supply_mv = radio_.ambient()->supply_mv;
        }
        fill_membership(body.network_status);
        if (!machine_.in_step()) return;
        const mac::MasterElection& election = member->election();
        body.network_status.master_id = election.master();
        body.network_status.hop = election.hop();
        body.network_status.session = election.session();
        body.network_status.network_time_dtu =
            static_cast<std::uint64_t>(member->sync().network_time(radio_.latest()).count());
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
    const ReplyContext to = ReplyContext::link(command_.request_id);
    if (command_.target_id != 0 && !(config_ && command_.target_id == config_->id))
      return ask_by_air(payload, to);
    carry_out(to);
  }

  // Carries out command_.
  void carry_out(const ReplyContext& to) noexcept {
    switch (command_.which_body) {
      case groma_HostToNode_get_hello_tag:
        reply(to, groma_Result_RESULT_OK, "");
        send_hello(to);
        break;
      case groma_HostToNode_get_counters_tag:
        reply(to, groma_Result_RESULT_OK, "");
        send_counters(to);
        break;
      case groma_HostToNode_get_slack_tag:
        reply(to, groma_Result_RESULT_OK, "");
        send(
            groma_NodeToHost_slack_tag, [&](auto& body) { radio_.slack().fill(body.slack); }, to);
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
          refuse(to, groma_Result_RESULT_UNSUPPORTED, "only a tag has a slot to leave");
          break;
        }
        machine_.tag()->membership().leave();
        reply(to, groma_Result_RESULT_OK, "");
        break;
      case groma_HostToNode_reboot_tag:
        reply(to, groma_Result_RESULT_OK, "");
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
        refuse(to, groma_Result_RESULT_UNSUPPORTED, "not a command of this protocol version");
        break;
    }
  }

  void reply(const ReplyContext& to, groma_Result result, const char* text,
             const ReplyConfig& config = {}) noexcept {
    send(
        groma_NodeToHost_reply_tag,
        [&](auto& body) {
          body.reply.request_id = to.request_id;
          body.reply.result = result;
          copy_text(body.reply.text, text);
        },
        to, config);
  }

  void send_time(const ReplyContext& to) noexcept {
    if (!radio_.is_up()) {
      return refuse(to, groma_Result_RESULT_UNSUPPORTED, "no clock: the radio is down");
    }
    const ranging::ClockTime received = radio_.read_clock();
    send(
        groma_NodeToHost_time_reply_tag,
        [&](auto& body) {
          body.time_reply.host_time_ns = command_.body.time_request.host_time_ns;
          body.time_reply.received_dtu = static_cast<std::uint64_t>(received.count());
          body.time_reply.transmitted_dtu = static_cast<std::uint64_t>(radio_.read_clock().count());
        },
        to);
  }

  void refuse(const ReplyContext& to, groma_Result result, const char* text) noexcept {
    ++counters_.commands_refused;
    reply(to, result, text);
  }

  [[gnu::noinline]] void read_config(const ReplyContext& to) noexcept {
    const bool good = stored_.load().config.has_value();
    reply(to, groma_Result_RESULT_OK, "", good ? stored_.shown() : std::span<const std::uint8_t>());
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
      return refuse(to, groma_Result_RESULT_INVALID,
                    "network_key: not over the air, where anyone can read it");
    }
    complete_key(config);
    if (const char* fault = fault_of(config); fault[0] != '\0') {
      return refuse(to, groma_Result_RESULT_INVALID, fault);
    }
    // A configuration that came over the air may cut the node off, so the present one is stored with it.
    const bool trial = to.by_air() && config_;
    if (keep(config, trial ? &*config_ : nullptr)) {
      trial_.end();
      read_config(to);
    } else {
      refuse(to, groma_Result_RESULT_STORAGE, "not stored: write it again");
    }
    resume();
  }

  // Leaves the air and logs it. Returns false as StoredConfig::keep().
  [[gnu::noinline]] bool keep(const groma_Config& config, const groma_Config* before) noexcept {
    log(groma_LogLevel_LOG_INFO, kOffTheAir);
    leave();
    return stored_.keep(config, before);
  }

  [[gnu::noinline]] void apply_config(const ReplyContext& to) noexcept {
    const std::uint32_t trial_s = command_.trial_s;
    const auto stored = stored_.load();
    if (!stored.config) {
      return refuse(to, groma_Result_RESULT_INVALID, "no valid configuration is stored: write one");
    }
    reply(to, groma_Result_RESULT_OK, "", stored_.shown());
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
    choose_link();
    bring_radio_up();
    send_hello();
  }

  [[gnu::noinline]] void factory_reset(const ReplyContext& to) noexcept {
    log(groma_LogLevel_LOG_INFO, kOffTheAir);
    leave();
    if (!stored_.erase()) {
      refuse(to, groma_Result_RESULT_STORAGE, "not erased: try again");
      return resume();
    }
    forget_machine();
    config_.reset();
    reply(to, groma_Result_RESULT_OK, "");
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
  void ask_by_air(std::span<const std::uint8_t> payload, const ReplyContext& to) noexcept {
    if (!machine_.in_step()) {
      return refuse(to, groma_Result_RESULT_UNREACHABLE,
                    "the wired node is not synchronized with its network");
    }
    switch (air_.ask(command_.target_id, to.request_id, payload)) {
      case AirLink::Asked::kTooLong:
        return refuse(to, groma_Result_RESULT_INVALID, "too long to go over the air");
      case AirLink::Asked::kUnderWay:
        lent_until_us_.reset();
        if (command_.which_body == groma_HostToNode_survey_tag) lend(kLongestSurvey_us);
        return reply(to, groma_Result_RESULT_PENDING, "");
      case AirLink::Asked::kBusy:
        return reply(to, groma_Result_RESULT_PENDING, "waiting for another command");
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
      refuse(to, groma_Result_RESULT_UNSUPPORTED, "not over the air");
    } else if (whole) {
      carry_out(to);
    } else {
      refuse(to, groma_Result_RESULT_INVALID, "not a command of this protocol version");
    }
    if (!survey_.under_way()) air_.send_answer();
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
    reply(ReplyContext::link(air_.request_id()), groma_Result_RESULT_UNREACHABLE, "no answer over the air");
  }

  void watch_air(std::uint64_t now_us) noexcept {
    air_.on_second();
    serve_air();
    if (air_.asking()) reply(ReplyContext::link(air_.request_id()), groma_Result_RESULT_PENDING, "");
    if (trial_.is_over(now_us)) end_trial();
    if (lent_until_us_ && now_us >= *lent_until_us_) lent_until_us_.reset();
    if (survey_.is_overdue(now_us)) end_survey();
  }

  // ---- ranges between anchors ----------------------------------------------------------------------------

  void lend(std::uint64_t duration_us) noexcept { lent_until_us_ = platform_.now_us() + duration_us; }

  void begin_survey(std::uint32_t exchanges, const ReplyContext& to) noexcept {
    if (exchanges == 0 || exchanges > Survey::kMaxExchanges) {
      return refuse(to, groma_Result_RESULT_INVALID, "survey.exchanges: 1 to 200");
    }
    if (!to.by_air() || !machine_.anchor() || machine_.station()->election().leads()) {
      return refuse(to, groma_Result_RESULT_UNSUPPORTED,
                    "only over the air, to an anchor that does not lead");
    }
    if (!mac::configured_slot(config_->schedule, air_.peer())) {
      return refuse(to, groma_Result_RESULT_INVALID,
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
    send(
        groma_NodeToHost_survey_report_tag, [&](auto& body) { survey_.fill(body.survey_report); },
        survey_reply_);
    reply(survey_reply_, groma_Result_RESULT_OK, "");
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

  void prefer_anchors(const groma_AnchorPreference& hint, const ReplyContext& to) noexcept {
    if (!machine_.tag()) return refuse(to, groma_Result_RESULT_UNSUPPORTED, "only a tag polls anchors");
    if (hint.ids_count != hint.weights_count) {
      return refuse(to, groma_Result_RESULT_INVALID, "prefer_anchors: a weight for each id");
    }
    mac::AnchorSet& anchors = machine_.tag()->membership().anchors();
    anchors.prefer_none();
    for (pb_size_t i = 0; i < hint.ids_count; ++i) {
      if (!anchors.knows(hint.ids[i]) && hint.weights[i] > 0) (void)anchors.announce(hint.ids[i]);
      anchors.prefer(hint.ids[i], hint.weights[i]);
    }
    reply(to, groma_Result_RESULT_OK, "");
  }

  void identify(std::uint32_t duration_s, const ReplyContext& to) noexcept {
    if (duration_s > kMaxIdentify_s) return refuse(to, groma_Result_RESULT_INVALID, "identify_s: 0 to 3600");
    reply(to, groma_Result_RESULT_OK, "");
    platform_.set_indicator(Indicator::kIdentify);
    identify_until_us_ = platform_.now_us() + std::uint64_t{duration_s} * 1'000'000;
  }

  P& platform_;
  Build build_;
  Shared<P> shared_{platform_};
  RadioExecutor<P> radio_{shared_};
  // The executor's machine, and what all parts share.
  Machine& machine_ = radio_.machine();
  std::optional<groma_Config>& config_ = shared_.config;
  groma_Counters& counters_ = shared_.counters;
  mac::SyncState sync_state_ = mac::SyncState::kSearching;
  // The completed exchange, and the progress of its report.
  enum class Reporting : std::uint8_t { kChoosing, kBegin, kRanges, kFraming };
  const mac::Exchange* completed_ = nullptr;
  Reporting reporting_ = Reporting::kChoosing;
  std::size_t ranges_left_ = 0;
  ranging::ClockTime report_time_;
  std::uint64_t next_piece_us_ = 0;
  std::uint32_t proven_superframe_ = 0;  // superframe at the last proof of life
  std::uint32_t report_sequence_ = 0;
  std::uint16_t sessions_ = 0;  // started in this boot
  std::uint32_t nonces_ = 0;    // made in this boot
  mac::SignedPlaces signed_places_;
  const char* link_error_ = "";
  std::uint32_t late_before_ = 0;  // transmissions and receptions, at the last telemetry
  bool were_late_ = false;         // many in the second before
  std::uint32_t undecodable_ = 0;  // whole frames from the host that contained no command

  wire::FrameDecoder decoder_;
  MessageEncoder encoder_;
  groma_NodeToHost message_ = groma_NodeToHost_init_zero;
  groma_HostToNode command_ = groma_HostToNode_init_zero;

  AirLink air_;
  After after_ = After::kNothing;
  Survey survey_;
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
