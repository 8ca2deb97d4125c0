// Commands over the air: from the host at this node's link to another node, and from another node to this
// one.
#pragma once

#include <cstdint>
#include <span>
#include <utility>

#include "firmware/core/node/air_link.hpp"
#include "firmware/core/node/command_handler.hpp"
#include "groma.pb.h"

namespace groma::node {

template <Platform P>
class RemoteCommands {
 public:
  // Keeps the references.
  RemoteCommands(Shared<P>& shared, Reporter<P>& reports, Configuration<P>& configuration,
                 CommandHandler<P>& commands) noexcept
      : shared_(shared), reports_(reports), configuration_(configuration), commands_(commands) {}

  // Forwards a command from the host; `payload`: the same, encoded. `in_step`: this node is synchronized.
  [[nodiscard]] Outcome ask(const groma_HostToNode& command, std::span<const std::uint8_t> payload,
                            bool in_step) noexcept {
    if (!in_step)
      return {groma_Result_RESULT_UNREACHABLE, "the wired node is not synchronized with its network"};
    const AirLink::Asked asked = air_.ask(command.target_id, command.request_id, payload);
    if (asked == AirLink::Asked::kTooLong) return invalid("too long to go over the air");
    if (asked == AirLink::Asked::kBusy) return {groma_Result_RESULT_PENDING, "waiting for another command"};
    shared_.lent_until_us.reset();
    if (command.which_body == groma_HostToNode_survey_tag) lend(Survey::kLongest_us);
    return {groma_Result_RESULT_PENDING};
  }

  // Handles what came over the air since the last call.
  void serve() noexcept {
    if (shared_.survey.is_complete()) end_survey();
    switch (air_.take_event()) {
      case AirLink::Event::kNone:
        return;
      case AirLink::Event::kCommand:
        return carry_out();
      case AirLink::Event::kAnswer:
        return pass_answer_on();
      case AirLink::Event::kNoAnswer:
        if (shared_.lent_until_us) lend(kLentOn_us);
        return reply({groma_Result_RESULT_UNREACHABLE, "no answer over the air"});
      case AirLink::Event::kDelivered:
        if (!finish()) configuration_.on_delivered();
        return;
      case AirLink::Event::kUndelivered:
        // The asking node may have received the answer and then left the air; a trial repairs a wrong guess.
        finish();
    }
  }

  // Call about each second.
  void on_second(std::uint64_t now_us) noexcept {
    air_.on_second();
    serve();
    if (air_.asking()) reply({groma_Result_RESULT_PENDING});
    if (shared_.lent_until_us && now_us >= *shared_.lent_until_us) shared_.lent_until_us.reset();
    if (shared_.survey.is_overdue(now_us)) end_survey();
  }

 private:
  // The slot stays lent for so long after a survey that was not answered.
  static constexpr std::uint64_t kLentOn_us = 5'000'000;

  void lend(std::uint64_t duration_us) noexcept {
    shared_.lent_until_us = shared_.platform.now_us() + duration_us;
  }
  // To the command that this node's host sent last.
  void reply(const Outcome& outcome) noexcept {
    reports_.reply(ReplyContext::link(air_.request_id()), outcome);
  }
  void pass_answer_on() noexcept {
    shared_.lent_until_us.reset();
    auto answer = air_.message();
    while (const auto message = AirLink::next_message(answer)) reports_.pass_on(*message, air_.peer());
  }

  void carry_out() noexcept {
    // A new command shows that the answer to the one before has arrived.
    finish();
    const bool whole = commands_.read(air_.message());
    asker_ = ReplyContext::air(commands_.command().request_id);
    air_.begin_answer();
    if (whole) {
      rest_ = commands_.carry_out(asker_);
    } else {
      reports_.answer(asker_, invalid("not a command of this protocol version"));
    }
    if (!shared_.survey.under_way()) air_.send_answer();
  }
  bool finish() noexcept { return commands_.finish(std::exchange(rest_, {})); }

  void end_survey() noexcept {
    air_.begin_answer();
    shared_.survey.fill(reports_.begin(groma_NodeToHost_survey_report_tag).survey_report);
    reports_.send(asker_);
    reports_.reply(asker_, {});
    air_.send_answer();
    commands_.end_survey();
  }

  Shared<P>& shared_;
  Reporter<P>& reports_;
  Configuration<P>& configuration_;
  CommandHandler<P>& commands_;
  AirLink& air_ = shared_.air;
  ReplyContext asker_;                       // of the last command over the air
  typename CommandHandler<P>::Rest rest_{};  // of that command
};

}  // namespace groma::node
