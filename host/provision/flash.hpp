// Writes an image into a node's flash by a debug probe, with OpenOCD, and explains failures from its output.
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
  kPermission,   // this user may not use the probe
  kBusy,         // another program uses the probe
  kNoTarget,     // the probe works, but no target answers
  kOtherTarget,  // the target is not an nRF52832
  kLocked,       // APPROTECT
  kNotUnlocked,  // --recover did not unlock it
  kWriting,      // erase or write failed
  kVerify,       // the flash does not hold the image
  kProbeLost,    // probe or wires lost during the operation
  kOther,        // an unknown failure of OpenOCD
};

struct FlashRequest {
  NodeImage image;
  std::filesystem::path openocd;
  // "interface/jlink.cfg", "interface/cmsis-dap.cfg" or, with own_interface, the user's own file. The latter
  // also selects the transport and gets the serial number in the variable GROMA_PROBE.
  std::string interface;
  bool own_interface = false;
  std::string serial;    // of the probe; empty: any
  bool recover = false;  // unlock a locked part, which erases it completely
};

struct FlashOutcome {
  FlashFault fault = FlashFault::kNone;
  std::string message;     // of the fault: cause and remedy
  bool changed = false;    // false: the flash held the image already
  bool recovered = false;  // the part was locked and has been erased
  std::string output;      // of OpenOCD
};

// OpenOCD's command line. Its servers are off. A part that holds the image already is not written.
[[nodiscard]] std::vector<std::string> openocd_arguments(const FlashRequest& request);

// Interprets OpenOCD's exit code and output.
[[nodiscard]] FlashOutcome read_openocd(int exit_code, std::string_view output, const FlashRequest& request);

// Runs OpenOCD. `on_phase` is called with "connecting", "unlocking", "writing", "verifying"; may be empty.
// Throws io::DeviceError if OpenOCD cannot be started.
[[nodiscard]] FlashOutcome flash(const FlashRequest& request,
                                 const std::function<void(const char*)>& on_phase = {});

// Chooses the probe with the serial number or, if that is empty, the only probe. `adapter`: only of that
// kind, if given. `probe` points into the given list; null: see the fault.
struct ChosenProbe {
  const DebugProbe* probe = nullptr;
  FlashFault fault = FlashFault::kNone;
  std::string message;
};
[[nodiscard]] ChosenProbe choose_probe(const std::vector<DebugProbe>& probes, std::optional<Adapter> adapter,
                                       const std::string& serial);

}  // namespace groma::provision
