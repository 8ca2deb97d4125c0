#include "host/provision/flash.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <initializer_list>
#include <utility>

#include "host/provision/process.hpp"

namespace groma::provision {

namespace {

// Tcl for OpenOCD 0.12. APPROTECTSTATUS is register 0xC of the CTRL-AP, access port 1: 1 is open
// (nRF52832 product specification, CTRL-AP). OpenOCD's own target file defines nrf52_recover.
constexpr const char* kRecover =
    "init; if {[[[target current] cget -dap] apreg 1 0xc] != 1} { echo {groma: unlocking}; nrf52_recover }";

// Braces keep Tcl from substituting within a path; flash() rejects a path with braces.
std::string braced(const std::string& text) {
  return fmt::format("{{{}}}", text);
}

bool has(std::string_view text, std::string_view part) {
  return text.find(part) != std::string_view::npos;
}

bool has_any(std::string_view text, std::initializer_list<std::string_view> parts) {
  return std::any_of(parts.begin(), parts.end(), [&](std::string_view part) { return has(text, part); });
}

// The first line marked as an error by OpenOCD; otherwise its last line.
std::string first_error(std::string_view output) {
  constexpr std::string_view kError = "Error: ";
  std::string_view last;
  while (!output.empty()) {
    const std::size_t end = output.find('\n');
    const std::string_view line = output.substr(0, end);
    if (line.starts_with(kError)) return std::string(line.substr(kError.size()));
    if (!line.empty()) last = line;
    output.remove_prefix(end == std::string_view::npos ? output.size() : end + 1);
  }
  return std::string(last);
}

std::string list_of(const std::vector<DebugProbe>& probes) {
  std::string text;
  for (const DebugProbe& probe : probes) {
    text += fmt::format("{}{} {} ({})", text.empty() ? "" : ", ", word(probe.adapter),
                        probe.serial.empty() ? "without a serial number" : probe.serial, probe.product);
  }
  return text;
}

struct Cause {
  FlashFault fault;
  std::string message;
};

// Texts of OpenOCD 0.12.0 and libjaylink 0.3.1.
Cause cause_of_connecting(std::string_view output) {
  if (has_any(output, {"LIBUSB_ERROR_ACCESS", "Access denied (insufficient permissions)"})) {
    return {FlashFault::kPermission, "this user may not use the probe; " + permission_remedy()};
  }
  if (has_any(output, {"LIBUSB_ERROR_BUSY", "Resource busy", "maximum number of connections"})) {
    return {
        FlashFault::kBusy,
        "another program has the probe; stop it (another OpenOCD, JLinkExe, a debugger), then repeat this"};
  }
  if (has_any(output, {"No J-Link device found", "unable to find a matching CMSIS-DAP device"})) {
    return {FlashFault::kNoProbe,
            "no such debug probe; plug it in, 'groma flash --list' shows the connected ones"};
  }
  if (has(output, "Multiple devices found")) {
    return {FlashFault::kManyProbes,
            "there are several debug probes; choose one by --probe, 'groma flash --list' shows them"};
  }
  if (has_any(output, {"cannot read IDR", "scan chain interrogation failed", "DAP init failed"})) {
    return {
        FlashFault::kNoTarget,
        "the probe works, but no part answers; check that the module has power, and SWDIO, SWCLK and GND"};
  }
  return {FlashFault::kOther, {}};
}

}  // namespace

std::vector<std::string> openocd_arguments(const FlashRequest& request) {
  std::vector<std::string> arguments{request.openocd.string()};
  const auto command = [&](std::string text) {
    arguments.emplace_back("-c");
    arguments.push_back(std::move(text));
  };
  const auto script = [&](const std::string& path) { arguments.insert(arguments.end(), {"-f", path}); };
  if (request.own_interface) {
    command("set GROMA_PROBE " + braced(request.serial));
    script(request.interface);
  } else {
    script(request.interface);
    command("transport select swd");
    if (!request.serial.empty()) command("adapter serial " + braced(request.serial));
  }
  script("target/nrf52.cfg");
  for (const char* server : {"gdb_port", "telnet_port", "tcl_port"})
    command(fmt::format("{} disabled", server));
  if (request.recover) command(kRecover);
  command(fmt::format("program {} preverify verify reset exit", braced(request.image.path.string())));
  return arguments;
}

FlashOutcome read_openocd(int exit_code, std::string_view output, const FlashRequest& request) {
  FlashOutcome outcome;
  const bool written = has(output, "** Verified OK **");
  const bool there = has(output, "**Verified OK - No flashing**");
  outcome.recovered = has(output, "successfully erased and unlocked");
  outcome.changed = has(output, "** Programming Started **") || outcome.recovered;
  if (exit_code == 0 && (written || there)) return outcome;

  const auto fail = [&](FlashFault fault, std::string message) {
    outcome.fault = fault;
    outcome.message = std::move(message);
    return outcome;
  };
  if (const Cause cause = cause_of_connecting(output); cause.fault != FlashFault::kOther) {
    return fail(cause.fault, cause.message);
  }
  if (has(output, "AP lock engaged") && !outcome.recovered) {
    if (request.recover) {
      return fail(
          FlashFault::kNotUnlocked,
          "the part is locked (APPROTECT) and did not unlock; switch it off and on, then repeat this");
    }
    return fail(FlashFault::kLocked,
                "the part is locked (APPROTECT); --recover unlocks it, and erases all that is in it");
  }
  if (has_any(output, {"remote_bitbang_fill_buf", "remote_bitbang_putc", "LIBUSB_ERROR_NO_DEVICE",
                       "LIBUSB_ERROR_IO", "jaylink_swd_io() failed", "jaylink_jtag_io() failed",
                       "No such device", "error writing data", "error reading data"})) {
    return fail(FlashFault::kProbeLost,
                "the probe went away in the middle; plug it in again and repeat this");
  }
  if (has(output, "** Verify Failed **")) {
    return fail(
        FlashFault::kVerify,
        "what is in flash is not the image; repeat this, and replace the module if that does not help");
  }
  if (has(output, "** Programming Failed **")) {
    return fail(FlashFault::kWriting,
                fmt::format("flash could not be written ({}); check power and wires, then repeat this",
                            first_error(output)));
  }
  if (has_any(output, {"UNEXPECTED idcode", "Unknown device", "Couldn't read part"})) {
    return fail(FlashFault::kOtherTarget,
                fmt::format("the target is not an nRF52832 ({}); check what the probe is wired to",
                            first_error(output)));
  }
  return fail(
      FlashFault::kOther,
      fmt::format("OpenOCD failed ({}); its output, with --verbose, may show more", first_error(output)));
}

FlashOutcome flash(const FlashRequest& request, const std::function<void(const char*)>& on_phase) {
  const std::string path = request.image.path.string();
  if (path.find_first_of("{}\\") != std::string::npos ||
      request.serial.find_first_of("{}\\") != std::string::npos) {
    FlashOutcome outcome;
    outcome.fault = FlashFault::kOther;
    outcome.message = fmt::format("{}: OpenOCD accepts no braces or backslashes; rename it", path);
    return outcome;
  }
  const auto on_line = [&](std::string_view line) {
    if (!on_phase) return;
    if (line == "groma: unlocking") on_phase("unlocking");
    if (line == "** Programming Started **") on_phase("writing");
    if (line == "** Verify Started **" || line == "**pre-verifying**") on_phase("verifying");
  };
  if (on_phase) on_phase("connecting");
  const ProcessResult result = run_process(openocd_arguments(request), on_line);
  FlashOutcome outcome = read_openocd(result.exit_code, result.output, request);
  outcome.output = result.output;
  return outcome;
}

ChosenProbe choose_probe(const std::vector<DebugProbe>& probes, std::optional<Adapter> adapter,
                         const std::string& serial) {
  std::vector<DebugProbe> there;
  const DebugProbe* chosen = nullptr;
  for (const DebugProbe& probe : probes) {
    if (adapter && probe.adapter != *adapter) continue;
    there.push_back(probe);
    if (serial.empty() || same_serial(probe.serial, serial)) chosen = &probe;
  }
  if (there.empty()) {
    return {nullptr, FlashFault::kNoProbe,
            fmt::format("no {} on USB; plug it in, the DWM1001-DEV has one on board",
                        adapter ? word(*adapter) : "debug probe (J-Link or CMSIS-DAP)")};
  }
  if (chosen == nullptr) {
    return {nullptr, FlashFault::kOtherSerial,
            fmt::format("no debug probe has the serial number {}; there are: {}", serial, list_of(there))};
  }
  if (serial.empty() && there.size() > 1) {
    return {nullptr, FlashFault::kManyProbes,
            fmt::format("there are several debug probes; choose one by --probe: {}", list_of(there))};
  }
  if (!chosen->accessible) {
    return {nullptr, FlashFault::kPermission,
            fmt::format("{}: this user may not use the probe {}; {}", chosen->device.string(), chosen->serial,
                        permission_remedy())};
  }
  return {chosen, FlashFault::kNone, {}};
}

}  // namespace groma::provision
