#include "host/provision/configure.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <chrono>
#include <memory>
#include <span>
#include <string>
#include <thread>
#include <tuple>
#include <utility>

#include "firmware/core/mac/superframe.hpp"
#include "firmware/core/node/config.hpp"
#include "firmware/core/node/messages.hpp"
#include "host/link/report_decoder.hpp"
#include "host/provision/node_client.hpp"

namespace groma::provision {

namespace {

// The node restarts its radio, and retries that after a second.
constexpr Patience kApplyingPatience{1.0, 5};

NodeFault fault_of_link(link::LinkFault fault) {
  switch (fault) {
    case link::LinkFault::kPermission:
      return NodeFault::kPermission;
    case link::LinkFault::kBusy:
      return NodeFault::kBusy;
    case link::LinkFault::kUnsuitable:
      return NodeFault::kUnsuitable;
    default:
      return NodeFault::kNoPort;
  }
}

struct Failure {
  NodeFault fault;
  std::string problem;
};

groma_HostToNode command_of(pb_size_t which) {
  groma_HostToNode command = groma_HostToNode_init_zero;
  command.which_body = which;
  return command;
}

// Throws Failure if the link cannot be opened.
std::unique_ptr<NodeClient> connect(const std::string& port, unsigned baud, const LinkOpener& open,
                                    model::NodeId target = 0) {
  link::OpenedLink opened = open(port, baud);
  if (!opened.link) throw Failure{fault_of_link(opened.error.fault), opened.error.message};
  return std::make_unique<NodeClient>(std::move(opened.link), target);
}

// `remedy`: for a command that the node refuses.
groma_Reply expect_reply(const NodeClient& client, const std::optional<groma_Reply>& reply,
                         const char* command,
                         const char* remedy = "correct the plan, or flash the image of this release") {
  if (!reply) throw Failure{NodeFault::kNoAnswer, client.explain_silence()};
  switch (link::number_in(reply->result)) {
    case groma_Result_RESULT_OK:
      return *reply;
    case groma_Result_RESULT_UNREACHABLE:
      throw Failure{NodeFault::kNoAnswer, client.explain_silence()};
    case groma_Result_RESULT_STORAGE:
      throw Failure{NodeFault::kStorage,
                    fmt::format("{} failed ({}); repeat it, and replace the node if that does not help",
                                command, reply->text)};
    default:
      throw Failure{NodeFault::kRefused, fmt::format("refuses to {}: {}; {}", command, reply->text, remedy)};
  }
}

// What a site has to do whose nodes hold another timing of the same epoch, because the plan or the defaults
// of its keys have changed; empty: nothing.
std::string advice_on(const groma_Config& stored, const groma_Config& wanted) {
  const groma_Schedule& is = stored.schedule;
  const groma_Schedule& should_be = wanted.schedule;
  const auto timing = [](const groma_Schedule& of) {
    return std::tuple(of.turn_round_us, of.response_gap_us, of.guard_us, of.arm_ahead);
  };
  if (!stored.has_schedule || is.epoch != should_be.epoch || timing(is) == timing(should_be)) return {};
  // Images before arm-ahead was an option always armed ahead.
  const bool tight = !is.arm_ahead && is.response_gap_us < mac::usual_gap_us(false, false);
  return fmt::format(
      "the nodes have ranged with turn_round_us: {}, response_gap_us: {}, guard_us: {}; the plan says {}, "
      "{}, {}. Nodes "
      "of both schedules do not hear each other: increase schedule.epoch above {}, and configure all nodes "
      "of the "
      "site. To keep the old timing, write those values into the plan's schedule{}",
      is.turn_round_us, is.response_gap_us, is.guard_us, should_be.turn_round_us, should_be.response_gap_us,
      should_be.guard_us, is.epoch, tight ? ", with arm_ahead: true" : "");
}

// Configures one node.
class Configuring {
 public:
  Configuring(const PlannedNode& node, unsigned baud, const ConfigureOptions& options, NodeOutcome& outcome)
      : node_(node),
        baud_(baud),
        options_(options),
        outcome_(outcome),
        wanted_hash_(node::config_hash_of(node.config)) {}

  // Throws Failure.
  void run() {
    write_if_needed();
    if (!in_force(*outcome_.hello)) apply();
    check_health();
  }

