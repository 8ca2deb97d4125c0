// Helpers of the commands that process a plan's nodes.
#pragma once

#include <string>
#include <vector>

#include "host/cli/json.hpp"
#include "host/cli/warnings.hpp"
#include "host/provision/configure.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

// The nodes with these comma-separated ids, in the plan's order; all nodes if `ids` is empty. Throws
// CLI::ValidationError for an id that the plan lacks.
[[nodiscard]] std::vector<const provision::PlannedNode*> select_nodes(const provision::SitePlan& plan,
                                                                      const std::string& ids);

[[nodiscard]] int exit_code_of(provision::NodeFault fault);

// "unchanged", "configured" or "failed".
[[nodiscard]] const char* result_word(const provision::NodeOutcome& outcome);

// result, fault, message, port, version, git_hash.
[[nodiscard]] Json to_json(const provision::NodeOutcome& outcome);

// Reports a failure, and warns of a firmware fault that the hello reports; returns the exit code for the
// fault.
[[nodiscard]] int report_outcome(const provision::NodeOutcome& outcome, Warnings& warnings);

}  // namespace groma::cli
