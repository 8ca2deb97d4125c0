// The debug probes on USB, as sysfs tells of them.
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
  std::string serial;  // as the probe tells it; empty: it has none
  std::string product;
  std::filesystem::path device;                     // /dev/bus/usb/001/004
  bool accessible = true;                           // to this user
  std::vector<std::filesystem::path> serial_ports;  // virtual COM ports of the same probe
};

// J-Links by their vendor, CMSIS-DAP by what its product or interface is called. By port. None where there is
// no USB.
[[nodiscard]] std::vector<DebugProbe> find_debug_probes(
    const std::filesystem::path& sysfs = "/sys/bus/usb/devices", const std::filesystem::path& dev = "/dev");

[[nodiscard]] const char* word(Adapter adapter);
[[nodiscard]] std::optional<Adapter> adapter_from_word(std::string_view text);

// "1" and "000000000001" are the same.
[[nodiscard]] bool same_serial(std::string_view a, std::string_view b);

// The udev rules that let a user at this computer use the probes and ports: host/provision/60-groma.rules.
[[nodiscard]] std::string_view udev_rules();

// What this user has to do to be let in.
[[nodiscard]] std::string permission_remedy();

}  // namespace groma::provision
