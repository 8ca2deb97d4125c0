#include "host/provision/node_client.hpp"

#include <fmt/format.h>
#include <poll.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstddef>
#include <random>
#include <span>
#include <utility>
#include <vector>

namespace groma::provision {

namespace {

using Clock = std::chrono::steady_clock;

double since(Clock::time_point begin) {
  return std::chrono::duration<double>(Clock::now() - begin).count();
}

}  // namespace

NodeClient::NodeClient(std::unique_ptr<link::ByteLink> link, model::NodeId target)
    : link_(std::move(link)), request_id_(std::random_device{}()), target_(target) {
  std::array<std::uint8_t, 4096> old{};
  // At most as much as a system buffers, so that a node that sends without end cannot block here.
  for (int i = 0; i < 64; ++i) {
    const link::ReadResult result = link_->read(old);
    gone_ = result.gone;
    if (result.bytes == 0 || gone_) break;
  }
}

void NodeClient::on_hello(const groma_Hello& hello) {
  if (target_ != 0) at_link_ = hello.id == target_;
  if (target_ == 0 || at_link_) hello_ = hello;
}

void NodeClient::on_counters(const groma_Counters& counters) {
  if (target_ == 0 || at_link_) counters_ = counters;
}

void NodeClient::on_slack(const groma_Slack& slack) {
  if (target_ == 0 || at_link_) slack_ = slack;
}

// From the node at the link, also about a target that it did not reach.
void NodeClient::on_reply(const groma_Reply& reply) {
  if (reply.request_id != request_id_) return;
  if (link::number_in(reply.result) == groma_Result_RESULT_PENDING) {
    pending_ = true;
  } else {
    reply_ = reply;
  }
}

void NodeClient::on_relayed(const groma_NodeToHost& message) {
  if (message.source_id != target_) return;
  switch (message.which_body) {
    case groma_NodeToHost_hello_tag:
      hello_ = message.body.hello;
      break;
    case groma_NodeToHost_counters_tag:
      counters_ = message.body.counters;
      break;
    case groma_NodeToHost_slack_tag:
      slack_ = message.body.slack;
      break;
    case groma_NodeToHost_survey_report_tag:
      survey_ = message.body.survey_report;
      break;
    case groma_NodeToHost_reply_tag:
      if (message.body.reply.request_id == request_id_) reply_ = message.body.reply;
      break;
    default:
      break;
  }
}

bool NodeClient::unreachable() const {
  return reply_ && link::number_in(reply_->result) == groma_Result_RESULT_UNREACHABLE;
}

bool NodeClient::repeat(const groma_HostToNode& command, const Patience& patience,
                        const std::function<bool()>& done) {
  // Several commands may be queued before this one; the node gives each up after a while.
  constexpr double kMaxPending_s = 120.0;
  // The node at the link synchronizes within this time after it started or was configured.
  constexpr double kMaxUnsynchronized_s = 10.0;
  constexpr double kPause_s = 0.2;
  const Clock::time_point begin = Clock::now();
  bool under_way = false;
  reply_.reset();
  for (int i = 0; i < patience.tries && !gone_; ++i) {
    pending_ = false;
    if (!send(command)) continue;
    const bool over = wait(patience.answer_s, [&] { return done() || unreachable(); });
    under_way = under_way || pending_;
    // Reported unreachable without an attempt: the node at the link is not synchronized yet.
    if (over && unreachable() && !under_way && since(begin) < kMaxUnsynchronized_s) {
      (void)wait(kPause_s, [] { return false; });
      reply_.reset();
      i = -1;
      continue;
    }
    if (over) return done();
    if (pending_ && since(begin) < kMaxPending_s) i = -1;
  }
  return false;
}

std::optional<groma_Reply> NodeClient::ask(groma_HostToNode command, const Patience& patience) {
  command.request_id = ++request_id_;
  (void)repeat(command, patience, [this] { return reply_.has_value(); });
  return reply_;
}

std::optional<groma_Hello> NodeClient::ask_hello(const HelloTest& wanted, const Patience& patience) {
  hello_.reset();
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_get_hello_tag;
  command.request_id = ++request_id_;
  const bool heard = repeat(command, patience, [&] {
    if (hello_ && wanted(*hello_)) return true;
    // The next hello may differ. Use a new request_id, as the target repeats its stored answer for an old
    // one.
    if (target_ != 0 && hello_ && reply_) {
      command.request_id = ++request_id_;
      reply_.reset();
    }
    return false;
  });
  return heard ? hello_ : std::nullopt;
}

std::optional<groma_Counters> NodeClient::ask_counters(const Patience& patience) {
  counters_.reset();
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_get_counters_tag;
  command.request_id = ++request_id_;
  (void)repeat(command, patience, [this] { return counters_.has_value() && reply_.has_value(); });
  return counters_;
}

std::optional<groma_Slack> NodeClient::ask_slack(const Patience& patience) {
  slack_.reset();
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_get_slack_tag;
  command.request_id = ++request_id_;
  (void)repeat(command, patience, [this] {
    return reply_ && (slack_ || link::number_in(reply_->result) != groma_Result_RESULT_OK);
  });
  return slack_;
}

std::optional<groma_Hello> NodeClient::ask_hello(const Patience& patience) {
  return ask_hello([](const groma_Hello& /*any*/) { return true; }, patience);
}

std::optional<NodeClient::Survey> NodeClient::ask_survey(std::uint16_t exchanges, const Patience& patience) {
  survey_.reset();
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = groma_HostToNode_survey_tag;
  command.body.survey.exchanges = exchanges;
  const auto reply = ask(command, patience);
  if (!reply) return std::nullopt;
  return Survey{*reply, survey_.value_or(groma_SurveyReport groma_SurveyReport_init_zero)};
}

bool NodeClient::send(const groma_HostToNode& addressed) {
  groma_HostToNode command = addressed;
  command.target_id = target_;
  const std::vector<std::uint8_t> frame = link::request_frame(command);
  if (frame.empty()) return false;
  std::span<const std::uint8_t> left = frame;
  constexpr double kMaxSend_s = 1.0;
  return wait(kMaxSend_s, [&] {
    left = left.subspan(std::min(link_->write(left), left.size()));
    return left.empty();
  });
}

bool NodeClient::wait(double max_s, const std::function<bool()>& done) {
  constexpr double kStep_s = 0.02;  // between two calls of `done`, such as attempts to write
  const Clock::time_point begin = Clock::now();
  while (!done()) {
    const double left_s = max_s - since(begin);
    if (gone_ || left_s <= 0.0) return false;
    pollfd entry{link_->poll_fd(), POLLIN, 0};
    (void)::poll(&entry, 1, static_cast<int>(std::ceil(std::min(left_s, kStep_s) * 1e3)));
    read();
  }
  return true;
}

void NodeClient::read() {
  std::array<std::uint8_t, 4096> chunk{};
  const link::ReadResult result = link_->read(chunk);
  bytes_ += result.bytes;
  decoder_.take(std::span(chunk).first(result.bytes),
                std::chrono::duration<double>(Clock::now().time_since_epoch()).count(), *this);
  gone_ = result.gone;
}

std::string NodeClient::explain_silence() const {
  if (unreachable()) {
    return fmt::format(
        "no answer from node {} over the air ({}); check that it has power, was configured by its cable once "
        "and has the same schedule, and that a node that relays the beacon is in its reach",
        target_, reply_->text);
  }
  if (gone_) return "the port went away; plug it in again and repeat the command";
  if (bytes_ == 0) {
    return "no answer, not a byte; check that the node has power and is flashed ('groma flash'), that its TX "
           "and RX are crossed over, and the bit rate";
  }
  const wire::FrameCounters& frames = decoder_.frame_counters();
  if (frames.frames == 0 && frames.version_errors > 0) {
    return "no answer, and frames of another version; flash the image of this release ('groma flash')";
  }
  if (frames.frames == 0) {
    return "no answer, and bytes that are not frames; check the bit rate (link.baud of the plan), and that "
           "this port is a node's";
  }
  return "reports come, but no answer; check the line to the node's RX, and that no other program reads this "
         "port";
}

}  // namespace groma::provision
