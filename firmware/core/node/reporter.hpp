// A node's messages to its host: reports of a tag's exchanges, status and counters, logs, answers to
// commands.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <span>
#include <utility>

#include "firmware/core/node/messages.hpp"
#include "firmware/core/node/radio_executor.hpp"
#include "groma.pb.h"

namespace groma::node {

template <Platform P>
class Reporter {
 public:
  // Keeps the references; the string build.version outlives the reporter.
  Reporter(Shared<P>& shared, RadioExecutor<P>& radio, const Build& build) noexcept
      : shared_(shared), radio_(radio), build_(build) {}

  // ---- messages ------------------------------------------------------------------------------------------

  // Begins a message of this kind, after the report in progress. Returns its empty body, to be filled before
  // send().
  auto& begin(pb_size_t which) noexcept {
    finish_report();
    message_ = groma_NodeToHost_init_zero;
    message_.which_body = which;
    return message_.body;
  }
  // Sends the message that was begun. Counts one that is not accepted in reports_dropped. `config` as in
  // encode_message().
  void send(const ReplyContext& to = {}, const ReplyConfig& config = {}) noexcept {
    if (to.by_air()) {
      const std::size_t size = encode_message(message_, config, shared_.air.room());
      if (size != 0) shared_.air.append(size);
      return count(size != 0);
    }
    const auto frame = encoder_.encode(message_, config);
    const bool answers = to.way == ReplyContext::Way::kAsker;
    count(answers ? shared_.platform.link_answer(frame) : shared_.platform.link_write(frame));
  }
  void reply(const ReplyContext& to, const Outcome& outcome) noexcept {
    groma_Reply& reply = begin(groma_NodeToHost_reply_tag).reply;
    reply.request_id = to.request_id;
    reply.result = outcome.result;
    copy_text(reply.text, outcome.text);
    send(to, outcome.config);
  }
  // As reply(), and counts a command that is refused.
  void answer(const ReplyContext& to, const Outcome& outcome) noexcept {
    const bool accepted =
        outcome.result == groma_Result_RESULT_OK || outcome.result == groma_Result_RESULT_PENDING;
    if (!accepted) ++shared_.counters.commands_refused;
    reply(to, outcome);
  }
  // `text`: at most 95 characters.
  void log(groma_LogLevel level, const char* text) noexcept {
    groma_Log& log = begin(groma_NodeToHost_log_tag).log;
    log.level = level;
    copy_text(log.text, text);
    send();
  }
  // Passes on an encoded message that the node `source` sent over the air.
  void pass_on(std::span<const std::uint8_t> message, std::uint16_t source) noexcept {
    finish_report();
    count(shared_.platform.link_answer(encoder_.encode_of(message, source)));
  }

  // Configures the link of the configuration in force, or the platform's default without one.
  void choose_link() noexcept {
    link_error_ =
        shared_.platform.configure_link(shared_.config.value_or(groma_Config groma_Config_init_zero));
  }

  // ---- reports of exchanges ------------------------------------------------------------------------------

  // Begins to report an exchange, which is valid until the next one is complete. A survey takes its ranges
  // instead.
  void on_completed(const mac::Exchange& exchange) noexcept {
    finish_report();
    exchange_ = &exchange;
    ranges_left_ = exchange.count;
    step_ = &Reporter::choose_anchors;
    report_due_us_ = 0;
  }
  // When continue_report() is due; the maximum: no report is in progress.
  [[nodiscard]] std::uint64_t report_due_us() const noexcept {
    return exchange_ != nullptr ? report_due_us_ : kNever_us;
  }
  [[nodiscard]] bool is_reporting() const noexcept { return exchange_ != nullptr; }
  // Does the next step of the report if the radio leaves time for it.
  void continue_report(std::uint64_t now_us) noexcept {
    constexpr std::uint64_t kLongestStep_us = 100;
    if (now_us < report_due_us()) return;
    if (radio_.has_idle_time(now_us, kLongestStep_us)) {
      report_step();
    } else {
      report_due_us_ = now_us + kLongestStep_us;
    }
  }
  void finish_report() noexcept {
    while (exchange_ != nullptr) report_step();
  }
  void drop_report() noexcept { exchange_ = nullptr; }

  // ---- what a node reports of itself ---------------------------------------------------------------------

  void send_hello(const ReplyContext& to = {}) noexcept {
    groma_Hello& hello = begin(groma_NodeToHost_hello_tag).hello;
    P& platform = shared_.platform;
    fill_hello(hello, build_, shared_.config, platform.reset_reason(), platform.last_fault(),
               platform.stack_use(), describe(radio_.state()));
    hello.boot_count = platform.boot_count();
    copy_text(hello.link_error, link_error_);
    copy_text(hello.radio_warning, radio_.driver().warning());
    send(to);
  }

  void send_counters(const ReplyContext& to = {}) noexcept {
    groma_Counters& counters = begin(groma_NodeToHost_counters_tag).counters;
    shared_.platform.count_link(shared_.counters);
    shared_.counters.pll_flags = radio_.driver().pll_flags();
    counters = shared_.counters;
    send(to);
  }

  void send_slack(const ReplyContext& to) noexcept {
    radio_.slack().fill(begin(groma_NodeToHost_slack_tag).slack);
    send(to);
  }