  // The steps of run() one by one, with the link closed in between; each throws Failure.
  void write_if_needed() {
    reach();
    check_release();
    check_build();
    check_identity();
    report_step("reads");
    const groma_Reply stored =
        expect_reply(*client_, client_->ask(command_of(groma_HostToNode_read_config_tag)), "read_config");
    if (stored.has_config && outcome_.advice.empty()) outcome_.advice = advice_on(stored.config, wanted());
    if (!stored.has_config || !differences(stored.config, wanted()).empty()) write();
  }
  void close_link() { client_.reset(); }
  [[nodiscard]] bool has_to_apply() const { return !in_force(*outcome_.hello); }
  [[nodiscard]] bool changes_schedule() const {
    return outcome_.hello->schedule_hash != node::schedule_hash_of(node_.config);
  }
  // The node reverts to its old configuration unless check_after_trial() reaches it within `trial_s`.
  void apply_on_trial(std::uint32_t trial_s) {
    report_step("applies");
    outcome_.changed = true;
    client_ = connect(outcome_.port, baud_, options_.open, node_.id);
    groma_HostToNode command = command_of(groma_HostToNode_apply_config_tag);
    command.trial_s = static_cast<std::uint16_t>(trial_s);
    (void)expect_reply(*client_, client_->ask(command, kStoringPatience), "apply_config");
  }
  void check_after_trial(double max_s) {
    using Clock = std::chrono::steady_clock;
    client_ = connect(outcome_.port, baud_, options_.open, node_.id);
    const Clock::time_point begin = Clock::now();
    for (;;) {
      if (client_->ask_hello([this](const groma_Hello& said) { return in_force(said); })) break;
      const bool late = std::chrono::duration<double>(Clock::now() - begin).count() > max_s;
      if (late || client_->gone()) {
        if (client_->last_hello()) throw not_in_force(*client_->last_hello());
        throw Failure{NodeFault::kNoAnswer, client_->explain_silence() +
                                                "; it will revert to its previous configuration by itself"};
      }
      std::this_thread::sleep_for(std::chrono::milliseconds(200));
    }
    outcome_.hello = client_->last_hello();
    check_health();
  }

  void check_health() const {
    const groma_Hello& hello = *outcome_.hello;
    if (hello.radio_error[0] != '\0') {
      throw Failure{
          NodeFault::kRadio,
          fmt::format("is configured, but its DW1000 did not come up ({}); switch it off and on, and "
                      "replace the module if that does not help",
                      hello.radio_error)};
    }
    if (hello.link_error[0] != '\0') {
      throw Failure{
          NodeFault::kLink,
          fmt::format("is configured, but its CAN controller did not come up ({}); check its wiring, see "
                      "docs/how-to/flash.md",
                      hello.link_error)};
    }
    if (!by_air() && !node_.can_link.empty() && outcome_.port != node_.can_link) check_bus();
  }

 private:
  void report_step(const char* step) const {
    if (options_.progress) options_.progress(step);
  }

  // The key is never sent over the air, where anyone could read it.
  [[nodiscard]] groma_Config wanted() const {
    groma_Config config = node_.config;
    if (by_air()) config.network_key.size = 0;
    return config;
  }
  [[nodiscard]] bool by_air() const { return is_reached_by_air(node_); }

  void reach_by_air() {
    outcome_.port = node_.via_port;
    client_ = connect(outcome_.port, baud_, options_.open);
    if (!client_->ask_hello()) throw Failure{NodeFault::kNoAnswer, client_->explain_silence()};
    client_->set_target(node_.id);
    outcome_.hello = client_->ask_hello();
    if (!outcome_.hello) throw Failure{NodeFault::kNoAnswer, client_->explain_silence()};
  }

  void reach() {
    report_step("asks");
    if (by_air()) return reach_by_air();
    outcome_.port = node_.port.empty() ? node_.can_link : node_.port;
    if (outcome_.port.empty()) {
      throw Failure{NodeFault::kNotInPlan, "the plan names no port for it; add 'port:' to the node"};
    }
    link::OpenedLink opened = options_.open(outcome_.port, baud_);
    const bool unplugged = !opened.link && opened.error.fault == link::LinkFault::kNoDevice;
    if (unplugged && !node_.can_link.empty() && !node_.port.empty()) {
      // The serial port is needed for the first configuration only; later the node may be on the bus alone.
      if (link::OpenedLink bus = options_.open(node_.can_link, baud_); bus.link) {
        opened = std::move(bus);
        outcome_.port = node_.can_link;
      }
    }
    if (!opened.link) throw Failure{fault_of_link(opened.error.fault), opened.error.message};
    client_ = std::make_unique<NodeClient>(std::move(opened.link));
    outcome_.hello = client_->ask_hello();
    if (outcome_.hello) return;
    throw Failure{
        NodeFault::kNoAnswer,
        outcome_.port == node_.can_link
            ? client_->explain_silence() +
                  "; a node that was never configured is reached by its UART alone: name that as 'port:'"
            : client_->explain_silence()};
  }

