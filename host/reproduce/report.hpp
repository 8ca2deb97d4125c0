// The results as a page.
#pragma once

#include "host/report/page.hpp"
#include "host/reproduce/runner.hpp"

namespace groma::reproduce {

[[nodiscard]] report::Page page_of(const Outcome& outcome, const Plan& plan);

}  // namespace groma::reproduce
