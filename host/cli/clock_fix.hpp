// --fix: corrects the times of the ranges in memory where the diagnosis names their clock first.
#pragma once

#include <optional>
#include <span>
#include <vector>

#include <CLI/App.hpp>

#include "host/cli/warnings.hpp"
#include "host/diagnosis/finding.hpp"
#include "host/model/clock_error.hpp"
#include "host/model/types.hpp"

namespace groma::cli {

void add_clock_fix(CLI::App& command, bool& fix);

// If the first finding is an error of the ranges' clock: corrects the times by it, says so, and returns it.
std::optional<model::ClockError> fix_clock(std::span<const diagnosis::Finding> findings,
                                           std::vector<model::RangeSample>& ranges, Warnings& warnings);

// Corrects the times of ranges by the error of their clock, and sorts them.
void correct_clock(const model::ClockError& clock, std::vector<model::RangeSample>& ranges);

}  // namespace groma::cli
