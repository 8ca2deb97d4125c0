// The configuration with the files that it names: read at the start, checked by --check, reloaded on SIGHUP.
#pragma once

#include <filesystem>
#include <optional>
#include <string>
#include <vector>

#include "host/daemon/config.hpp"
#include "host/model/calibration.hpp"

namespace groma::daemon {

// The calibration to start with; none: a drive provides it. Throws as io::read_calibration(), and
// io::DataError if its verdict is unusable.
[[nodiscard]] std::optional<model::Calibration> load_calibration(const CalibrationSource& source);

// All errors of the configuration and of the files that it names, each as "FILE:LINE:COLUMN: what; what to
// do". Opens no device and writes nothing.
[[nodiscard]] std::vector<std::string> check_config(const std::filesystem::path& path);

// What gromad may change while it runs: with `calibration: {file: ...}` the calibration, and the lever arms
// of the same tags.
struct Reload {
  Config config;
  std::optional<model::Calibration> calibration;
  std::vector<std::string> problems;  // if there is one, nothing may be changed
};
// Reads the file of `current` again. `frame`: that of the calibration in use.
[[nodiscard]] Reload prepare_reload(const Config& current, const std::string& frame);

}  // namespace groma::daemon
