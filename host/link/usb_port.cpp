#include "host/link/usb_port.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <fstream>
#include <system_error>
#include <tuple>

namespace groma::link {
namespace {

std::string_view without_zeros(std::string_view serial) noexcept {
  return serial.substr(std::min(serial.find_first_not_of('0'), serial.size()));
}

char lower(char c) noexcept {
  return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
}

// The serial number of the USB device with this interface, or whose part this device is; empty if there is
// none.
std::string serial_of(std::filesystem::path device) {
  std::error_code ignored;
  // A port is at most its driver's device below the interface below the USB device.
  for (int i = 0; i < 3 && device.has_relative_path(); ++i, device = device.parent_path()) {
    if (!std::filesystem::exists(device / "idVendor", ignored)) continue;
    std::ifstream file(device / "serial");
    std::string serial;
    std::getline(file, serial);
    return serial;
  }
  return {};
}

}  // namespace

bool is_usb_port_path(std::string_view path) noexcept {
  return path.starts_with(kUsbPortScheme);
}

bool is_same_serial(std::string_view a, std::string_view b) noexcept {
  const std::string_view left = without_zeros(a);
  const std::string_view right = without_zeros(b);
  return std::equal(left.begin(), left.end(), right.begin(), right.end(),
                    [](char x, char y) { return lower(x) == lower(y); });
}

std::vector<UsbPort> list_usb_ports(const std::filesystem::path& sysfs) {
  std::vector<UsbPort> ports;
  std::error_code error;
  for (std::filesystem::directory_iterator entry(sysfs / "class" / "tty", error), end; !error && entry != end;
       entry.increment(error)) {
    std::error_code is_virtual;
    const auto device = std::filesystem::canonical(entry->path() / "device", is_virtual);
    if (is_virtual) continue;
    std::string serial = serial_of(device);
    if (!serial.empty()) ports.push_back({entry->path().filename().string(), std::move(serial)});
  }
  // ttyACM2 before ttyACM10.
  std::sort(ports.begin(), ports.end(), [](const UsbPort& a, const UsbPort& b) {
    return std::tuple(a.name.size(), a.name) < std::tuple(b.name.size(), b.name);
  });
  return ports;
}

std::optional<UsbPort> find_usb_port(const std::vector<UsbPort>& ports, std::string_view serial) {
  const auto found = std::find_if(ports.begin(), ports.end(),
                                  [&](const UsbPort& port) { return is_same_serial(port.serial, serial); });
  return found == ports.end() ? std::nullopt : std::optional(*found);
}

OpenedLink open_usb_port(const std::string& path, unsigned baud) {
  const std::vector<UsbPort> ports = list_usb_ports();
  const auto port = find_usb_port(ports, std::string_view(path).substr(kUsbPortScheme.size()));
  if (port) return open_serial_port("/dev/" + port->name, baud);
  std::string others;
  for (const UsbPort& one : ports)
    others += fmt::format("{}{} ({})", others.empty() ? "" : ", ", one.serial, one.name);
  return {nullptr,
          {LinkFault::kNoDevice,
           fmt::format("{}: no USB device with this serial number has a port here; {}", path,
                       others.empty() ? "plug it in" : "connected serial numbers: " + others)}};
}

}  // namespace groma::link