  void check_release() const {
    const std::uint32_t spoken = outcome_.hello->protocol_version;
    if (spoken == node::kProtocolVersion) return;
    throw Failure{
        NodeFault::kOtherProtocol,
        fmt::format("its firmware {} speaks protocol {}, this program {}; flash the image of this release "
                    "('groma flash')",
                    outcome_.hello->version, spoken, node::kProtocolVersion)};
  }

  void check_build() const {
    if (!options_.build) return;
    const groma_Hello& hello = *outcome_.hello;
    if (options_.build->version == hello.version && options_.build->git_hash == hello.git_hash) return;
    throw Failure{
        NodeFault::kOtherBuild,
        fmt::format("runs {} ({:08x}), not {} ({:08x}) that was flashed; check that this port and the debug "
                    "probe are those of one node",
                    hello.version, hello.git_hash, options_.build->version, options_.build->git_hash)};
  }

  void check_identity() const {
    const groma_Hello& hello = *outcome_.hello;
    if (options_.reassign || hello.role == groma_Role_ROLE_UNCONFIGURED || hello.id == node_.id) return;
    throw Failure{
        NodeFault::kWrongNode,
        fmt::format("is configured as {} {} of network {}; check which node is on this port ('groma "
                    "identify'), or make it {} by --reassign",
                    link::role_word(hello.role), hello.id, hello.network_id, node_.id)};
  }

  void write() {
    report_step("writes");
    groma_HostToNode command = command_of(groma_HostToNode_write_config_tag);
    command.body.write_config = wanted();
    const groma_Reply reply = expect_reply(*client_, client_->ask(command, kStoringPatience), "write_config");
    const std::string differing =
        reply.has_config ? differences(reply.config, wanted()) : "no configuration in the reply";
    if (!differing.empty()) {
      throw Failure{
          NodeFault::kStorage,
          fmt::format("reads back something else ({}); repeat it, and flash the image of this release if "
                      "that does not help",
                      differing)};
    }
    outcome_.changed = true;
  }

  void apply() {
    report_step("applies");
    outcome_.changed = true;
    (void)expect_reply(*client_,
                       client_->ask(command_of(groma_HostToNode_apply_config_tag), kStoringPatience),
                       "apply_config");
    const auto hello =
        client_->ask_hello([this](const groma_Hello& said) { return in_force(said); }, kApplyingPatience);
    if (client_->last_hello()) outcome_.hello = client_->last_hello();
    if (hello) return;
    if (!client_->last_hello()) throw Failure{NodeFault::kNoAnswer, client_->explain_silence()};
    throw not_in_force(*outcome_.hello);
  }

  [[nodiscard]] Failure not_in_force(const groma_Hello& hello) const {
    return {
        NodeFault::kNotInForce,
        fmt::format("reports another configuration in force (schedule {:08x}, not {:08x}); repeat it, and "
                    "restart the node if that does not help",
                    hello.schedule_hash, node::schedule_hash_of(node_.config))};
  }

  // If this computer has the bus, the node must answer on it. A site is often set up from another computer.
  void check_bus() const {
    link::OpenedLink opened = options_.open(node_.can_link, baud_);
    if (!opened.link) return;
    NodeClient bus(std::move(opened.link));
    if (bus.ask_hello()) return;
    throw Failure{
        NodeFault::kLink,
        fmt::format("is configured, but does not answer at {}; check the bus: CAN H and L, termination at "
                    "both ends, and the same bit rates at each node and this computer",
                    node_.can_link)};
  }

  [[nodiscard]] bool in_force(const groma_Hello& hello) const {
    return hello.role == node_.role && hello.id == node_.id &&
           hello.schedule_hash == node::schedule_hash_of(node_.config) && hello.config_hash == wanted_hash_;
  }

