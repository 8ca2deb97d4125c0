// --emulated and --image, shared by the commands that simulate nodes.
#pragma once

#include <filesystem>
#include <memory>
#include <optional>

#include <CLI/App.hpp>

#include "firmware/sim/emulator/firmware_image.hpp"

namespace groma::cli {

struct EmulationChoice {
  bool emulated = false;
  std::optional<std::filesystem::path> image;
};

// `choice` has to outlive the parsing.
void add_emulation_options(CLI::App& command, EmulationChoice& choice);

// The image to emulate, or null for native nodes. Throws sim::SimulationError if it cannot be read.
[[nodiscard]] std::shared_ptr<const sim::FirmwareImage> chosen_image(const EmulationChoice& choice);

}  // namespace groma::cli
