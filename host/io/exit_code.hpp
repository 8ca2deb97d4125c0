// How each command ends; scripts rely on the numbers.
#pragma once

namespace groma::io {

enum ExitCode : int {
  kGood = 0,
  kUsage = 2,  // also a path to write to that makes no sense
  kDoneWithWarnings = 3,
  kBadData = 65,      // or a result that is not usable
  kUnavailable = 69,  // a device or service
  kNoPermission = 77,
  kBadConfiguration = 78,
};

}  // namespace groma::io
