// An image into a node's flash by a debug probe, with OpenOCD; and from what OpenOCD says, why it did not
// work.
#pragma once

#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/provision/debug_probe.hpp"
#include "host/provision/image.hpp"

namespace groma::provision {

enum class FlashFault {
  kNone,
  kNoOpenocd,    // not installed
  kNoProbe,      // none on USB
  kManyProbes,   // several, and none was chosen
  kOtherSerial,  // none with that serial number
  kPermission,   // for this user to use the probe
  kBusy,         // another program has the probe
  kNoTarget,     // the probe works, nothing answers behind it
  kOtherTarget,  // what answers is no nRF52832
  kLocked,       // APPROTECT
  kNotUnlocked,  // --recover did not help
  kWriting,      // erase or write failed
  kVerify,       // what is in flash is not the image
  kProbeLost,    // unplugged, or the wire, in the middle
  kOther,        // OpenOCD failed in a way that is not known here
};

struct FlashRequest {
  NodeImage image;
  std::filesystem::path openocd;
  // "interface/jlink.cfg", "interface/cmsis-dap.cfg", or a file of one's own, which also chooses the
  // transport and finds the serial number in the variable GROMA_PROBE.
  std::string interface;
  bool own_interface = false;
  std::string serial;    // of the probe; empty: whichever there is
  bool recover = false;  // a locked part is erased as a whole and unlocked
};

struct FlashOutcome {
  FlashFault fault = FlashFault::kNone;
  std::string message;     // of the fault: cause and remedy
  bool changed = false;    // false: the image was there already
  bool recovered = false;  // the part was locked, and has been erased
  std::string output;      // of OpenOCD
};

// The command line. Servers are off; a part that has the image already is not written.
[[nodiscard]] std::vector<std::string> openocd_arguments(const FlashRequest& request);

// What OpenOCD's exit code and output mean.
[[nodiscard]] FlashOutcome read_openocd(int exit_code, std::string_view output, const FlashRequest& request);

// Runs OpenOCD. `on_phase` is told "connecting", "unlocking", "writing", "verifying"; may be empty. Throws
// io::DeviceError where it cannot be started.
[[nodiscard]] FlashOutcome flash(const FlashRequest& request,
                                 const std::function<void(const char*)>& on_phase = {});

// The probe to use of those there are: that with the serial number, or the only one. `adapter`: of that kind
// alone, if given. Or the fault.
struct ChosenProbe {
  const DebugProbe* probe = nullptr;
  FlashFault fault = FlashFault::kNone;
  std::string message;
};
[[nodiscard]] ChosenProbe choose_probe(const std::vector<DebugProbe>& probes, std::optional<Adapter> adapter,
                                       const std::string& serial);

}  // namespace groma::provision