  const PlannedNode& node_;
  unsigned baud_;
  const ConfigureOptions& options_;
  NodeOutcome& outcome_;
  std::uint32_t wanted_hash_;
  std::unique_ptr<NodeClient> client_;
};

}  // namespace

namespace {

// Records the Failure that `step` throws; true if it throws none.
template <typename Step>
bool attempt(const PlannedNode& node, NodeOutcome& outcome, Step&& step) {
  try {
    step();
    return true;
  } catch (const Failure& failure) {
    outcome.fault = failure.fault;
    // The errors of open_link() start with the port already.
    const bool names_port = !outcome.port.empty() && !failure.problem.starts_with(outcome.port);
    outcome.message =
        fmt::format("node {}: {}{}", node.id, names_port ? outcome.port + ": " : "", failure.problem);
    return false;
  }
}

// As attempt(), for a node that is known only by its port.
template <typename Step>
void note(NodeOutcome& outcome, Step&& step) {
  try {
    step();
  } catch (const Failure& failure) {
    outcome.fault = failure.fault;
    outcome.message = failure.problem.starts_with(outcome.port)
                          ? failure.problem
                          : fmt::format("{}: {}", outcome.port, failure.problem);
  }
}

// The order over the air: nodes that relay come after the others, the master last.
std::size_t order_of(const PlannedNode& node) {
  const auto rank = mac::rank_of(node.config.schedule, static_cast<std::uint16_t>(node.id));
  return rank ? mac::kMaxAnchors * 2 - *rank : 0;
}

}  // namespace

bool is_reached_by_air(const PlannedNode& node) {
  return node.port.empty() && !node.via_port.empty();
}

NodeOutcome configure_node(const PlannedNode& node, unsigned baud, const ConfigureOptions& options) {
  return configure_nodes({&node}, baud, options).front();
}

std::vector<NodeOutcome> configure_nodes(const std::vector<const PlannedNode*>& nodes, unsigned baud,
                                         const ConfigureOptions& options,
                                         const std::function<void(std::size_t, const NodeOutcome&)>& done) {
  std::vector<NodeOutcome> outcomes(nodes.size());
  const auto report = [&](std::size_t i) {
    if (done) done(i, outcomes[i]);
  };
  const bool some_by_air =
      std::any_of(nodes.begin(), nodes.end(), [](const auto* node) { return is_reached_by_air(*node); });
  if (!some_by_air) {
    for (std::size_t i = 0; i < nodes.size(); ++i) {
      (void)attempt(*nodes[i], outcomes[i],
                    [&] { Configuring(*nodes[i], baud, options, outcomes[i]).run(); });
      report(i);
    }
    return outcomes;
  }

  std::vector<Configuring> steps;
  steps.reserve(nodes.size());
  for (std::size_t i = 0; i < nodes.size(); ++i) steps.emplace_back(*nodes[i], baud, options, outcomes[i]);
  std::vector<std::size_t> by_air;
  std::vector<std::size_t> wired;
  for (std::size_t i = 0; i < nodes.size(); ++i) (is_reached_by_air(*nodes[i]) ? by_air : wired).push_back(i);
  std::stable_sort(by_air.begin(), by_air.end(),
                   [&](std::size_t a, std::size_t b) { return order_of(*nodes[a]) < order_of(*nodes[b]); });

  const auto good = [&](std::size_t i) { return outcomes[i].fault == NodeFault::kNone; };
  bool all_written = true;
  bool schedule_changes = false;
  for (const auto& group : {by_air, wired}) {
    for (const std::size_t i : group) {
      const bool written = attempt(*nodes[i], outcomes[i], [&] { steps[i].write_if_needed(); });
      steps[i].close_link();
      all_written = all_written && written;
      schedule_changes = schedule_changes || (written && steps[i].changes_schedule());
    }
  }
  // A wired node that passes commands on but is not in the list keeps its schedule.
  const bool alone = wired.empty();
  if (schedule_changes && (!all_written || alone)) {
    for (std::size_t i = 0; i < nodes.size(); ++i) {
      if (!good(i) || !steps[i].has_to_apply()) continue;
      (void)attempt(*nodes[i], outcomes[i], [&] {
        throw Failure{
            NodeFault::kHeldBack,
            alone ? "is written, but keeps its schedule: the node that passes commands on uses it too; "
                    "configure both together"
                  : "is written, but keeps its schedule until all nodes are written; fix the "
                    "others and repeat it"};
      });
    }
    for (std::size_t i = 0; i < nodes.size(); ++i) report(i);
    return outcomes;
  }

  constexpr std::uint32_t kTrialOfEach_s = 20;
  const auto trial_s = static_cast<std::uint32_t>(60 + kTrialOfEach_s * by_air.size());
  std::vector<std::size_t> on_trial;
  for (const std::size_t i : by_air) {
    if (!good(i) || !steps[i].has_to_apply()) continue;
    if (attempt(*nodes[i], outcomes[i], [&] { steps[i].apply_on_trial(trial_s); })) on_trial.push_back(i);
    steps[i].close_link();
  }
  // A wired node must still acknowledge the last answer before it changes its schedule.
  if (!on_trial.empty()) std::this_thread::sleep_for(std::chrono::seconds(1));
  for (const std::size_t i : wired) {
    if (good(i)) (void)attempt(*nodes[i], outcomes[i], [&] { steps[i].run(); });
    steps[i].close_link();
    report(i);
  }
  for (const std::size_t i : by_air) {
    constexpr double kComingBack_s = 30.0;
    const bool tried = std::find(on_trial.begin(), on_trial.end(), i) != on_trial.end();
    (void)attempt(*nodes[i], outcomes[i], [&] {
      if (tried) {
        steps[i].check_after_trial(kComingBack_s);
      } else if (good(i)) {
        steps[i].check_health();
      }
    });
    steps[i].close_link();
    report(i);
  }
  return outcomes;
}

namespace {

// Sends a command that is complete with its reply, then requests the hello.
NodeOutcome send_to_node(const std::string& port, unsigned baud, const groma_HostToNode& command,
                         const char* name, const LinkOpener& open, model::NodeId target) {
  NodeOutcome outcome;
  outcome.port = port;
  note(outcome, [&] {
    const std::unique_ptr<NodeClient> client = connect(port, baud, open, target);
    (void)expect_reply(*client, client->ask(command), name);
    outcome.hello = client->ask_hello();
  });
  return outcome;
}

}  // namespace

NodeOutcome identify_node(const std::string& port, unsigned baud, std::uint32_t duration_s,
                          const LinkOpener& open, model::NodeId target) {
  groma_HostToNode command = command_of(groma_HostToNode_identify_s_tag);
  command.body.identify_s = duration_s;
  return send_to_node(port, baud, command, "identify_s", open, target);
}

NodeOutcome let_leave(const std::string& port, unsigned baud, model::NodeId target, const LinkOpener& open) {
  return send_to_node(port, baud, command_of(groma_HostToNode_leave_network_tag), "leave_network", open,
                      target);
}

NodeOutcome hint_anchors(const std::string& port, unsigned baud, const std::vector<AnchorHint>& hints,
                         model::NodeId target, const LinkOpener& open) {
  groma_HostToNode command = command_of(groma_HostToNode_prefer_anchors_tag);
  groma_AnchorPreference& preference = command.body.prefer_anchors;
  if (hints.size() > std::size(preference.ids)) throw std::length_error("hint_anchors: too many");
  for (const AnchorHint& hint : hints) {
    preference.ids[preference.ids_count++] = static_cast<std::uint16_t>(hint.anchor);
    preference.weights[preference.weights_count++] = hint.weight;
  }
  return send_to_node(port, baud, command, "prefer_anchors", open, target);
}

NodeReport ask_node(const std::string& port, unsigned baud, model::NodeId target, const LinkOpener& open) {
  NodeReport report;
  report.outcome.port = port;
  note(report.outcome, [&] {
    const std::unique_ptr<NodeClient> client = connect(port, baud, open, target);
    report.outcome.hello = client->ask_hello();
    if (!report.outcome.hello) throw Failure{NodeFault::kNoAnswer, client->explain_silence()};
    report.counters = client->ask_counters();
    if (!report.counters) throw Failure{NodeFault::kNoAnswer, client->explain_silence()};
    report.slack = client->ask_slack();
  });
  return report;
}

SurveyOutcome survey_from(const std::string& port, unsigned baud, model::NodeId anchor,
                          std::uint16_t exchanges, const LinkOpener& open) {
  SurveyOutcome surveyed;
  surveyed.outcome.port = port;
  note(surveyed.outcome, [&] {
    const std::unique_ptr<NodeClient> client = connect(port, baud, open, anchor);
    const auto survey = client->ask_survey(exchanges);
    (void)expect_reply(*client, survey ? std::optional(survey->reply) : std::nullopt, "survey",
                       "name anchors other than the master; ranges to the master are measured by the others");
    const std::size_t count =
        std::min<std::size_t>(survey->report.pairs_count, std::size(survey->report.pairs));
    for (const groma_SurveyPair& pair : std::span(survey->report.pairs).first(count)) {
      surveyed.pairs.push_back({anchor, static_cast<model::NodeId>(pair.anchor_id),
                                static_cast<double>(pair.mean_m), static_cast<double>(pair.sigma_m),
                                pair.count});
    }
  });
  return surveyed;
}

}  // namespace groma::provision
