// Finds debug probes on USB, in sysfs.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

namespace groma::provision {

enum class Adapter { kJlink, kCmsisDap };

struct DebugProbe {
  Adapter adapter = Adapter::kJlink;
  std::string usb_id;  // "1366:1015"
  std::string serial;  // as the probe reports it; empty: none
  std::string product;
  std::filesystem::path device;                     // /dev/bus/usb/001/004
  bool accessible = true;                           // by this user
  std::vector<std::filesystem::path> serial_ports;  // virtual COM ports of the same probe
};

// Recognizes J-Links by vendor and CMSIS-DAP by the name of product or interface. Sorted by USB port; empty
// without USB.
[[nodiscard]] std::vector<DebugProbe> find_debug_probes(
    const std::filesystem::path& sysfs = "/sys/bus/usb/devices", const std::filesystem::path& dev = "/dev");

[[nodiscard]] const char* word(Adapter adapter);
[[nodiscard]] std::optional<Adapter> adapter_from_word(std::string_view text);

// Compares serial numbers without leading zeros: "1" equals "000000000001".
[[nodiscard]] bool same_serial(std::string_view a, std::string_view b);

// The udev rules that let a user at this computer use the probes and ports: host/provision/60-groma.rules.
[[nodiscard]] std::string_view udev_rules();

// How this user gets permission to use the probes; for messages.
[[nodiscard]] std::string permission_remedy();

}  // namespace groma::provision
