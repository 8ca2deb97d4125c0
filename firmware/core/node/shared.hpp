// What the parts of a node share.
#pragma once

#include <optional>

#include "firmware/core/node/air_link.hpp"
#include "firmware/core/node/platform.hpp"
#include "firmware/core/node/survey.hpp"
#include "groma.pb.h"

namespace groma::node {

template <Platform P>
struct Shared {
  P& platform;
  std::optional<groma_Config> config{};  // in force
  groma_Counters counters = groma_Counters_init_zero;
  AirLink air{};
  Survey survey{};
};

}  // namespace groma::node
