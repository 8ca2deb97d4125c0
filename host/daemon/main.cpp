// gromad: reads the tags' serial ports and the robot's odometry, and serves poses.
#include <fmt/format.h>
#include <sys/signalfd.h>

#include <array>
#include <csignal>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <optional>
#include <string>
#include <string_view>

#include <CLI/CLI.hpp>

#include "host/daemon/config.hpp"
#include "host/daemon/daemon.hpp"
#include "host/daemon/memory_lock.hpp"
#include "host/io/calibration_file.hpp"
#include "host/io/descriptor.hpp"
#include "host/io/error.hpp"
#include "host/io/exit_code.hpp"
#include "host/io/output_file.hpp"
#include "host/io/version.hpp"

namespace groma::daemon {
namespace {

void log(std::string_view text) {
  // One call for each line, so that lines of several threads do not mix.
  fmt::print(stderr, "gromad: {}\n", text);
}

// SIGTERM and SIGINT as a descriptor to poll. Threads started later inherit the signal mask.
io::Descriptor stop_signals() {
  sigset_t set;
  sigemptyset(&set);
  sigaddset(&set, SIGTERM);
  sigaddset(&set, SIGINT);
  sigprocmask(SIG_BLOCK, &set, nullptr);
  return io::Descriptor(::signalfd(-1, &set, SFD_CLOEXEC | SFD_NONBLOCK));
}

int run(int argc, char** argv) {
  CLI::App app(
      "Localizes a robot from UWB ranges and its odometry, and serves its pose as JSON lines on TCP.",
      "gromad");
  app.set_version_flag("--version", fmt::format("gromad {}", io::program_version()));
  std::filesystem::path path;
  app.add_option("--config", path, "Configuration file (YAML)")->required();
  app.footer(
      "Exit codes: 0 stopped by a signal, 2 usage, 65 the drive gave no usable calibration,\n"
      "69 device or service unavailable, 77 permission, 78 bad configuration.");
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? io::kGood : io::kUsage;
  }

  const io::Descriptor stop = stop_signals();
  if (const std::string warning = lock_memory(); !warning.empty()) log(warning);
  if (!std::filesystem::exists(path)) {
    throw io::ConfigError({path}, "does not exist", "give the daemon's configuration file");
  }
  Config config = read_config(path);
  std::optional<model::Calibration> calibration;
  const CalibrationSource& source = config.calibration;
  // With `learn`, the same path for `file` and `output` need not exist at the first start.
  const bool starts_without =
      source.learn && source.file == source.output && source.file && !std::filesystem::exists(*source.file);
  if (source.file && !starts_without) calibration = io::read_calibration(*source.file);
  if (calibration && calibration->verdict == model::Verdict::kUnusable) {
    log(fmt::format("{}: its verdict is 'unusable'; drive and calibrate again",
                    config.calibration.file->string()));
    return io::kBadData;
  }
  if (config.calibration.output) io::expect_writable(*config.calibration.output);

  Daemon daemon(std::move(config), std::move(calibration), log);
  if (const link::LinkError error = daemon.open(); error.fault != link::LinkFault::kNone) {
    log(error.message);
    return error.fault == link::LinkFault::kPermission ? io::kNoPermission : io::kUnavailable;
  }
  if (!daemon.run(stop.get())) return io::kBadData;
  log("stopped");
  return io::kGood;
}

int guarded_run(int argc, char** argv) {
  try {
    return run(argc, argv);
  } catch (const io::DataError& error) {
    log(error.what());
    return io::kBadData;
  } catch (const io::ConfigError& error) {
    log(error.what());
    return io::kBadConfiguration;
  } catch (const io::PermissionError& error) {
    log(error.what());
    return io::kNoPermission;
  } catch (const io::PathError& error) {
    log(error.what());
    return io::kBadConfiguration;
  } catch (const std::exception& error) {
    log(error.what());
    return io::kUnavailable;
  }
}

}  // namespace
}  // namespace groma::daemon

int main(int argc, char** argv) {
  std::signal(SIGPIPE, SIG_IGN);
  return groma::daemon::guarded_run(argc, argv);
}
