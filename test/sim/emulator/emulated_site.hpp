// A SiteBench (site_bench.hpp) of which all or some nodes run the shipped image.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <utility>

#include "firmware/sim/emulator/emulated_node.hpp"
#include "test/sim/site_bench.hpp"
#include "test/support/shipped_image.hpp"

namespace groma::sim {

inline const FirmwareImage& shipped() {
  static const FirmwareImage image = read_firmware_image(test::shipped_image(".hex"));
  return image;
}

// Emulates the nodes whose id `which` selects; all others are native.
template <class Settings = SiteSettings>
Settings emulating(
    Settings settings, const EmulatorOptions& options = {},
    std::function<bool(std::uint16_t id)> which = [](std::uint16_t) { return true; }) {
  settings.make_node = [options, which = std::move(which)](const NodeSpec& spec,
                                                           Medium& medium) -> std::unique_ptr<NodeHost> {
    if (!which(spec.chip.id)) return make_native_node(spec, medium);
    return make_emulated_node(spec, shipped(), medium, options);
  };
  return settings;
}

inline EmulatedNode& emulated(SiteBench& site, std::size_t node) {
  return dynamic_cast<EmulatedNode&>(site.network.node(node));
}

}  // namespace groma::sim
