// Commands to one node over its link, and its answers. Bytes may be lost both ways, and the node's reports
// stream in between: a command is sent again until its reply came, which its number tells. The node at the
// link passes on what is for another one, over the air; it tells that it is at it, and when it gave up.
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

// How long an answer is waited for, and how often the command is sent in all.
struct Patience {
  double answer_s = 0.5;
  int tries = 5;
};

// Storing may take a node a few page erases.
inline constexpr Patience kStoringPatience{1.0, 6};

class NodeClient : private link::NodeSink {
 public:
  // What is waiting on the link already is thrown away: it answers nobody's question. `target`: the node that
  // is spoken to, over the air if it is not the one at the link; 0: the one at the link, whoever it is.
  explicit NodeClient(std::unique_ptr<link::ByteLink> link, model::NodeId target = 0);
  void set_target(model::NodeId target) noexcept {
    target_ = target;
    at_link_ = false;
  }

  // The command's request_id is set here. Nothing where no reply came: silence() tells why. Every command of
  // the schema may be sent twice without harm.
  [[nodiscard]] std::optional<groma_Reply> ask(groma_HostToNode command, const Patience& patience = {});

  // Asks for a hello until one is as wanted. Nothing where none was: last_hello() is then the last that came,
  // if any.
  using HelloTest = std::function<bool(const groma_Hello&)>;
  [[nodiscard]] std::optional<groma_Hello> ask_hello(const HelloTest& wanted, const Patience& patience = {});
  [[nodiscard]] std::optional<groma_Hello> ask_hello(const Patience& patience = {});
  [[nodiscard]] const std::optional<groma_Hello>& last_hello() const noexcept { return hello_; }

  // Nothing where none came.
  [[nodiscard]] std::optional<groma_Counters> ask_counters(const Patience& patience = {});

  struct Survey {
    groma_Reply reply = groma_Reply_init_zero;
    groma_SurveyReport report = groma_SurveyReport_init_zero;  // of a good reply
  };
  // Nothing where no reply came.
  [[nodiscard]] std::optional<Survey> ask_survey(std::uint16_t exchanges, const Patience& patience = {});

  // The link was unplugged or hung up: nothing more will come.
  [[nodiscard]] bool gone() const noexcept { return gone_; }

  // Why no answer came and what to do, by what did come.
  [[nodiscard]] std::string silence() const;

 private:
  void on_range(const model::RangeSample& /*range*/) override {}
  void on_hello(const groma_Hello& hello) override;
  void on_counters(const groma_Counters& counters) override;
  void on_reply(const groma_Reply& reply) override;
  void on_relayed(const groma_NodeToHost& message) override;

  // Sends it until `done` or the final reply of a target that cannot be reached.
  bool repeat(const groma_HostToNode& command, const Patience& patience, const std::function<bool()>& done);
  [[nodiscard]] bool unreachable() const;
  [[nodiscard]] bool send(const groma_HostToNode& command);
  // Reads until `done` or for so long; true: done.
  [[nodiscard]] bool wait(double most_s, const std::function<bool()>& done);
  void read();

  std::unique_ptr<link::ByteLink> link_;
  link::ReportDecoder decoder_{0};
  std::uint32_t request_id_;
  std::optional<groma_Reply> reply_;  // to request_id_
  std::optional<groma_Hello> hello_;
  std::optional<groma_Counters> counters_;
  std::optional<groma_SurveyReport> survey_;
  model::NodeId target_;
  bool at_link_ = false;  // the target is the one at the link
  bool pending_ = false;  // since the last sending
  std::uint64_t bytes_ = 0;
  bool gone_ = false;
};

}  // namespace groma::provision
