// Exit codes of the commands; scripts rely on the numbers.
#pragma once

namespace groma::io {

enum ExitCode : int {
  kGood = 0,
  kUsage = 2,  // also an output path that is not usable
  kDoneWithWarnings = 3,
  kBadData = 65,      // also a result that is not usable
  kUnavailable = 69,  // device or service
  kNoPermission = 77,
  kBadConfiguration = 78,
};

}  // namespace groma::io
