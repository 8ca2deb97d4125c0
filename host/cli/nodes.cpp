#include "host/cli/nodes.hpp"

#include <fmt/format.h>

#include <algorithm>

#include <CLI/CLI.hpp>

#include "host/cli/selection.hpp"
#include "host/cli/terminal.hpp"
#include "host/io/exit_code.hpp"

namespace groma::cli {

namespace {

using provision::NodeFault;

const char* word(NodeFault fault) {
  switch (fault) {
    case NodeFault::kNone:
      return "";
    case NodeFault::kNoPort:
      return "no-port";
    case NodeFault::kNotInPlan:
      return "not-in-plan";
    case NodeFault::kPermission:
      return "permission";
    case NodeFault::kBusy:
      return "busy";
    case NodeFault::kUnsuitable:
      return "unsuitable";
    case NodeFault::kNoAnswer:
      return "no-answer";
    case NodeFault::kOtherProtocol:
      return "other-protocol";
    case NodeFault::kOtherBuild:
      return "other-build";
    case NodeFault::kWrongNode:
      return "wrong-node";
    case NodeFault::kRefused:
      return "refused";
    case NodeFault::kStorage:
      return "storage";
    case NodeFault::kNotInForce:
      return "not-in-force";
    case NodeFault::kRadio:
      return "radio";
    case NodeFault::kLink:
      return "link";
    case NodeFault::kHeldBack:
      return "held-back";
  }
  return "";
}

// A firmware fault that the hello reports; empty if there is none.
std::string firmware_fault_in(const provision::NodeOutcome& outcome) {
  if (!outcome.hello || !outcome.hello->has_last_fault) return {};
  const groma_Fault& fault = outcome.hello->last_fault;
  return fmt::format(
      "{}: the node's firmware failed before this start (PC {:08x}, LR {:08x}, CFSR {:08x}); report it with "
      "the "
      "image's version {} ({:08x})",
      outcome.port, fault.pc, fault.lr, fault.cfsr, outcome.hello->version, outcome.hello->git_hash);
}

// What the hello says of a radio that came up; empty if nothing.
std::string radio_warning_in(const provision::NodeOutcome& outcome) {
  if (!outcome.hello || outcome.hello->radio_warning[0] == '\0') return {};
  return fmt::format(
      "{}: the node's radio: {}; measure its antenna delays and name them in the plan "
      "(docs/how-to/plan-a-site.md)",
      outcome.port, outcome.hello->radio_warning);
}

}  // namespace

std::vector<const provision::PlannedNode*> select_nodes(const provision::SitePlan& plan,
                                                        const std::string& ids) {
  std::vector<model::NodeId> wanted;
  if (!ids.empty()) wanted = parse_ids("--node", ids);
  for (const model::NodeId id : wanted) {
    if (plan.find(id) == nullptr) {
      throw CLI::ValidationError("--node", fmt::format("{} has no node {}", plan.path.string(), id));
    }
  }
  std::vector<const provision::PlannedNode*> nodes;
  for (const provision::PlannedNode& node : plan.nodes) {
    if (wanted.empty() || std::find(wanted.begin(), wanted.end(), node.id) != wanted.end()) {
      nodes.push_back(&node);
    }
  }
  return nodes;
}

int exit_code_of(NodeFault fault) {
  switch (fault) {
    case NodeFault::kNone:
      return io::kGood;
    case NodeFault::kPermission:
      return io::kNoPermission;
    case NodeFault::kNotInPlan:
    case NodeFault::kOtherBuild:
    case NodeFault::kWrongNode:
    case NodeFault::kRefused:
      return io::kBadConfiguration;
    default:
      return io::kUnavailable;
  }
}

const char* result_word(const provision::NodeOutcome& outcome) {
  if (outcome.fault != NodeFault::kNone) return "failed";
  return outcome.changed ? "configured" : "unchanged";
}

Json to_json(const provision::NodeOutcome& outcome) {
  const bool failed = outcome.fault != NodeFault::kNone;
  Json json{{"result", result_word(outcome)},
            {"fault", failed ? Json(word(outcome.fault)) : Json(nullptr)},
            {"message", failed ? Json(outcome.message) : Json(nullptr)},
            {"port", outcome.port.empty() ? Json(nullptr) : Json(outcome.port)},
            {"version", nullptr},
            {"git_hash", nullptr}};
  if (outcome.hello) {
    json["version"] = outcome.hello->version;
    json["git_hash"] = fmt::format("{:08x}", outcome.hello->git_hash);
  }
  return json;
}

int report_outcome(const provision::NodeOutcome& outcome, Warnings& warnings) {
  if (outcome.fault != NodeFault::kNone) complain(outcome.message);
  if (const std::string fault = firmware_fault_in(outcome); !fault.empty()) warnings.add(fault);
  if (const std::string warning = radio_warning_in(outcome); !warning.empty()) warnings.add(warning);
  return exit_code_of(outcome.fault);
}

}  // namespace groma::cli
