#include "host/provision/debug_probe.hpp"

#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <charconv>
#include <fstream>
#include <system_error>

#include "generated/udev_rules.hpp"

namespace groma::provision {

namespace {

namespace fs = std::filesystem;

constexpr std::string_view kSeggerVendor = "1366";
constexpr std::string_view kCmsisDapName = "CMSIS-DAP";

// The first line of a sysfs attribute; empty if it does not exist.
std::string attribute(const fs::path& folder, const char* name) {
  std::ifstream file(folder / name);
  std::string line;
  std::getline(file, line);
  return line;
}

unsigned number(const std::string& text) {
  unsigned value = 0;
  std::from_chars(text.data(), text.data() + text.size(), value);
  return value;
}

// A device's interfaces are subfolders: 1-2:1.0 and so on.
std::vector<fs::path> interfaces_of(const fs::path& device) {
  std::vector<fs::path> interfaces;
  std::error_code error;
  for (const fs::directory_entry& entry : fs::directory_iterator(device, error)) {
    if (fs::exists(entry.path() / "bInterfaceNumber", error)) interfaces.push_back(entry.path());
  }
  std::sort(interfaces.begin(), interfaces.end());
  return interfaces;
}

std::optional<Adapter> adapter_of(const fs::path& device, const std::string& vendor,
                                  const std::string& product) {
  if (vendor == kSeggerVendor) return Adapter::kJlink;
  if (product.find(kCmsisDapName) != std::string::npos) return Adapter::kCmsisDap;
  for (const fs::path& interface : interfaces_of(device)) {
    if (attribute(interface, "interface").find(kCmsisDapName) != std::string::npos) return Adapter::kCmsisDap;
  }
  return std::nullopt;
}

}  // namespace

std::vector<DebugProbe> find_debug_probes(const fs::path& sysfs, const fs::path& dev) {
  std::vector<DebugProbe> probes;
  std::error_code error;
  std::vector<fs::path> devices;
  for (const fs::directory_entry& entry : fs::directory_iterator(sysfs, error))
    devices.push_back(entry.path());
  std::sort(devices.begin(), devices.end());
  for (const fs::path& device : devices) {
    const std::string vendor = attribute(device, "idVendor");
    if (vendor.empty()) continue;
    DebugProbe probe;
    probe.product = attribute(device, "product");
    const std::optional<Adapter> adapter = adapter_of(device, vendor, probe.product);
    if (!adapter) continue;
    probe.adapter = *adapter;
    probe.usb_id = fmt::format("{}:{}", vendor, attribute(device, "idProduct"));
    probe.serial = attribute(device, "serial");
    probe.device = dev / fmt::format("bus/usb/{:03}/{:03}", number(attribute(device, "busnum")),
                                     number(attribute(device, "devnum")));
    // If the device node does not exist, assume access; OpenOCD may report the cause.
    probe.accessible =
        ::access(probe.device.c_str(), F_OK) != 0 || ::access(probe.device.c_str(), R_OK | W_OK) == 0;
    for (const fs::path& interface : interfaces_of(device)) {
      for (const fs::directory_entry& port : fs::directory_iterator(interface / "tty", error)) {
        probe.serial_ports.push_back(dev / port.path().filename());
      }
    }
    probes.push_back(std::move(probe));
  }
  return probes;
}

const char* word(Adapter adapter) {
  return adapter == Adapter::kJlink ? "jlink" : "cmsis-dap";
}

std::optional<Adapter> adapter_from_word(std::string_view text) {
  for (const Adapter adapter : {Adapter::kJlink, Adapter::kCmsisDap}) {
    if (text == word(adapter)) return adapter;
  }
  return std::nullopt;
}

bool same_serial(std::string_view a, std::string_view b) {
  const auto significant = [](std::string_view text) {
    return text.substr(std::min(text.find_first_not_of('0'), text.size()));
  };
  return significant(a) == significant(b);
}

std::string_view udev_rules() {
  return kUdevRules;
}

std::string permission_remedy() {
  for (const char* folder : {"/etc/udev/rules.d", "/lib/udev/rules.d", "/usr/lib/udev/rules.d"}) {
    for (const char* name : {"60-groma.rules", "60-openocd.rules"}) {
      const fs::path rules = fs::path(folder) / name;
      if (::access(rules.c_str(), F_OK) != 0) continue;
      return fmt::format(
          "{} gives the group plugdev access: 'sudo usermod -aG plugdev $USER', log in again, and plug the "
          "probe in again",
          rules.string());
    }
  }
  return "the udev rule 60-groma.rules is missing: 'groma flash --udev-rules | sudo tee "
         "/etc/udev/rules.d/60-groma.rules', then 'sudo udevadm control --reload', and plug the probe in "
         "again";
}

}  // namespace groma::provision
