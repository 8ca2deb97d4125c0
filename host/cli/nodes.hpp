// What the commands that go through a plan's nodes share.
#pragma once

#include <string>
#include <vector>

#include "host/cli/json.hpp"
#include "host/cli/warnings.hpp"
#include "host/provision/configure.hpp"
#include "host/provision/site_plan.hpp"

namespace groma::cli {

// The nodes of these ids, between commas, in the plan's order; all where the text is empty. Throws
// CLI::ValidationError for an id that the plan lacks.
[[nodiscard]] std::vector<const provision::PlannedNode*> select_nodes(const provision::SitePlan& plan,
                                                                      const std::string& ids);

[[nodiscard]] int exit_code_of(provision::NodeFault fault);

// "unchanged", "configured" or "failed".
[[nodiscard]] const char* result_word(const provision::NodeOutcome& outcome);

// result, fault, message, port, version, git_hash.
[[nodiscard]] Json to_json(const provision::NodeOutcome& outcome);

// Complains of a failure and warns of what the hello tells that a user should look after; returns the exit
// code that the fault asks for.
[[nodiscard]] int tell(const provision::NodeOutcome& outcome, Warnings& warnings);

}  // namespace groma::cli
