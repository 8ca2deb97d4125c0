// Serial ports of USB devices by the serial number of the device, so that a port's name may change. The path
// in place of a device path is
//
//   serial:NUMBER     such as serial:000760123456, the number of a DWM1001-DEV's debug probe
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "host/link/byte_link.hpp"

namespace groma::link {

inline constexpr std::string_view kUsbPortScheme = "serial:";

[[nodiscard]] bool is_usb_port_path(std::string_view path) noexcept;
// Whether two serial numbers are the same: leading zeros and the case of letters do not count.
[[nodiscard]] bool is_same_serial(std::string_view a, std::string_view b) noexcept;

struct UsbPort {
  std::string name;    // such as ttyACM0, in /dev
  std::string serial;  // of the device, as it reports it
};
// Those that are connected and whose device has a serial number, by name. sysfs: where Linux shows its
// devices.
[[nodiscard]] std::vector<UsbPort> list_usb_ports(const std::filesystem::path& sysfs = "/sys");
// The first port of that device; nothing if it is not connected.
[[nodiscard]] std::optional<UsbPort> find_usb_port(const std::vector<UsbPort>& ports,
                                                   std::string_view serial);

[[nodiscard]] OpenedLink open_usb_port(const std::string& path, unsigned baud);

}  // namespace groma::link
