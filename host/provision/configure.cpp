#include "host/provision/configure.hpp"

#include <fmt/format.h>

#include <memory>
#include <utility>

#include "firmware/core/node/config.hpp"
#include "firmware/core/node/messages.hpp"
#include "host/provision/node_client.hpp"

namespace groma::provision {

namespace {

// The radio is brought up anew, which is tried again after a second.
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

// Throws Failure where the link cannot be opened.
std::unique_ptr<NodeClient> connect(const std::string& port, unsigned baud, const LinkOpener& open) {
  link::OpenedLink opened = open(port, baud);
  if (!opened.link) throw Failure{fault_of_link(opened.error.fault), opened.error.message};
  return std::make_unique<NodeClient>(std::move(opened.link));
}

groma_Reply expect_reply(const NodeClient& client, const std::optional<groma_Reply>& reply,
                         const char* command) {
  if (!reply) throw Failure{NodeFault::kNoAnswer, client.silence()};
  switch (link::number_in(reply->result)) {
    case groma_Result_RESULT_OK:
      return *reply;
    case groma_Result_RESULT_STORAGE:
      throw Failure{NodeFault::kStorage,
                    fmt::format("{} failed ({}); repeat it, and replace the node if that does not help",
                                command, reply->text)};
    default:
      throw Failure{NodeFault::kRefused,
                    fmt::format("refuses to {}: {}; mend the plan, or flash the image of this release",
                                command, reply->text)};
  }
}

// One node's way to its configuration.
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
    reach();
    check_release();
    check_build();
    check_identity();
    tell("reads");
    const groma_Reply stored =
        expect_reply(*client_, client_->ask(command_of(groma_HostToNode_read_config_tag)), "read_config");
    if (!stored.has_config || !differences(stored.config, node_.config).empty()) write();
    if (!in_force(*outcome_.hello)) apply();
    check_health();
  }

 private:
  void tell(const char* step) const {
    if (options_.progress) options_.progress(step);
  }

  void reach() {
    tell("asks");
    outcome_.port = node_.port.empty() ? node_.can_link : node_.port;
    if (outcome_.port.empty()) {
      throw Failure{NodeFault::kNotInPlan, "the plan names no port for it; add 'port:' to the node"};
    }
    link::OpenedLink opened = options_.open(outcome_.port, baud_);
    const bool unplugged = !opened.link && opened.error.fault == link::LinkFault::kNoDevice;
    if (unplugged && !node_.can_link.empty() && !node_.port.empty()) {
      // Its serial port is for the first time; from then on it may be on the bus alone.
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
            ? client_->silence() +
                  "; a node that was never configured is reached by its UART alone: name that as 'port:'"
            : client_->silence()};
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
        fmt::format("is configured as {} {} of network {}; check which node hangs on this port ('groma "
                    "identify'), or make it {} by --reassign",
                    role_word(hello.role), hello.id, hello.network_id, node_.id)};
  }

  void write() {
    tell("writes");
    groma_HostToNode command = command_of(groma_HostToNode_write_config_tag);
    command.body.write_config = node_.config;
    const groma_Reply reply = expect_reply(*client_, client_->ask(command, kStoringPatience), "write_config");
    const std::string differing =
        reply.has_config ? differences(reply.config, node_.config) : "no configuration in the reply";
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
    tell("applies");
    outcome_.changed = true;
    (void)expect_reply(*client_,
                       client_->ask(command_of(groma_HostToNode_apply_config_tag), kStoringPatience),
                       "apply_config");
    const auto hello =
        client_->ask_hello([this](const groma_Hello& said) { return in_force(said); }, kApplyingPatience);
    if (client_->last_hello()) outcome_.hello = client_->last_hello();
    if (hello) return;
    if (!client_->last_hello()) throw Failure{NodeFault::kNoAnswer, client_->silence()};
    throw Failure{
        NodeFault::kNotInForce,
        fmt::format("says it works by another configuration (schedule {:08x}, not {:08x}); repeat it, and "
                    "restart the node if that does not help",
                    outcome_.hello->schedule_hash, node::schedule_hash_of(node_.config))};
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
    if (!node_.can_link.empty() && outcome_.port != node_.can_link) check_bus();
  }

  // Where this computer has the bus, the node has to be heard on it; a site is often set up from another.
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

NodeOutcome configure_node(const PlannedNode& node, unsigned baud, const ConfigureOptions& options) {
  NodeOutcome outcome;
  try {
    Configuring(node, baud, options, outcome).run();
  } catch (const Failure& failure) {
    outcome.fault = failure.fault;
    // What opens links begins with the port itself.
    const bool names_port = !outcome.port.empty() && !failure.problem.starts_with(outcome.port);
    outcome.message =
        fmt::format("node {}: {}{}", node.id, names_port ? outcome.port + ": " : "", failure.problem);
  }
  return outcome;
}

NodeOutcome identify_node(const std::string& port, unsigned baud, std::uint32_t duration_s,
                          const LinkOpener& open) {
  NodeOutcome outcome;
  outcome.port = port;
  try {
    const std::unique_ptr<NodeClient> client = connect(port, baud, open);
    groma_HostToNode command = command_of(groma_HostToNode_identify_s_tag);
    command.body.identify_s = duration_s;
    (void)expect_reply(*client, client->ask(command), "identify_s");
    outcome.hello = client->ask_hello();
  } catch (const Failure& failure) {
    outcome.fault = failure.fault;
    outcome.message =
        failure.problem.starts_with(port) ? failure.problem : fmt::format("{}: {}", port, failure.problem);
  }
  return outcome;
}

const char* role_word(groma_Role role) {
  switch (link::number_in(role)) {
    case groma_Role_ROLE_TAG:
      return "tag";
    case groma_Role_ROLE_ANCHOR:
      return "anchor";
    default:
      return "unconfigured";
  }
}

}  // namespace groma::provision