  // A node that is not on the air has no status.
  void send_status() noexcept {
    Machine& machine = radio_.machine();
    const mac::Station* const member = machine.station();
    if (member == nullptr) return;
    groma_NetworkStatus& status = begin(groma_NodeToHost_network_status_tag).network_status;
    status.state = static_cast<groma_SyncState>(member->sync().state());
    status.superframe = machine.superframe();
    status.skew_ppb = -member->sync().skew_ppb();
    status.beacons_missed = member->sync().missed_in_a_row();
    if (const auto& ambient = radio_.ambient()) {
      status.has_temperature_cdegc = status.has_supply_mv = true;
      status.temperature_cdegc = ambient->temperature_cdegc;
      status.supply_mv = ambient->supply_mv;
    }
    if (const auto network_time = member->network_time(radio_.latest())) {
      status.master_id = member->election().master();
      status.hop = member->election().hop();
      status.session = member->election().session();
      status.network_time_dtu = static_cast<std::uint64_t>(network_time->count());
    }
    if (const mac::Tag* tag = machine.tag()) {
      const mac::TagMembership& membership = tag->membership();
      const auto slot = membership.slot(machine.superframe());
      status.has_slot = slot.has_value();
      status.slot = static_cast<std::uint8_t>(slot.value_or(0));
      status.candidates = static_cast<std::uint32_t>(membership.anchors().size());
      status.answering = static_cast<std::uint32_t>(membership.anchors().answering());
    } else if (const mac::Anchor* anchor = machine.anchor()) {
      const auto owners = anchor->membership().slots().owners();
      std::copy(owners.begin(), owners.end(), status.holders);
      status.holders_count = static_cast<pb_size_t>(owners.size());
    }
    send();
  }

  // Call once a second: logs once for each period of seconds in which the schedule leaves this node too
  // little time.
  void warn_if_late() noexcept {
    constexpr std::uint32_t kMany = 10;
    const std::uint32_t late = shared_.counters.late_transmits + shared_.counters.late_receives;
    const bool many = late - late_before_ > kMany;
    if (many && !were_late_) {
      log(groma_LogLevel_LOG_WARNING, "late for the schedule: lengthen its turnaround or gap");
    }
    late_before_ = late;
    were_late_ = many;
  }

 private:
  void count(bool accepted) noexcept {
    if (!accepted) ++shared_.counters.reports_dropped;
  }

  // A report in steps of about 50 us at 64 MHz: each sets the next one, the last ends the report.
  void report_step() noexcept { (this->*step_)(); }
  void choose_anchors() noexcept {
    if (mac::Tag* tag = radio_.machine().tag()) tag->choose_anchors();
    step_ = &Reporter::begin_report;
    // The survey is ended where the machine may be changed.
    if (shared_.survey.under_way()) shared_.survey.add(*std::exchange(exchange_, nullptr));
  }
  void begin_report() noexcept {
    message_ = groma_NodeToHost_init_zero;
    message_.which_body = groma_NodeToHost_slot_report_tag;
    groma_SlotReport& report = message_.body.slot_report;
    report.sequence = sequence_++;
    report.tag_id = shared_.config->id;
    report_time_ = radio_.read_clock();
    begin_slot_report(report, *exchange_, report_time_);
    const mac::Station* member = radio_.machine().station();
    const auto network_time = member != nullptr ? member->network_time(report_time_) : std::nullopt;
    if (network_time) {
      report.network_time_dtu = static_cast<std::uint64_t>(network_time->count());
      report.network_rate_ppb = -member->sync().skew_ppb();
    }
    encoder_.begin(report);
    step_ = &Reporter::put_range;
  }
  // The ranges from the last to the first.
  void put_range() noexcept {
    groma_SlotReport& report = message_.body.slot_report;
    if (ranges_left_ == 0) {
      is_compact() ? make_compact(message_) : encoder_.close(report);
      step_ = is_compact() ? &Reporter::send_compact : &Reporter::send_in_pieces;
      return;
    }
    const std::size_t index = --ranges_left_;
    fill_range(report, index, *exchange_, report_time_, *shared_.config, radio_.ambient(), shared_.counters);
    if (!is_compact()) encoder_.put_range(report.ranges[index]);
  }
  void send_compact() noexcept {
    exchange_ = nullptr;
    send();
  }
  void send_in_pieces() noexcept {
    if (!encoder_.step()) return;
    exchange_ = nullptr;
    count(shared_.platform.link_write(encoder_.frame()));
  }

  // Classic CAN has room for compact reports only.
  [[nodiscard]] bool is_compact() const noexcept { return shared_.config->link == groma_Link_LINK_CAN; }

  Shared<P>& shared_;
  RadioExecutor<P>& radio_;
  Build build_;
  const char* link_error_ = "";
  MessageEncoder encoder_;
  groma_NodeToHost message_ = groma_NodeToHost_init_zero;
  const mac::Exchange* exchange_ = nullptr;  // the report in progress
  void (Reporter::*step_)() noexcept = nullptr;
  std::size_t ranges_left_ = 0;
  ranging::ClockTime report_time_;
  std::uint64_t report_due_us_ = 0;
  std::uint32_t sequence_ = 0;     // of the next report
  std::uint32_t late_before_ = 0;  // transmissions and receptions, at the last warn_if_late()
  bool were_late_ = false;
};

}  // namespace groma::node
