// A node: the radio's driver, the tag or the anchor that uses it, and the link to the host.
//
// The order of work after each radio interrupt: take the event, let the state machine decide, arm the radio
// for what is next; only then evaluate and report what the exchange gave. The slots run on the DW1000's clock
// alone. The processor's clock paces telemetry and stands by with a deadline for each operation of the radio:
// should its interrupt stay away, the chip is brought up again and the node joins anew.
//
// An unconfigured node sends nothing and listens for 20 ms each second, so that it, too, can prove that
// radio, bus, interrupt and loop are alive (platform.hpp, proof_of_life()).
#pragma once

#include <pb_decode.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>

#include "firmware/core/dw1000/driver.hpp"
#include "firmware/core/mac/anchor.hpp"
#include "firmware/core/mac/tag.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/core/node/messages.hpp"
#include "firmware/core/node/platform.hpp"
#include "groma.pb.h"
#include "proto/frame_codec.hpp"

namespace groma::node {

template <Platform P>
class Node {
 public:
  // Keeps a reference to the platform; build.version is a string that lives as long.
  Node(P& platform, const Build& build) noexcept
      : platform_(platform), build_(build), radio_(platform.spi()) {}

  // Once after boot: loads the configuration, brings the radio up, says hello, and joins if configured.
  void start() noexcept {
    platform_.set_indicator(Indicator::kUnconfigured);
    next_telemetry_us_ = platform_.now_us() + kTelemetryPeriod_us;
    config_ = load_config();
    choose_link();
    bring_radio_up();
    send_hello();
  }

  // While the radio's interrupt line is high, again until it is low.
  void on_radio_interrupt() noexcept {
    const std::uint32_t recoveries = counters_.radio_recoveries;
    if (!handle(radio_.take_event())) return;
    deliver();
    if (counters_.radio_recoveries == recoveries) prove_life();
  }

  // Bytes from the host, in any pieces.
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
    return std::min({radio_deadline_us_, next_listening_us_, next_telemetry_us_, identify_until_us_});
  }

  // At or after next_deadline_us(); harmless before.
  void on_timer() noexcept {
    const std::uint64_t now_us = platform_.now_us();
    if (now_us >= radio_deadline_us_) on_radio_deadline();
    if (now_us >= next_listening_us_) listen_unconfigured();
    if (now_us >= identify_until_us_) {
      identify_until_us_ = kNever_us;
      indicate();
    }
    if (now_us >= next_telemetry_us_) {
      next_telemetry_us_ = now_us + kTelemetryPeriod_us;
      send_telemetry();
    }
  }

  // Up to then the radio is armed and wants nothing of the processor, on the clock of now_us(): the time for
  // what else there is to do. 0 while it may want something any time; the maximum where nothing hangs on how
  // soon it is served.
  [[nodiscard]] std::uint64_t quiet_until_us() const noexcept {
    const mac::Station* member = station();
    const bool searching = member != nullptr && member->sync().state() == mac::SyncState::kSearching;
    return member == nullptr || searching ? kNever_us : quiet_until_us_;
  }

  [[nodiscard]] const groma_Counters& counters() const noexcept { return counters_; }

