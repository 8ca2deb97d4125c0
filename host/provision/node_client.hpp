// Sends commands to one node over its link and receives the answers. Bytes may be lost both ways, and the
// node's reports arrive in between. A command is repeated until the reply with its request_id arrives. The
// node at the link passes commands for another node on over the air, and reports RESULT_PENDING and
// RESULT_UNREACHABLE.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include "groma.pb.h"
#include "host/link/byte_link.hpp"
#include "host/link/report_decoder.hpp"
#include "host/model/types.hpp"

namespace groma::provision {

// How long to wait for an answer, and how often to send the command in total.
struct Patience {
  double answer_s = 0.5;
  int tries = 5;
};

// Storing may take several page erases.
inline constexpr Patience kStoringPatience{1.0, 6};

class NodeClient : private link::NodeSink {
 public:
  // Discards the bytes that wait on the link already. `target`: the node to address, over the air unless it
  // is the node at the link; 0: the node at the link, whatever its id.
  explicit NodeClient(std::unique_ptr<link::ByteLink> link, model::NodeId target = 0);
  void set_target(model::NodeId target) noexcept {
    target_ = target;
    at_link_ = false;
  }

  // Sets the command's request_id. Nothing if no reply came: see explain_silence(). Every command of the
  // schema may be sent twice without harm.
  [[nodiscard]] std::optional<groma_Reply> ask(groma_HostToNode command, const Patience& patience = {});

  // Requests a hello until one passes the test. Otherwise nothing; last_hello() is then the last one
  // received, if any.
  using HelloTest = std::function<bool(const groma_Hello&)>;
  [[nodiscard]] std::optional<groma_Hello> ask_hello(const HelloTest& wanted, const Patience& patience = {});
  [[nodiscard]] std::optional<groma_Hello> ask_hello(const Patience& patience = {});
  [[nodiscard]] const std::optional<groma_Hello>& last_hello() const noexcept { return hello_; }

  // Nothing if no counters came.
  [[nodiscard]] std::optional<groma_Counters> ask_counters(const Patience& patience = {});

  // Nothing if no answer came, or the node's firmware does not measure it.
  [[nodiscard]] std::optional<groma_Slack> ask_slack(const Patience& patience = {});

  struct Survey {
    groma_Reply reply = groma_Reply_init_zero;
    groma_SurveyReport report = groma_SurveyReport_init_zero;  // valid with a good reply
  };
  // Nothing if no reply came.
  [[nodiscard]] std::optional<Survey> ask_survey(std::uint16_t exchanges, const Patience& patience = {});

  // The link was unplugged or hung up.
  [[nodiscard]] bool gone() const noexcept { return gone_; }

  // Explains why no answer came and what to do, from the bytes that did come.
  [[nodiscard]] std::string explain_silence() const;

 private:
  void on_range(const model::RangeSample& /*range*/) override {}
  void on_hello(const groma_Hello& hello) override;
  void on_counters(const groma_Counters& counters) override;
  void on_slack(const groma_Slack& slack) override;
  void on_reply(const groma_Reply& reply) override;
  void on_relayed(const groma_NodeToHost& message) override;

  // Sends the command until `done`, or until the target is reported as unreachable.
  bool repeat(const groma_HostToNode& command, const Patience& patience, const std::function<bool()>& done);
  [[nodiscard]] bool unreachable() const;
  [[nodiscard]] bool send(const groma_HostToNode& command);
  // Reads until `done`, at most max_s; true: done.
  [[nodiscard]] bool wait(double max_s, const std::function<bool()>& done);
  void read();

  std::unique_ptr<link::ByteLink> link_;
  link::ReportDecoder decoder_{0};
  std::uint32_t request_id_;
  std::optional<groma_Reply> reply_;  // to request_id_
  std::optional<groma_Hello> hello_;
  std::optional<groma_Counters> counters_;
  std::optional<groma_Slack> slack_;
  std::optional<groma_SurveyReport> survey_;
  model::NodeId target_;
  bool at_link_ = false;  // the target is the node at the link
  bool pending_ = false;  // RESULT_PENDING came since the last send
  std::uint64_t bytes_ = 0;
  bool gone_ = false;
};

}  // namespace groma::provision
