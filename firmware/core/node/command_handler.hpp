// Carries out commands: docs/reference/wire.md lists them.
#pragma once

#include <pb_decode.h>

#include <cstdint>
#include <optional>
#include <span>

#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/configuration.hpp"
#include "groma.pb.h"

namespace groma::node {

template <Platform P>
class CommandHandler {
 public:
  // The part of a command that would cut its answer off.
  struct Rest {
    pb_size_t command = 0;  // as which_body; 0: nothing
    std::uint32_t trial_s = 0;
  };

  // Keeps the references.
  CommandHandler(Shared<P>& shared, RadioExecutor<P>& radio, Reporter<P>& reports, Participation<P>& network,
                 Configuration<P>& configuration) noexcept
      : shared_(shared), radio_(radio), reports_(reports), network_(network), configuration_(configuration) {}

  // Decodes into command(); returns false if it is not a command.
  bool read(std::span<const std::uint8_t> payload) noexcept {
    command_ = groma_HostToNode_init_zero;
    pb_istream_t stream = pb_istream_from_buffer(payload.data(), payload.size());
    return pb_decode(&stream, groma_HostToNode_fields, &command_);
  }
  [[nodiscard]] const groma_HostToNode& command() const noexcept { return command_; }

  // Carries out command() and answers it, except for a survey, which is answered at its end. Pass the result
  // to finish() once the answer is out.
  [[nodiscard]] Rest carry_out(const ReplyContext& to) noexcept {
    const std::optional<Outcome> outcome = act(to);
    if (!outcome) return {};
    reports_.answer(to, *outcome);
    if (outcome->result != groma_Result_RESULT_OK) return {};
    if (command_.which_body == groma_HostToNode_get_hello_tag) reports_.send_hello(to);
    if (command_.which_body == groma_HostToNode_get_counters_tag) reports_.send_counters(to);
    if (command_.which_body == groma_HostToNode_get_slack_tag) reports_.send_slack(to);
    const std::uint32_t trial_s = command_.trial_s != 0 ? command_.trial_s : Configuration<P>::kUsualTrial_s;
    // A host at the cable needs no trial.
    return {command_.which_body, to.by_air() ? trial_s : 0};
  }
  // Returns false if there is nothing to do.
  bool finish(const Rest& rest) noexcept {
    switch (rest.command) {
      case groma_HostToNode_apply_config_tag:
        configuration_.apply(rest.trial_s);
        return true;
      case groma_HostToNode_factory_reset_tag:
        configuration_.reset();
        return true;
      case groma_HostToNode_reboot_tag:
        shared_.platform.restart();
        return true;
      default:
        return false;
    }
  }
  // Becomes an anchor again.
  void end_survey() noexcept {
    shared_.survey.end();
    network_.forget();
    network_.resume();
  }

 private:
  static constexpr std::uint32_t kMaxIdentify_s = 3'600;

  // Nothing: the command has another answer than a Reply, or it follows.
  std::optional<Outcome> act(const ReplyContext& to) noexcept {
    mac::Tag* const tag = radio_.machine().tag();
    switch (command_.which_body) {
      case groma_HostToNode_get_hello_tag:
      case groma_HostToNode_get_counters_tag:
      case groma_HostToNode_get_slack_tag:
      case groma_HostToNode_reboot_tag:
        return Outcome{};
      case groma_HostToNode_read_config_tag:
        return configuration_.read();
      case groma_HostToNode_write_config_tag:
        return configuration_.write(command_.body.write_config, to.by_air());
      case groma_HostToNode_apply_config_tag:
        return check_config(configuration_.read());
      case groma_HostToNode_identify_s_tag:
        if (command_.body.identify_s > kMaxIdentify_s) return invalid("identify_s: 0 to 3600");
        network_.identify(command_.body.identify_s);
        return Outcome{};
      case groma_HostToNode_prefer_anchors_tag:
        if (tag == nullptr) return unsupported("only a tag polls anchors");
        return prefer_anchors(command_.body.prefer_anchors, tag->membership().anchors());
      case groma_HostToNode_leave_network_tag:
        if (tag == nullptr) return unsupported("only a tag has a slot to leave");
        tag->membership().leave();
        return Outcome{};
      case groma_HostToNode_survey_tag:
        return begin_survey(command_.body.survey.exchanges, to);
      case groma_HostToNode_factory_reset_tag:
        // A node that is reset could not be found again.
        if (to.by_air()) return unsupported("not over the air");
        return configuration_.erase();
      case groma_HostToNode_time_request_tag:
        // Frames wait for their slots.
        if (to.by_air()) return unsupported("not over the air");
        return send_time(to);
      default:
        return unsupported("not a command of this protocol version");
    }
  }

  std::optional<Outcome> send_time(const ReplyContext& to) noexcept {
    if (!radio_.is_up()) return unsupported("no clock: the radio is down");
    const ranging::ClockTime received = radio_.read_clock();
    groma_TimeReply& reply = reports_.begin(groma_NodeToHost_time_reply_tag).time_reply;
    reply.host_time_ns = command_.body.time_request.host_time_ns;
    reply.received_dtu = static_cast<std::uint64_t>(received.count());
    reply.transmitted_dtu = static_cast<std::uint64_t>(radio_.read_clock().count());
    reports_.send(to);
    return std::nullopt;
  }

  static Outcome check_config(const Outcome& read) noexcept {
    return read.config->empty() ? invalid("no valid configuration is stored: write one") : read;
  }

  static Outcome prefer_anchors(const groma_AnchorPreference& hint, mac::AnchorSet& anchors) noexcept {
    if (hint.ids_count != hint.weights_count) return invalid("prefer_anchors: a weight for each id");
    anchors.prefer_none();
    for (pb_size_t i = 0; i < hint.ids_count; ++i) {
      if (!anchors.knows(hint.ids[i]) && hint.weights[i] > 0) (void)anchors.announce(hint.ids[i]);
      anchors.prefer(hint.ids[i], hint.weights[i]);
    }
    return {};
  }

  std::optional<Outcome> begin_survey(std::uint32_t exchanges, const ReplyContext& to) noexcept {
    if (exchanges == 0 || exchanges > Survey::kMaxExchanges) return invalid("survey.exchanges: 1 to 200");
    const mac::Anchor* const anchor = radio_.machine().anchor();
    if (!to.by_air() || anchor == nullptr || anchor->election().leads())
      return unsupported("only over the air, to an anchor that does not lead");
    const std::uint16_t lender = shared_.air.peer();
    if (!mac::configured_slot(shared_.config->schedule, lender))
      return invalid("ask through a tag of the schedule, which lends its slot");
    // Becomes a tag.
    shared_.survey.begin(lender, exchanges, shared_.platform.now_us() + Survey::kLongest_us / 2);
    network_.forget();
    network_.resume();
    return std::nullopt;
  }

  Shared<P>& shared_;
  RadioExecutor<P>& radio_;
  Reporter<P>& reports_;
  Participation<P>& network_;
  Configuration<P>& configuration_;
  groma_HostToNode command_ = groma_HostToNode_init_zero;
};

}  // namespace groma::node
