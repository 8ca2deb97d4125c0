#include "host/cli/emulation_option.hpp"

#include "host/provision/image.hpp"

namespace groma::cli {

void add_emulation_options(CLI::App& command, EmulationChoice& choice) {
  command.add_flag("--emulated", choice.emulated,
                   "Each node runs the DWM1001's image on an emulated processor, instead of the firmware "
                   "compiled in");
  command
      .add_option("--image", choice.image,
                  "The image as Intel HEX, with --emulated. Default: the one that the preset dwm1001 builds")
      ->needs("--emulated")
      ->type_name("FILE");
}

std::shared_ptr<const sim::FirmwareImage> chosen_image(const EmulationChoice& choice) {
  if (!choice.emulated) return nullptr;
  return std::make_shared<const sim::FirmwareImage>(
      sim::read_firmware_image(choice.image.value_or(provision::default_image_path())));
}

}  // namespace groma::cli