 private:
  static constexpr std::uint64_t kNever_us = std::numeric_limits<std::uint64_t>::max();
  static constexpr std::uint64_t kTelemetryPeriod_us = 1'000'000;
  // How long after its due end an operation of the radio is given up.
  static constexpr std::uint64_t kRadioGrace_us = 5'000;
  static constexpr std::uint64_t kBringUpRetry_us = 1'000'000;
  static constexpr std::uint64_t kUnconfiguredPeriod_us = 1'000'000;
  static constexpr ranging::Ticks kUnconfiguredListening = ranging::Ticks::from_us(20'000);
  static constexpr std::uint32_t kMaxIdentify_s = 3'600;

  // ---- the radio -----------------------------------------------------------------------------------------

  void bring_radio_up() noexcept {
    forget_machine();
    next_listening_us_ = kNever_us;
    const dw1000::RadioSettings settings = config_ ? radio_settings(*config_) : dw1000::RadioSettings{};
    bring_up_ = radio_.bring_up(
        settings, [this] { platform_.reset_radio(); }, [this](std::uint32_t us) { platform_.delay_us(us); });
    if (bring_up_ != dw1000::BringUp::kOk) {
      log(groma_LogLevel_LOG_ERROR, dw1000::describe(bring_up_));
      radio_deadline_us_ = platform_.now_us() + kBringUpRetry_us;
      indicate();
      return;
    }
    radio_deadline_us_ = kNever_us;
    const std::uint64_t now_us = platform_.now_us();
    clock_.restart(radio_.now(), ranging::Ticks::from_us(static_cast<std::int64_t>(now_us - reference_us_)));
    refer(clock_.latest());
    join();
  }

  // Enters the network from the beginning, by the configuration in force.
  void join() noexcept {
    next_listening_us_ = kNever_us;
    if (bring_up_ != dw1000::BringUp::kOk) return indicate();
    if (!config_) {
      next_listening_us_ = platform_.now_us() + kUnconfiguredPeriod_us;
      return indicate();
    }
    const mac::Site site = site_of(*config_, radio_.transmit_antenna_delay());
    if (config_->role == groma_Role_ROLE_TAG) {
      tag_.emplace(site, counters_);
    } else {
      anchor_.emplace(site, counters_);
    }
    const ranging::ClockTime now = read_clock();
    perform(tell([now](auto& machine) { return machine.start(now); }));
    proven_superframe_ = superframe();
    indicate();
  }

  void listen_unconfigured() noexcept {
    next_listening_us_ = platform_.now_us() + kUnconfiguredPeriod_us;
    const ranging::ClockTime now = read_clock();
    refer(now);
    if (radio_.receive_now(kUnconfiguredListening, std::nullopt) != dw1000::Start::kStarted) return recover();
    supervise({.kind = mac::Action::Kind::kListenNow, .until = now + kUnconfiguredListening});
  }

  // After an interrupt that the radio went on from as it should.
  void prove_life() noexcept {
    const mac::Station* member = station();
    const bool searching = member == nullptr || member->sync().state() == mac::SyncState::kSearching;
    if (!searching && superframe() == proven_superframe_) return;
    proven_superframe_ = superframe();
    platform_.proof_of_life();
  }

  // Off the air until resume(), join() or bring_radio_up().
  void leave() noexcept {
    radio_.stop();
    next_listening_us_ = kNever_us;
    if (bring_up_ == dw1000::BringUp::kOk) radio_deadline_us_ = kNever_us;
  }

  // Back where leave() left: the DW1000's clock has gone on, so a master's beacons come when the others,
  // coasting meanwhile, expect them.
  void resume() noexcept {
    if (station() == nullptr || bring_up_ != dw1000::BringUp::kOk) return join();
    const ranging::ClockTime now = read_clock();
    refer(now);
    perform(tell([now](auto& machine) { return machine.resume(now); }));
    watch_sync();
    deliver();
  }

  template <class F>
  mac::Step tell(F&& f) noexcept {
    if (tag_) return f(*tag_);
    if (anchor_) return f(*anchor_);
    return {};
  }

  void forget_machine() noexcept {
    tag_.reset();
    anchor_.reset();
    completed_ = nullptr;
  }

  [[nodiscard]] const mac::Station* station() const noexcept {
    if (tag_) return &tag_->station();
    if (anchor_) return &anchor_->station();
    return nullptr;
  }

  // False where nothing had happened.
  bool handle(const dw1000::Event& event) noexcept {
    using dw1000::EventKind;
    switch (event.kind) {
      case EventKind::kNone:
        return false;
      case EventKind::kTransmitted: {
        const ranging::ClockTime stamp = clock_.unwrap(event.stamp);
        refer(stamp);
        perform(tell([&](auto& machine) { return machine.on_transmitted(stamp); }));
        break;
      }
      case EventKind::kReceived: {
        ++counters_.frames_received;
        const ranging::ClockTime stamp = event.stamp_valid ? clock_.unwrap(event.stamp) : read_clock();
        refer(stamp);
        if (station() == nullptr) ++counters_.foreign_frames;
        const mac::Reception reception{stamp, event.stamp_valid, event.frame, event.quality};
        perform(tell([&](auto& machine) { return machine.on_received(reception); }));
        break;
      }
      case EventKind::kPreambleTimeout:
      case EventKind::kSfdTimeout:
      case EventKind::kFrameTimeout:
      case EventKind::kCheckError:
      case EventKind::kHeaderError: {
        const bool error = count_failure(event.kind);
        const ranging::ClockTime now = read_clock();
        refer(now);
        perform(tell([&](auto& machine) { return error ? machine.on_error(now) : machine.on_timeout(now); }));
        break;
      }
      case EventKind::kClockLost:
        recover();
        break;
    }
    watch_sync();
    return true;
  }

  // True for a reception that failed, false for one that did not come.
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

  // Arms the radio for the step's action. What is too late is told to the machine, which then goes on to what
  // lies ahead; a chip that finds everything late is broken.
  void perform(mac::Step step) noexcept {
    constexpr int kTries = 100;
    for (int i = 0; i < kTries; ++i) {
      if (step.completed != nullptr) completed_ = step.completed;
      const mac::Action& action = step.action;
      dw1000::Start start = dw1000::Start::kStarted;
      switch (action.kind) {
        case mac::Action::Kind::kNone:
          radio_deadline_us_ = quiet_until_us_ = kNever_us;
          return;
        case mac::Action::Kind::kTransmit:
          start = radio_.transmit_at(clock_.wrap(action.at), action.frame);
          break;
        case mac::Action::Kind::kListen:
          start = radio_.receive_at(clock_.wrap(action.at), action.until - action.at,
                                    preamble_timeout(action, action.at));
          break;
        case mac::Action::Kind::kListenNow:
          start = dw1000::Start::kLate;
          break;
      }
      if (start == dw1000::Start::kStarted) return supervise(action);
      if (start != dw1000::Start::kLate) return recover();

      const ranging::ClockTime now = read_clock();
      refer(now);
      if (action.kind == mac::Action::Kind::kTransmit) {
        step = tell([&](auto& machine) { return machine.on_late(now); });
        continue;
      }
      if (action.kind == mac::Action::Kind::kListen) ++counters_.late_receives;
      if (now >= action.preamble_until.value_or(action.until)) {
        step = tell([&](auto& machine) { return machine.on_timeout(now); });
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
    const std::int64_t quiet_us = (action.at - reference_).to_us();
    const bool later = action.kind != mac::Action::Kind::kListenNow && quiet_us > 0;
    quiet_until_us_ = later ? reference_us_ + static_cast<std::uint64_t>(quiet_us) : 0;
    const ranging::ClockTime end = action.kind == mac::Action::Kind::kTransmit ? action.at : action.until;
    const std::int64_t ahead_us = std::max<std::int64_t>((end - reference_).to_us(), 0);
    radio_deadline_us_ = reference_us_ + static_cast<std::uint64_t>(ahead_us) + kRadioGrace_us;
  }

  void on_radio_deadline() noexcept {
    if (bring_up_ != dw1000::BringUp::kOk) {
      bring_radio_up();
      if (bring_up_ == dw1000::BringUp::kOk) send_hello();
      return;
    }
    // An interrupt that nobody told of is as good as one that was.
    if (handle(radio_.take_event())) {
      deliver();
      return;
    }
    recover();
  }

  void recover() noexcept {
    ++counters_.radio_recoveries;
    log(groma_LogLevel_LOG_WARNING, "radio: no answer, brought up again");
    bring_radio_up();
  }

  [[nodiscard]] ranging::ClockTime read_clock() noexcept { return clock_.unwrap(radio_.now()); }

  // The radio's clock shows `now` as the processor's does.
  void refer(ranging::ClockTime now) noexcept {
    reference_ = now;
    reference_us_ = platform_.now_us();
  }

  void watch_sync() noexcept {
    const mac::Station* member = station();
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
    } else if (const mac::Station* member = station(); member == nullptr) {
      platform_.set_indicator(Indicator::kUnconfigured);
    } else {
      const bool searching = member->sync().state() == mac::SyncState::kSearching;
      platform_.set_indicator(searching ? Indicator::kSearching : Indicator::kRanging);
    }
  }

  // ---- to the host ---------------------------------------------------------------------------------------

  // kAsker: over the link from which the command came that is being carried out.
  enum class To : std::uint8_t { kHost, kAsker };

  // By the configuration in force; without one, what the platform has for that.
  void choose_link() noexcept {
    if constexpr (ChoosesLink<P>) {
      link_error_ = platform_.configure_link(config_.value_or(groma_Config groma_Config_init_zero));
    }
  }

  template <class Fill>
  void send(pb_size_t which, Fill&& fill, To to = To::kHost) noexcept {
    message_ = groma_NodeToHost_init_zero;
    message_.which_body = which;
    fill(message_.body);
    if (!write_message(to)) ++counters_.reports_dropped;
  }

  bool write_message(To to) noexcept {
    const auto frame = encoder_.encode(message_);
    if constexpr (ChoosesLink<P>) {
      if (to == To::kAsker) return platform_.link_answer(frame);
    }
    return platform_.link_write(frame);
  }

  void deliver() noexcept {
    if (completed_ == nullptr) return;
    const mac::Exchange& exchange = *completed_;
    completed_ = nullptr;
    send(groma_NodeToHost_slot_report_tag, [&](auto& body) {
      body.slot_report.sequence = report_sequence_++;
      body.slot_report.tag_id = config_->id;
      fill_slot_report(body.slot_report, exchange, read_clock(), config_->report_raw_stamps, counters_);
      if (config_->link == groma_Link_LINK_CAN) make_compact(message_);
    });
  }

  void send_hello(To to = To::kHost) noexcept {
    send(
        groma_NodeToHost_hello_tag,
        [&](auto& body) {
          fill_hello(body.hello, build_, config_, platform_.reset_reason(), platform_.last_fault(),
                     platform_.stack_use(), dw1000::describe(bring_up_));
          body.hello.boot_count = platform_.boot_count();
          copy_text(body.hello.link_error, link_error_);
        },
        to);
  }

  void send_counters(To to = To::kHost) noexcept {
    if constexpr (ChoosesLink<P>) platform_.count_link(counters_);
    send(
        groma_NodeToHost_counters_tag, [&](auto& body) { body.counters = counters_; }, to);
  }

  void send_telemetry() noexcept {
    // The clock's wraps are followed even where nothing is on the air.
    if (bring_up_ == dw1000::BringUp::kOk) (void)read_clock();
    if (const mac::Station* member = station()) {
      send(groma_NodeToHost_network_status_tag, [&](auto& body) {
        body.network_status.state = sync_state_of(member->sync().state());
        body.network_status.master_id = member->site().schedule.master_id;
        body.network_status.superframe = superframe();
        body.network_status.skew_ppb = -member->sync().skew_ppb();
        body.network_status.beacons_missed = member->sync().missed_in_a_row();
      });
    }
    send_counters();
  }

  [[nodiscard]] std::uint32_t superframe() const noexcept {
    if (tag_) return tag_->superframe_number();
    if (anchor_) return anchor_->superframe_number();
    return 0;
  }

  void log(groma_LogLevel level, const char* text) noexcept {
    send(groma_NodeToHost_log_tag, [&](auto& body) {
      body.log.level = level;
      copy_text(body.log.text, text);
    });
  }

  // ---- from the host -------------------------------------------------------------------------------------

  void on_command(std::span<const std::uint8_t> payload) noexcept {
    command_ = groma_HostToNode_init_zero;
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    if (!pb_decode(&stream, groma_HostToNode_fields, &command_)) {
      ++undecodable_;
      ++counters_.link_frames_bad;
      return;
    }
    switch (command_.which_body) {
      case groma_HostToNode_get_hello_tag:
        reply(groma_Result_RESULT_OK, "");
        send_hello(To::kAsker);
        break;
      case groma_HostToNode_get_counters_tag:
        reply(groma_Result_RESULT_OK, "");
        send_counters(To::kAsker);
        break;
      case groma_HostToNode_read_config_tag:
        reply(groma_Result_RESULT_OK, "", load_config().value_or(groma_Config groma_Config_init_zero));
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
      case groma_HostToNode_reboot_tag:
        reply(groma_Result_RESULT_OK, "");
        platform_.restart();
        break;
      case groma_HostToNode_factory_reset_tag:
        factory_reset();
        break;
      default:
        refuse(groma_Result_RESULT_UNSUPPORTED, "not a command of this protocol version");
        break;
    }
  }

  void reply(groma_Result result, const char* text,
             const std::optional<groma_Config>& config = std::nullopt) noexcept {
    send(
        groma_NodeToHost_reply_tag,
        [&](auto& body) {
          body.reply.request_id = command_.request_id;
          body.reply.result = result;
          copy_text(body.reply.text, text);
          body.reply.has_config = config.has_value();
          if (config) body.reply.config = *config;
        },
        To::kAsker);
  }

  void refuse(groma_Result result, const char* text) noexcept {
    ++counters_.commands_refused;
    reply(result, text);
  }

  // What is stored, if it is a configuration to work by.
  [[nodiscard]] std::optional<groma_Config> load_config() noexcept {
    std::array<std::uint8_t, kMaxConfigBytes> blob{};
    const std::size_t size = platform_.load_config(blob);
    if (size == 0 || size > blob.size()) return std::nullopt;
    auto config = decode_config(std::span(blob).first(size));
    if (config && fault_of(*config)[0] != '\0') config.reset();
    return config;
  }

  // An erase stalls the processor for 85 ms: the host is told, and the radio is off meanwhile.
  bool store_off_the_air(std::span<const std::uint8_t> blob) noexcept {
    log(groma_LogLevel_LOG_INFO, "off the air to write flash");
    leave();
    return platform_.store_config(blob);
  }

  void write_config(const groma_Config& config) noexcept {
    if (const char* fault = fault_of(config); fault[0] != '\0') {
      return refuse(groma_Result_RESULT_INVALID, fault);
    }
    std::array<std::uint8_t, kMaxConfigBytes> blob{};
    const std::size_t size = encode_config(config, blob);
    const bool stored = size != 0 && store_off_the_air(std::span(blob).first(size));
    std::array<std::uint8_t, kMaxConfigBytes> back{};
    const bool kept = stored && platform_.load_config(back) == size && back == blob;
    if (kept) {
      reply(groma_Result_RESULT_OK, "", decode_config(std::span(back).first(size)));
    } else {
      refuse(groma_Result_RESULT_STORAGE, "not stored: write it again");
    }
    resume();
  }

  void apply_config() noexcept {
    const auto config = load_config();
    if (!config) return refuse(groma_Result_RESULT_INVALID, "no valid configuration is stored: write one");
    reply(groma_Result_RESULT_OK, "", config);
    leave();
    config_ = config;
    choose_link();
    bring_radio_up();
    send_hello();
  }

  void factory_reset() noexcept {
    std::array<std::uint8_t, kMaxConfigBytes> back{};
    if (!store_off_the_air({}) || platform_.load_config(back) != 0) {
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

  std::optional<groma_Config> config_;  // in force
  // The one that the role asks for, while the node is on the air.
  std::optional<mac::Tag> tag_;
  std::optional<mac::Anchor> anchor_;
  mac::SyncState sync_state_ = mac::SyncState::kSearching;
  const mac::Exchange* completed_ = nullptr;
  std::uint32_t proven_superframe_ = 0;  // the one under way at the last proof of life
  std::uint32_t report_sequence_ = 0;
  const char* link_error_ = "";
  groma_Counters counters_ = groma_Counters_init_zero;
  std::uint32_t undecodable_ = 0;  // whole frames from the host that held no message

  wire::FrameDecoder decoder_;
  MessageEncoder encoder_;
  groma_NodeToHost message_ = groma_NodeToHost_init_zero;
  groma_HostToNode command_ = groma_HostToNode_init_zero;

  std::uint64_t radio_deadline_us_ = kNever_us;
  std::uint64_t quiet_until_us_ = 0;
  std::uint64_t next_listening_us_ = kNever_us;  // while unconfigured
  std::uint64_t next_telemetry_us_ = kNever_us;
  std::uint64_t identify_until_us_ = kNever_us;
};

}  // namespace groma::node
